"""How a model is run: TensorRT, then CUDA, then the CPU, and why one of them cannot.

TensorRT compiles an engine for one model, one TensorRT, one GPU, one precision and one set of sizes, which takes
minutes: engines are made on the ground (`terrafix models build`) and only loaded in flight."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

from terrafix_engines import gpu
from terrafix_engines.manifest import Preset, Tensor, shape_of

TENSORRT, CUDA, CPU = "TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"
PREFERENCE = (TENSORRT, CUDA, CPU)
READY = "ready.json"  # written when an engine has answered once: what was cut off while it was built has none
# One arena grows by what is asked and not by powers of two: on a Jetson the GPU's memory is everybody's.
CUDA_OPTIONS = {"arena_extend_strategy": "kSameAsRequested", "cudnn_conv_algo_search": "HEURISTIC"}

Shapes = tuple[tuple[int, ...], ...]  # of all inputs
Chain = list[str | tuple[str, dict[str, str]]]  # as InferenceSession wants its providers


class UnavailableError(Exception):
    """This provider cannot run this model here, and why."""


@dataclass(frozen=True)
class PassedOver:
    """A provider that does not run the model, or does no longer."""

    provider: str
    reason: str

    def __str__(self) -> str:
        return f"{short(self.provider)}: {self.reason}"


def short(provider: str) -> str:
    """The name that people use."""
    return {TENSORRT: "TensorRT", CUDA: "CUDA", CPU: "CPU"}.get(provider, provider)


def check(provider: str) -> None:
    """Raises UnavailableError when this computer cannot use the provider for any model."""
    import onnxruntime as ort  # only where a model is opened (runtime.py)

    available = ort.get_available_providers()
    if provider not in available:
        has = ", ".join(short(p) for p in PREFERENCE if p in available)
        raise UnavailableError(f"this ONNX Runtime ({ort.__version__}) is built without it, it has {has}")
    if provider == CPU:
        return
    if gpu.gpu_name() is None:
        raise UnavailableError("the driver finds no CUDA device")
    if provider == TENSORRT and gpu.tensorrt_version() is None:
        raise UnavailableError("the library libnvinfer cannot be loaded")


def chain(provider: str, options: dict[str, str] | None = None) -> Chain:
    """The provider and those that take what it cannot compute."""
    if provider == CPU:
        return [CPU]
    cuda: Chain = [(CUDA, CUDA_OPTIONS), CPU]
    return cuda if provider == CUDA else [(TENSORRT, options or {}), *cuda]


def engine_folder(root: Path, sha256: str, preset: Preset) -> Path:
    """Where the engine of a model with this checksum lies: below ``root``, one folder for each thing that it fits."""
    import onnxruntime as ort

    gpu_name = re.sub(r"[^A-Za-z0-9]+", "-", gpu.gpu_name() or "none")
    sizes = "x".join(str(preset.sizes[name]) for name in sorted(preset.sizes))
    key = f"trt{gpu.tensorrt_version()}-ort{ort.__version__}-{gpu_name}-{preset.precision}-{sizes}"
    return root / sha256[:16] / key


def is_ready(folder: Path) -> bool:
    """There is an engine, and it was built to the end: ONNX Runtime would build a missing one without a word."""
    return (folder / READY).is_file() and any(folder.glob("*.engine"))


def mark_ready(folder: Path, preset: Preset) -> None:
    (folder / READY).write_text(json.dumps({"sizes": preset.sizes, "precision": preset.precision}), encoding="utf-8")


def tensorrt_options(folder: Path, preset: Preset, inputs: tuple[Tensor, ...]) -> dict[str, str]:
    """One engine with these sizes and no others (onnxruntime.ai: TensorRT Execution Provider, Configurations)."""
    profile = ",".join(f"{t.name}:{'x'.join(str(n) for n in shape_of(t, preset.sizes))}" for t in inputs)
    return {
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": str(folder),
        "trt_timing_cache_enable": "True",
        "trt_timing_cache_path": str(folder.parent),
        "trt_fp16_enable": str(preset.precision == "fp16"),
        "trt_profile_min_shapes": profile,
        "trt_profile_opt_shapes": profile,
        "trt_profile_max_shapes": profile,
    }
