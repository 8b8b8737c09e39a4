"""Runs a model with ONNX Runtime on the best available provider, checks its outputs, and falls back on failure.

Nothing is built or run for the first time in flight: opening a model warms up every known size, and uses a TensorRT
engine only if it was built before."""

import functools
import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from terrafix_engines import providers
from terrafix_engines.manifest import Manifest, Preset, Tensor, bind_sizes, concrete_shape
from terrafix_engines.providers import CPU, PREFERENCE, TENSORRT, RejectedProvider, Shapes, UnavailableError

WARM_UP_SIZE = 512  # side or number of points without a preset; sufficient for exports with a minimum number of points
MAX_BOUND_SHAPES = 8  # sets of shapes that keep their buffers [spec: twice the presets of xfeat]
ANY_SHAPE: Shapes = ()  # key of a session that accepts every size


class ModelFileError(Exception):
    """The model file is missing, altered, not ONNX, has other inputs or outputs, or no provider can run it."""


class ModelRunError(Exception):
    """Inference failed: no provider could run this input, or the outputs are invalid."""


class Model:
    """A model with its inference session. Opening is slow: open it before take-off.

    ``provider``: the one in use; ``passed_over``: the better ones with the reason why they are not used, in order; it
    grows when a provider fails."""

    def __init__(
        self,
        path: Path,
        inputs: tuple[str, ...],
        outputs: tuple[str, ...],
        *,
        manifest: Manifest | None = None,
        engines: Path | None = None,
        exact: bool = False,
        prefer: tuple[str, ...] = PREFERENCE,
        build: bool = False,
    ) -> None:
        """``inputs`` and ``outputs``: names of the tensors in use. ``manifest``: shapes and types are checked against
        it; its presets are the sizes that TensorRT may run, with engines below the folder ``engines``. ``exact``: the
        file must match the checksum of the manifest. ``prefer``: providers, the best first. ``build``: missing engines
        are built, which takes minutes; not in flight. Raises ModelFileError."""
        try:
            self._content = path.read_bytes()
        except FileNotFoundError:
            raise ModelFileError(f"{path}: no such model file; check the path given for the model") from None
        except OSError as error:
            raise ModelFileError(f"{path}: cannot be read ({error.strerror}); check the path and permissions") from None
        self.path = path
        self.sha256 = hashlib.sha256(self._content).hexdigest()
        if exact and manifest and self.sha256 != manifest.sha256:
            raise ModelFileError(
                f"{path}: not the published file (sha256 {self.sha256[:12]}..., expected {manifest.sha256[:12]}...); "
                f"terrafix models fetch {manifest.name}"
            )
        self.rejected_providers: list[RejectedProvider] = []
        self.provider = ""
        self.run_count = 0  # successful runs since it was opened
        self._inputs, self._outputs = inputs, outputs
        self._manifest, self._engines, self._build = manifest, engines, build
        self._presets: list[Preset] = manifest.presets if manifest else []
        self._sessions: dict[Shapes, Any] = {}
        self._bound_session: BoundSession | None = None
        self._remaining = list(prefer)
        self._open_next_provider()

    def run(self, *tensors: np.ndarray) -> list[np.ndarray]:
        """Runs inference. ``tensors``: one array per input, in the order of ``inputs``. -> arrays of ``outputs``;
        floats are float32 and finite.

        A provider that fails, runs out of memory or returns invalid outputs is replaced permanently by the next one.
        Raises ModelRunError when no provider is left."""
        while True:
            try:
                results = self._run_session(tensors)
                self.run_count += 1
                return results
            except _invalid_argument() as error:  # the input is invalid for every provider
                raise ModelRunError(f"{self.path.name}: {_first_line(error)}") from None
            except _run_errors() as error:
                if not self._remaining:
                    raise ModelRunError(f"{self.path.name}: {_first_line(error)}") from None
                self.rejected_providers.append(
                    RejectedProvider(self.provider, f"failed while it ran: {_first_line(error)}")
                )
            try:
                self._open_next_provider()
            except ModelFileError as error:
                raise ModelRunError(str(error)) from None

    def side_lengths(self, height: int, width: int) -> tuple[int, int]:
        """Padded size (height, width) for an image of this size. On a GPU that of the smallest preset that holds it, so
        that every size was warmed up before take-off; on the CPU the next multiples that the model accepts. Raises
        ModelRunError: the fixed input size of the model is smaller."""
        assert self._manifest is not None and self._manifest.image is not None
        max_height, max_width = self._manifest.image_size()
        if isinstance(max_height, int) and isinstance(max_width, int):
            if height > max_height or width > max_width:
                raise ModelRunError(
                    f"{self.path.name}: takes images of {max_width}x{max_height} px, not {width}x{height}"
                )
            return max_height, max_width
        if self.provider != CPU:
            fitting = [
                (preset.sizes["height"], preset.sizes["width"])
                for preset in self._presets
                if preset.sizes["height"] >= height and preset.sizes["width"] >= width
            ]
            if fitting:
                return min(fitting, key=lambda size: size[0] * size[1])
        multiple = self._manifest.image.multiple
        return height + -height % multiple, width + -width % multiple

    def _open_next_provider(self) -> None:
        """Opens the best remaining provider. Raises ModelFileError."""
        reason = ""
        while self._remaining:
            self.provider = self._remaining.pop(0)
            self._sessions = {}  # released first: the memory may not suffice for two
            try:
                providers.check(self.provider)
                self._open()
                self._warm_up()
                return
            except _open_errors() as error:
                reason = _first_line(error)
                self._sessions = {}
                self.rejected_providers.append(RejectedProvider(self.provider, reason))
        raise ModelFileError(f"{self.path}: cannot be run ({reason}); is the file complete? (terrafix models verify)")

    def _open(self) -> None:
        if self.provider != TENSORRT:
            self._sessions[ANY_SHAPE] = self._session(providers.provider_chain(self.provider))
            return
        if not self._presets or self._manifest is None or self._engines is None:
            raise UnavailableError("the model has no preset: engines are built for sizes that are known")
        inputs = self._manifest.tensors(self._inputs)
        for preset in self._presets:
            folder = providers.engine_folder(self._engines, self.sha256, preset)
            if not providers.is_ready(folder):
                if not self._build:
                    raise UnavailableError(f"no engine {folder}; on the ground: terrafix models build")
                folder.mkdir(parents=True, exist_ok=True)
            options = providers.tensorrt_options(folder, preset, inputs)
            shapes = tuple(concrete_shape(tensor, preset.sizes) for tensor in inputs)
            self._sessions[shapes] = self._session(providers.provider_chain(TENSORRT, options))
            self._run_session(tuple(noise(t, preset.sizes) for t in inputs))
            if self._build:
                providers.mark_ready(folder, preset)

    def _session(self, chain: providers.Chain) -> Any:
        import onnxruntime as ort  # deferred, so that a vehicle without a model restarts quickly

        options = ort.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = len(os.sched_getaffinity(0))  # by default as many as the computer has cores
        # Threads that spin after a run take CPU time from the estimator and the link.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # ONNX Runtime's own fallback is silent; this class selects and reports the provider instead.
        session = ort.InferenceSession(self._content, options, providers=chain, enable_fallback=0)
        if session.get_providers()[0] != self.provider:
            raise UnavailableError("ONNX Runtime could not start it")
        has_in = {i.name for i in session.get_inputs()}
        has_out = {o.name for o in session.get_outputs()}
        if not set(self._inputs) <= has_in or not set(self._outputs) <= has_out:
            raise ModelFileError(
                f"{self.path}: has inputs {sorted(has_in)} and outputs {sorted(has_out)}, "
                f"expected {self._inputs} and {self._outputs}"
            )
        return session

    def _bound(self, session: Any) -> "BoundSession":
        if self._bound_session is None or self._bound_session.session is not session:
            self._bound_session = BoundSession(session, self._outputs, providers.MEMORY[self.provider])
        return self._bound_session

    def _warm_up(self) -> None:
        """Runs every known size once; on the CPU, which accepts any size, only the first (smallest) one."""
        if self._manifest is None or self.provider == TENSORRT:  # engines were run when they were loaded
            return
        inputs = self._manifest.tensors(self._inputs)
        sizes = [preset.sizes for preset in self._presets] or [default_sizes(inputs)]
        for chosen in sizes if self.provider != CPU else sizes[:1]:
            self._run_session(tuple(noise(tensor, chosen) for tensor in inputs))

    def _run_session(self, tensors: tuple[np.ndarray, ...]) -> list[np.ndarray]:
        """One inference. Raises ``_run_errors``; UnavailableError when the provider returns invalid outputs."""
        sizes: dict[str, int] = {}
        feed = dict(zip(self._inputs, tensors, strict=True))
        for tensor in self._manifest.tensors(self._inputs) if self._manifest else ():
            if mismatch := bind_sizes(tensor, feed[tensor.name].shape, sizes):
                raise ModelRunError(f"{self.path.name}: input {mismatch}")
            feed[tensor.name] = feed[tensor.name].astype(tensor.dtype, copy=False)
        session = self._sessions.get(ANY_SHAPE) or self._sessions.get(tuple(array.shape for array in tensors))
        if session is None:
            raise UnavailableError(f"no session for inputs of shapes {[list(array.shape) for array in tensors]}")
        found = session.run(list(self._outputs), feed) if self.provider == CPU else self._bound(session).run(feed)
        results = [np.asarray(one) for one in found]
        for k, (name, array) in enumerate(zip(self._outputs, results, strict=True)):
            if self._manifest is not None:
                (declared,) = self._manifest.tensors((name,))
                if mismatch := bind_sizes(declared, array.shape, sizes):
                    raise UnavailableError(f"output {mismatch}")
                if declared.dtype != array.dtype.name:
                    raise UnavailableError(f"output '{name}' is {array.dtype.name}, not {declared.dtype}")
            if array.dtype.kind == "f":
                if not np.isfinite(array).all():
                    raise UnavailableError(f"output '{name}' has NaN or infinite values")
                results[k] = array.astype(np.float32, copy=False)
        return results


