"""Imported by every interpreter of a Terrafix with faults before anything else (switches.py)."""

import os
import sys
import time
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

FOLDER = os.environ["TERRAFIX_CHAOS_SWITCHES"]
MODELS = "onnxruntime"


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


_time_ns, _time, _fsync = time.time_ns, time.time, os.fsync


def _slow_fsync(descriptor: int) -> None:
    time.sleep(value("fsync_s"))
    _fsync(descriptor)


time.time_ns = lambda: _time_ns() + round(1e9 * value("wall_clock_s"))
time.time = lambda: _time() + value("wall_clock_s")
os.fsync = _slow_fsync  # type: ignore[assignment]
sys.meta_path.insert(0, ModelFinder())
