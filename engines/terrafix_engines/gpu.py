"""Names of the GPU and the TensorRT version, from their libraries; a TensorRT engine is valid only for these."""

import ctypes

CUDA = ("libcuda.so.1", "libcuda.so")
TENSORRT = ("libnvinfer.so.10", "libnvinfer.so.8", "libnvinfer.so")
_NAME_BYTES = 128


def gpu_name() -> str | None:
    """Name of the first CUDA device, for example "Orin"; None without a driver or device.

    CUDA driver API: cuInit, cuDeviceGet, cuDeviceGetName return 0 on success."""
    cuda = _library(CUDA)
    if cuda is None:
        return None
    device, name = ctypes.c_int(), ctypes.create_string_buffer(_NAME_BYTES)
    if cuda.cuInit(0) or cuda.cuDeviceGet(ctypes.byref(device), 0) or cuda.cuDeviceGetName(name, _NAME_BYTES, device):
        return None
    return name.value.decode("utf-8", "replace")


def tensorrt_version() -> str | None:
    """Version number of libnvinfer (10.3.0 is 100300, 8.6.1 is 8601); None without the library."""
    nvinfer = _library(TENSORRT)
    return None if nvinfer is None else str(nvinfer.getInferLibVersion())


def _library(names: tuple[str, ...]) -> ctypes.CDLL | None:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None