class BoundSession:
    """Inference whose inputs and outputs are bound to buffers of the device. The buffers of the inputs stay, so that a
    call copies their contents and allocates none."""

    def __init__(self, session: Any, outputs: tuple[str, ...], device: str) -> None:
        """``device``: its name in ONNX Runtime, "cuda" or "cpu"."""
        self.session, self._outputs, self._device = session, outputs, device
        self._inputs: dict[Shapes, dict[str, Any]] = {}

    def run(self, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        """``feed``: array of each input -> arrays of the outputs. Raises what the session raises."""
        import onnxruntime as ort

        shapes = tuple(array.shape for array in feed.values())
        contiguous = {name: np.ascontiguousarray(array) for name, array in feed.items()}
        if shapes in self._inputs:
            for name, array in contiguous.items():
                self._inputs[shapes][name].update_inplace(array)
        else:
            if len(self._inputs) == MAX_BOUND_SHAPES:
                self._inputs.clear()
            self._inputs[shapes] = {
                name: ort.OrtValue.ortvalue_from_numpy(array, self._device, 0) for name, array in contiguous.items()
            }
        binding = self.session.io_binding()
        for name, bound in self._inputs[shapes].items():
            binding.bind_ortvalue_input(name, bound)
        for name in self._outputs:
            binding.bind_output(name, self._device, 0)
        self.session.run_with_iobinding(binding)
        return list(binding.copy_outputs_to_cpu())


@functools.cache
def _run_errors() -> tuple[type[Exception], ...]:
    """ONNX Runtime's exceptions have no common base but Exception, and new versions add new ones."""
    from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

    own = [kind for kind in vars(ort_state).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, MemoryError, UnavailableError)


def _open_errors() -> tuple[type[Exception], ...]:
    return (*_run_errors(), ValueError, OSError)


def _invalid_argument() -> type[Exception]:
    from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

    return ort_state.InvalidArgument


def default_sizes(inputs: tuple[Tensor, ...]) -> dict[str, int]:
    """Sizes for a model whose manifest has no preset."""
    names = {size for tensor in inputs for size in tensor.shape if isinstance(size, str)}
    return {name: 1 if name == "batch" else WARM_UP_SIZE for name in names}


def noise(tensor: Tensor, sizes: dict[str, int]) -> np.ndarray:
    """Deterministic random input, 0 to 1."""
    shape = concrete_shape(tensor, sizes)
    return np.random.default_rng(0).random(shape, dtype=np.float32).astype(tensor.dtype)


def _first_line(error: BaseException) -> str:
    """First line of a message; ONNX Runtime's messages have many lines."""
    return str(error).strip().split("\n")[0][:200] or type(error).__name__
