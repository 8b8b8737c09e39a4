"""ONNX Runtime execution providers: TensorRT, then CUDA, then the CPU, and why one is not available.

TensorRT compiles an engine per model, TensorRT version, GPU, precision and set of sizes, which takes minutes: engines
are built on the ground (`terrafix models build`) and only loaded in flight."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

from terrafix_engines import gpu
from terrafix_engines.manifest import Preset, Tensor, concrete_shape

TENSORRT, CUDA, CPU = "TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"
PREFERENCE = (TENSORRT, CUDA, CPU)
MEMORY = {TENSORRT: "cuda", CUDA: "cuda", CPU: "cpu"}  # ONNX Runtime's name of the device with a provider's buffers
READY = "ready.json"  # written after the first successful run of an engine; missing after an interrupted build
GPU_MEMORY_BYTES = 6 * 2**30  # of all models together [spec: RS-5 of the requirements]
MODELS = 4  # that a flight opens at most: features of odometry, of the anchor, correlation, places [spec: [models]]
MODEL_MEMORY_BYTES = GPU_MEMORY_BYTES // MODELS  # arena of a session; workspace of an engine
# The arena grows by the requested size, not by powers of two: on a Jetson the GPU shares the system's memory.
CUDA_OPTIONS = {
    "arena_extend_strategy": "kSameAsRequested",
    "cudnn_conv_algo_search": "HEURISTIC",
    "gpu_mem_limit": str(MODEL_MEMORY_BYTES),
}

Shapes = tuple[tuple[int, ...], ...]  # of all inputs
Chain = list[str | tuple[str, dict[str, str]]]  # the ``providers`` argument of InferenceSession


class UnavailableError(Exception):
    """The provider cannot run the model on this computer; the message says why."""


@dataclass(frozen=True)
class RejectedProvider:
    """A provider that cannot run the model, or failed while running it."""

    provider: str
    reason: str

    def __str__(self) -> str:
        return f"{short_name(self.provider)}: {self.reason}"


def short_name(provider: str) -> str:
    """Common name of a provider."""
    return {TENSORRT: "TensorRT", CUDA: "CUDA", CPU: "CPU"}.get(provider, provider)


def check(provider: str) -> None:
    """Raises UnavailableError when the computer cannot use the provider for any model."""
    import onnxruntime as ort  # deferred until a model is opened (runtime.py)

    available = ort.get_available_providers()
    if provider not in available:
        has = ", ".join(short_name(p) for p in PREFERENCE if p in available)
        raise UnavailableError(f"this ONNX Runtime ({ort.__version__}) is built without it, it has {has}")
    if provider == CPU:
        return
    if gpu.gpu_name() is None:
        raise UnavailableError("the driver finds no CUDA device")
    if provider == TENSORRT and gpu.tensorrt_version() is None:
        raise UnavailableError("the library libnvinfer cannot be loaded")


def provider_chain(provider: str, options: dict[str, str] | None = None) -> Chain:
    """The provider, followed by the fallbacks for operators that it does not support."""
    if provider == CPU:
        return [CPU]
    cuda: Chain = [(CUDA, CUDA_OPTIONS), CPU]
    return cuda if provider == CUDA else [(TENSORRT, options or {}), *cuda]


def engine_folder(root: Path, sha256: str, preset: Preset) -> Path:
    """Engine folder below ``root``: one per model, TensorRT and ONNX Runtime version, GPU, precision and sizes."""
    import onnxruntime as ort

    gpu_name = re.sub(r"[^A-Za-z0-9]+", "-", gpu.gpu_name() or "none")
    sizes = "x".join(str(preset.sizes[name]) for name in sorted(preset.sizes))
    key = f"trt{gpu.tensorrt_version()}-ort{ort.__version__}-{gpu_name}-{preset.precision}-{sizes}"
    return root / sha256[:16] / key


def is_ready(folder: Path) -> bool:
    """True when an engine exists and its build was completed; ONNX Runtime would silently build a missing one."""
    return (folder / READY).is_file() and any(folder.glob("*.engine"))


def mark_ready(folder: Path, preset: Preset) -> None:
    (folder / READY).write_text(json.dumps({"sizes": preset.sizes, "precision": preset.precision}), encoding="utf-8")


def tensorrt_options(folder: Path, preset: Preset, inputs: tuple[Tensor, ...]) -> dict[str, str]:
    """Options for one engine of exactly these sizes (onnxruntime.ai: TensorRT Execution Provider, Configurations)."""
    profile = ",".join(f"{t.name}:{'x'.join(str(n) for n in concrete_shape(t, preset.sizes))}" for t in inputs)
    return {
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": str(folder),
        "trt_timing_cache_enable": "True",
        "trt_timing_cache_path": str(folder.parent),
        "trt_max_workspace_size": str(MODEL_MEMORY_BYTES),
        "trt_fp16_enable": str(preset.precision == "fp16"),
        "trt_profile_min_shapes": profile,
        "trt_profile_opt_shapes": profile,
        "trt_profile_max_shapes": profile,
    }
