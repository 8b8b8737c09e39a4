"""ONNX Runtime sessions: TensorRT, then CUDA, then CPU, whichever this machine has."""

from pathlib import Path

import numpy as np
import onnxruntime as ort

PREFERENCE = ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider")


class ModelFileError(Exception):
    """The model file is missing, is not ONNX, or has other inputs and outputs than expected."""


class Model:
    """One session. Opening is slow, running is not; open before take-off."""

    def __init__(self, path: Path, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> None:
        if not path.is_file():
            raise ModelFileError(f"{path}: no such model file; check the path given for the model")
        available = ort.get_available_providers()
        options = ort.SessionOptions()
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(
                str(path), options, providers=[p for p in PREFERENCE if p in available]
            )
        except Exception as error:  # noqa: BLE001 - ONNX Runtime's errors share no base class of their own
            raise ModelFileError(f"{path}: not a model that ONNX Runtime can open ({error})") from None
        has_in = {i.name for i in self._session.get_inputs()}
        has_out = {o.name for o in self._session.get_outputs()}
        if not set(inputs) <= has_in or not set(outputs) <= has_out:
            raise ModelFileError(
                f"{path}: has inputs {sorted(has_in)} and outputs {sorted(has_out)}, expected {inputs} and {outputs}"
            )
        self._inputs, self._outputs = inputs, outputs

    @property
    def provider(self) -> str:
        """The provider that really runs it."""
        return str(self._session.get_providers()[0])

    def run(self, *tensors: np.ndarray) -> list[np.ndarray]:
        """One array an input, in the order of ``inputs``; returns ``outputs``. A NaN anywhere becomes zero."""
        results = self._session.run(list(self._outputs), dict(zip(self._inputs, tensors, strict=True)))
        return [np.nan_to_num(np.asarray(r)) for r in results]
