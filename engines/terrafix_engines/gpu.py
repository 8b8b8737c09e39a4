"""What the GPU and TensorRT of this computer are called, asked of their own libraries: an engine fits only these."""

import ctypes

CUDA = ("libcuda.so.1", "libcuda.so")
TENSORRT = ("libnvinfer.so.10", "libnvinfer.so.8", "libnvinfer.so")
_NAME_BYTES = 128


def gpu_name() -> str | None:
    """Name of the first CUDA device, for example "Orin"; None: there is no driver or no device.

    CUDA driver API: cuInit, cuDeviceGet, cuDeviceGetName return 0 when all is well."""
    cuda = _library(CUDA)
    if cuda is None:
        return None
    device, name = ctypes.c_int(), ctypes.create_string_buffer(_NAME_BYTES)
    if cuda.cuInit(0) or cuda.cuDeviceGet(ctypes.byref(device), 0) or cuda.cuDeviceGetName(name, _NAME_BYTES, device):
        return None
    return name.value.decode("utf-8", "replace")


def tensorrt_version() -> str | None:
    """As libnvinfer counts (10.3.0 is 100300, 8.6.1 is 8601); None: the library is not there."""
    nvinfer = _library(TENSORRT)
    return None if nvinfer is None else str(nvinfer.getInferLibVersion())


def _library(names: tuple[str, ...]) -> ctypes.CDLL | None:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None
