"""A model that runs: ONNX Runtime on the best provider that can, its answers checked, the next one when it fails.

Nothing is built or tried for the first time in flight: opening warms up every size that is known, and takes an engine
of TensorRT only where one was built before."""

import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from terrafix_engines import providers
from terrafix_engines.manifest import Manifest, Preset, Tensor, shape_of, sizes_of
from terrafix_engines.providers import CPU, PREFERENCE, TENSORRT, PassedOver, Shapes, UnavailableError

WARM_UP_SIZE = 512  # of a side or a number of points that no preset names: enough for exports that want so many points
ANY: Shapes = ()  # key of a session that takes every size


class ModelFileError(Exception):
    """The model file is missing, altered, not ONNX, of other inputs and outputs than wanted, or nothing can run it."""


class ModelRunError(Exception):
    """No answer to this input: no provider could compute it, or what came out cannot be used."""


class Model:
    """Opening is slow, running is not; open before take-off.

    ``provider`` runs it; ``passed_over`` says why the better ones do not, in order, and grows when one fails."""

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
        """``inputs`` and ``outputs``: names of those that are used. ``manifest``: shapes and types are checked against
        it, and its presets are what TensorRT may run, from engines below the folder ``engines``. ``exact``: the file
        must be the one that the manifest describes. ``prefer``: providers, the best first. ``build``: engines that are
        missing are built, which takes minutes; never in flight. Raises ModelFileError."""
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
        self.passed_over: list[PassedOver] = []
        self.provider = ""
        self.answers = 0  # since it was opened
        self._inputs, self._outputs = inputs, outputs
        self._manifest, self._engines, self._build = manifest, engines, build
        self._presets: list[Preset] = manifest.presets if manifest else []
        self._sessions: dict[Shapes, Any] = {}
        self._left = list(prefer)
        self._next()

    def run(self, *tensors: np.ndarray) -> list[np.ndarray]:
        """One array an input, in the order of ``inputs``; returns ``outputs``, floats as float32, all of them finite.

        A provider that fails, runs out of memory or answers nonsense is left for the next one, for good. Raises
        ModelRunError when none is left."""
        while True:
            try:
                results = self._answer(tensors)
                self.answers += 1
                return results
            except _invalid_argument() as error:  # the input is wrong for every provider
                raise ModelRunError(f"{self.path.name}: {_line(error)}") from None
            except _run_errors() as error:
                if not self._left:
                    raise ModelRunError(f"{self.path.name}: {_line(error)}") from None
                self.passed_over.append(PassedOver(self.provider, f"failed while it ran: {_line(error)}"))
            try:
                self._next()
            except ModelFileError as error:
                raise ModelRunError(str(error)) from None

    def side_lengths(self, height: int, width: int) -> tuple[int, int]:
        """Size to which a picture of this size is filled up before it goes in: that of the smallest preset on a GPU, so
        that every size was met before take-off; on the CPU the next multiples that the model can take. Raises
        ModelRunError when the model takes smaller pictures only."""
        assert self._manifest is not None and self._manifest.image is not None
        high, wide = self._manifest.picture_size()
        if isinstance(high, int) and isinstance(wide, int):
            if height > high or width > wide:
                raise ModelRunError(f"{self.path.name}: takes pictures of {wide}x{high} px, not {width}x{height}")
            return high, wide
        if self.provider != CPU:
            held = [
                (preset.sizes["height"], preset.sizes["width"])
                for preset in self._presets
                if preset.sizes["height"] >= height and preset.sizes["width"] >= width
            ]
            if held:
                return min(held, key=lambda size: size[0] * size[1])
        multiple = self._manifest.image.multiple
        return height + -height % multiple, width + -width % multiple

    def _next(self) -> None:
        """Opens the best provider that is left. Raises ModelFileError."""
        reason = ""
        while self._left:
            self.provider = self._left.pop(0)
            self._sessions = {}  # first: there may be no memory for two
            try:
                providers.check(self.provider)
                self._open()
                self._warm_up()
                return
            except _open_errors() as error:
                reason = _line(error)
                self._sessions = {}
                self.passed_over.append(PassedOver(self.provider, reason))
        raise ModelFileError(f"{self.path}: cannot be run ({reason}); is the file whole? (terrafix models verify)")

    def _open(self) -> None:
        if self.provider != TENSORRT:
            self._sessions[ANY] = self._session(providers.chain(self.provider))
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
            shapes = tuple(shape_of(tensor, preset.sizes) for tensor in inputs)
            self._sessions[shapes] = self._session(providers.chain(TENSORRT, options))
            self._answer(tuple(noise(t, preset.sizes) for t in inputs))
            if self._build:
                providers.mark_ready(folder, preset)

    def _session(self, chain: providers.Chain) -> Any:
        import onnxruntime as ort  # only here: a vehicle without a model shall be there soon after a restart

        options = ort.SessionOptions()
        options.log_severity_level = 3
        # Threads that spin after an answer take the cores from the estimator and the link.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # Its own falling back is silent: the providers of a session are ours to choose and to say.
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

    def _warm_up(self) -> None:
        """Every size that is known; on the CPU, which takes any, the smallest."""
        if self._manifest is None or self.provider == TENSORRT:  # engines have answered when they were loaded
            return
        inputs = self._manifest.tensors(self._inputs)
        sizes = [preset.sizes for preset in self._presets] or [default_sizes(inputs)]
        for chosen in sizes if self.provider != CPU else sizes[:1]:
            self._answer(tuple(noise(tensor, chosen) for tensor in inputs))

    def _answer(self, tensors: tuple[np.ndarray, ...]) -> list[np.ndarray]:
        """Raises ``_run_errors``; UnavailableError when the provider answers nonsense."""
        sizes: dict[str, int] = {}
        feed = dict(zip(self._inputs, tensors, strict=True))
        for tensor in self._manifest.tensors(self._inputs) if self._manifest else ():
            if wrong := sizes_of(tensor, feed[tensor.name].shape, sizes):
                raise ModelRunError(f"{self.path.name}: input {wrong}")
            feed[tensor.name] = feed[tensor.name].astype(tensor.dtype, copy=False)
        session = self._sessions.get(ANY) or self._sessions.get(tuple(array.shape for array in tensors))
        if session is None:
            raise UnavailableError(f"nothing is ready for inputs of {[list(array.shape) for array in tensors]}")
        found = session.run(list(self._outputs), feed)
        results = [np.asarray(one) for one in found]
        for k, (name, array) in enumerate(zip(self._outputs, results, strict=True)):
            if self._manifest is not None:
                (stated,) = self._manifest.tensors((name,))
                if wrong := sizes_of(stated, array.shape, sizes):
                    raise UnavailableError(f"output {wrong}")
                if stated.dtype != array.dtype.name:
                    raise UnavailableError(f"output '{name}' is {array.dtype.name}, not {stated.dtype}")
            if array.dtype.kind == "f":
                if not np.isfinite(array).all():
                    raise UnavailableError(f"output '{name}' is not a number in places (NaN or infinite)")
                results[k] = array.astype(np.float32, copy=False)
        return results


@functools.cache
def _run_errors() -> tuple[type[Exception], ...]:
    """Those of ONNX Runtime share no base class but Exception, and new ones come with new versions."""
    from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

    own = [kind for kind in vars(ort_state).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, MemoryError, UnavailableError)


def _open_errors() -> tuple[type[Exception], ...]:
    return (*_run_errors(), ValueError, OSError)


def _invalid_argument() -> type[Exception]:
    from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

    return ort_state.InvalidArgument


def default_sizes(inputs: tuple[Tensor, ...]) -> dict[str, int]:
    """For a model whose manifest has no preset."""
    names = {size for tensor in inputs for size in tensor.shape if isinstance(size, str)}
    return {name: 1 if name == "batch" else WARM_UP_SIZE for name in names}


def noise(tensor: Tensor, sizes: dict[str, int]) -> np.ndarray:
    """Something to compute, the same every time: 0 to 1."""
    shape = shape_of(tensor, sizes)
    return np.random.default_rng(0).random(shape, dtype=np.float32).astype(tensor.dtype)


def _line(error: BaseException) -> str:
    """ONNX Runtime explains itself over many lines, the first says it."""
    return str(error).strip().split("\n")[0][:200] or type(error).__name__
