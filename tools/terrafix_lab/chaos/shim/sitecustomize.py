"""Imported by every interpreter of a Terrafix with faults before anything else (switches.py)."""

import os
import sys
import threading
import time
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

FOLDER = os.environ["TERRAFIX_CHAOS_SWITCHES"]
MODELS = "onnxruntime"
LEAK_BYTES = 8 << 20  # in each of LEAK_PERIOD_S, up to LEAK_LIMIT: a computer without a limit of memory must survive
LEAK_PERIOD_S = 0.1
LEAK_LIMIT = 512 << 20


def value(switch: str) -> float:
    try:
        with open(os.path.join(FOLDER, switch), encoding="ascii") as file:
            return float(file.read())
    except (OSError, ValueError):
        return 0.0


class ModelFinder(MetaPathFinder):
    """Lets the models be imported as usual, and then their sessions fail while the switch is on."""

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != MODELS:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            spec.loader = ModelLoader(spec.loader)
        return spec


class ModelLoader(Loader):
    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        self._loader.exec_module(module)
        for name in ("run", "run_with_iobinding"):
            setattr(module.InferenceSession, name, failing(getattr(module.InferenceSession, name)))


def failing(call: Any) -> Any:
    def run(*arguments: Any, **named: Any) -> Any:
        if value("no_provider"):
            raise RuntimeError("the device is lost")
        return call(*arguments, **named)

    return run


def _leak() -> None:
    taken: list[bytes] = []
    while True:
        time.sleep(LEAK_PERIOD_S)
        if value("leak_pid") == os.getpid() and len(taken) * LEAK_BYTES < LEAK_LIMIT:
            taken.append(b"\1" * LEAK_BYTES)


def _watch_leak() -> None:
    threading.Thread(target=_leak, daemon=True).start()


_time_ns, _time, _fsync = time.time_ns, time.time, os.fsync


def _slow_fsync(descriptor: int) -> None:
    time.sleep(value("fsync_s"))
    _fsync(descriptor)


time.time_ns = lambda: _time_ns() + round(1e9 * value("wall_clock_s"))
time.time = lambda: _time() + value("wall_clock_s")
os.fsync = _slow_fsync  # type: ignore[assignment]
sys.meta_path.insert(0, ModelFinder())
os.register_at_fork(after_in_child=_watch_leak)
_watch_leak()
