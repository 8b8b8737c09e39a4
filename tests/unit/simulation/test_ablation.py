"""The table of mechanisms that an ablation replaces, and the processes in which it does."""

import os
import subprocess
import sys

import pytest

from terrafix_lab.ablation.__main__ import SHIM, main
from terrafix_lab.ablation.mechanisms import VARIABLE

PROBE = """
from terrafix.core.agreement import Agreement
from terrafix.estimator.integrity.other_ground import OtherGround
import numpy as np
found = OtherGround(Agreement())
for _ in range(20):
    found.on_rejected(np.array([300.0, 0.0]))
print(found.variance_m2 > 0.0)
"""


REPLACED = """
import inspect
from importlib import import_module
from terrafix_lab.ablation.mechanisms import MECHANISMS
for mechanism in MECHANISMS.values():
    owner = getattr(import_module(mechanism.module), mechanism.owner)
    called = {name: getattr(owner, name) for name in mechanism.members if callable(getattr(owner, name))}
    mechanism.replace()
    for name, original in called.items():
        signature = inspect.signature(original)
        keywords = {p.name: 0 for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY}
        inspect.signature(getattr(owner, name)).bind(*[0] * (len(signature.parameters) - len(keywords)), **keywords)
"""


def test_each_mechanism_can_be_replaced_and_is_called_as_before() -> None:
    """In a process of its own, so that the other tests have them all."""
    subprocess.run([sys.executable, "-c", REPLACED], check=True)


@pytest.mark.parametrize(("ablated", "doubted"), [(False, "True"), (True, "False")])
def test_a_child_process_has_the_replaced_mechanism(ablated: bool, doubted: str) -> None:
    path = os.pathsep.join([str(SHIM), *filter(None, sys.path)])
    environment = os.environ | ({VARIABLE: "map", "PYTHONPATH": path} if ablated else {})
    program = [sys.executable, "-c", PROBE]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == doubted


@pytest.mark.parametrize("words", [[], ["out"], ["out", "--"], ["out", "nobody", "--", "montecarlo"]])
def test_a_wrong_command_line_names_the_mechanisms(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2 and "lock" in capsys.readouterr().out
