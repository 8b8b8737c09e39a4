"""Selection of the execution provider of a model, rejection of unusable models, and failures while a model runs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

import tiny_onnx
from terrafix_engines import gpu, manifest, providers, runtime
from terrafix_engines.providers import CPU, CUDA, TENSORRT
from terrafix_engines.runtime import Model, ModelFileError, ModelRunError

IN, OUT = ("input",), ("descriptors",)
GRAY = np.full((1, 3, 64, 64), 0.5, np.float32)
BLUE = np.zeros((1, 3, 64, 64), np.float32)
BLUE[0, 2] = 1.0


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    return tiny_onnx.write(tmp_path, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like("blue"))


def opened(path: Path, **more: Any) -> Model:
    described = manifest.read(path.with_suffix(".toml"))
    return Model(path, IN, OUT, manifest=described, engines=path.parent / "engines", exact=True, **more)


def test_the_model_computes_the_function_of_its_file(tiny: Path) -> None:
    image = np.random.default_rng(3).random((1, 3, 64, 64), dtype=np.float32)
    (found,) = opened(tiny).run(image)
    weights = np.random.default_rng(1).normal(size=(64, 3, 8, 8)).astype(np.float32)
    expected = np.einsum("kcyx,chywx->khw", weights, image[0].reshape(3, 8, 8, 8, 8))
    assert found.shape == (1, 64, 8, 8) and np.allclose(found[0], expected, atol=1e-3)


def test_an_onnx_runtime_without_gpu_states_why_it_uses_the_cpu(tiny: Path) -> None:
    if set(ort.get_available_providers()) & {TENSORRT, CUDA}:
        pytest.skip("this ONNX Runtime has a GPU provider")
    model = opened(tiny)
    assert model.provider == CPU
    assert [one.provider for one in model.rejected_providers] == [TENSORRT, CUDA]
    assert "built without it, it has" in str(model.rejected_providers[0]) and "CPU" in str(model.rejected_providers[0])


def test_an_output_with_nan_is_rejected_and_the_next_run_succeeds(tiny: Path) -> None:
    model = opened(tiny)
    with pytest.raises(ModelRunError, match="'descriptors' has NaN or infinite values"):
        model.run(BLUE)
    assert np.isfinite(model.run(GRAY)[0]).all()
    assert model.run_count == 1


@pytest.mark.parametrize("shape", [(1, 1, 64, 64), (1, 3, 64), (2, 3, 0, 64)])
def test_an_input_of_the_wrong_shape_is_rejected_and_the_provider_is_kept(tiny: Path, shape: tuple[int, ...]) -> None:
    model = opened(tiny)
    with pytest.raises(ModelRunError, match=r"tiny\.onnx: "):
        model.run(np.zeros(shape, np.float32))
    assert len(model.run(GRAY)) == 1 and model.provider == CPU


def spoilt(path: Path, kind: str) -> None:
    content = path.read_bytes()
    described = path.with_suffix(".toml")
    match kind:
        case "absent":
            path.unlink()
        case "a folder":
            path.unlink()
            path.mkdir()
        case "cut off":
            path.write_bytes(content[: len(content) // 2])
        case "one bit":
            path.write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
        case "not onnx":
            tiny_onnx.write(path.parent, tiny_onnx.XFEAT_LIKE, b"<html>not found</html>")
        case "never a number":
            tiny_onnx.write(path.parent, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like("always"))
        case "other channels":
            described.write_text(described.read_text().replace("64, ", "32, "))
        case "other type":
            described.write_text(
                described.read_text().replace('"height/8", "width/8"]', '"height/8", "width/8"]\ndtype = "int64"')
            )
        case "other tensors":
            inputs: dict[str, tuple[tiny_onnx.Shape, str]] = {"picture": ([1, 3, 8, 8], "float32")}
            content = tiny_onnx.constants(inputs, {"features": np.zeros((1, 2), np.float32)})
            tiny_onnx.write(path.parent, tiny_onnx.XFEAT_LIKE, content)


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("absent", "no such model file; check the path"),
        ("a folder", "cannot be read"),
        ("cut off", "not the published file"),
        ("one bit", "not the published file"),
        ("not onnx", "cannot be run"),
        ("never a number", "output 'descriptors' has NaN"),
        ("other channels", "output 'descriptors' is"),
        ("other type", "is float32, not int64"),
        ("other tensors", "has inputs ['picture'] and outputs ['features'], expected ('input',)"),
    ],
)
def test_an_unusable_model_file_is_rejected_with_one_line(tiny: Path, kind: str, says: str) -> None:
    spoilt(tiny, kind)
    with pytest.raises(ModelFileError) as error:
        opened(tiny)
    assert says in str(error.value) and str(tiny) in str(error.value) and "\n" not in str(error.value)


def test_a_bound_session_gives_the_outputs_of_a_plain_one_and_keeps_its_buffers(tiny: Path) -> None:
    session = ort.InferenceSession(tiny.read_bytes(), providers=[CPU])
    bound = runtime.BoundSession(session, ("descriptors", "reliability"), "cpu")
    rng, kept = np.random.default_rng(2), []
    for shape in ((1, 3, 64, 64), (1, 3, 32, 64), (1, 3, 64, 64)):
        feed = {"input": rng.random(shape, dtype=np.float32)}
        expected = session.run(["descriptors", "reliability"], feed)
        found = bound.run(feed)
        assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))
        kept.append((found[0], expected[0], bound._inputs[(shape,)]["input"].data_ptr()))
    assert all(np.array_equal(found, expected) for found, expected, _ in kept)  # not overwritten by later runs
    assert kept[0][2] == kept[2][2] != kept[1][2]
    for side in range(runtime.MAX_BOUND_SHAPES):
        bound.run({"input": np.zeros((1, 3, 8 + 8 * side, 8), np.float32)})
    assert 0 < len(bound._inputs) <= runtime.MAX_BOUND_SHAPES


class Binding:
    """Substitute of ONNX Runtime's IOBinding: keeps what is bound, for buffers of the processor."""

    def __init__(self) -> None:
        self.feed: dict[str, np.ndarray] = {}
        self.names: list[str] = []
        self.results: list[np.ndarray] = []

    def bind_ortvalue_input(self, name: str, value: Any) -> None:
        self.feed[name] = value.numpy()

    def bind_output(self, name: str, device: str, device_id: int) -> None:
        assert (device, device_id) == ("cpu", 0)
        self.names.append(name)

    def copy_outputs_to_cpu(self) -> list[np.ndarray]:
        return self.results


class Machine:
    """Simulates a computer with a GPU in ONNX Runtime: sessions compute on the CPU and fail on request."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.fails: dict[str, str] = {}  # provider -> "start", "session", "memory", "nonsense"
        self.options: list[dict[str, str]] = []  # options of each TensorRT session
        self.builds = True  # whether TensorRT writes an engine
        self.ran: list[tuple[int, ...]] = []  # input shapes of all runs on CUDA
        real, owner = ort.InferenceSession, self

        class Session:
            def __init__(self, content: bytes, options: Any, *, providers: list[Any], enable_fallback: int) -> None:
                assert enable_fallback == 0 and providers[-1] == CPU
                first = providers[0]
                self.name = first if isinstance(first, str) else first[0]
                if self.name == TENSORRT:
                    owner.options.append(first[1])
                    if owner.builds:
                        (Path(first[1]["trt_engine_cache_path"]) / "graph.engine").write_bytes(b"engine")
                if owner.fails.get(self.name) == "session":
                    raise RuntimeError("CUDA failure 2: out of memory\nat line 7")
                self.real = real(content, options, providers=[CPU], enable_fallback=0)

            def get_providers(self) -> list[str]:
                return [CPU if owner.fails.get(self.name) == "start" else self.name]

            def get_inputs(self) -> Any:
                return self.real.get_inputs()

            def get_outputs(self) -> Any:
                return self.real.get_outputs()

            def io_binding(self) -> "Binding":
                return Binding()

            def run_with_iobinding(self, binding: "Binding") -> None:
                binding.results = self.run(binding.names, binding.feed)

            def run(self, names: list[str], feed: dict[str, np.ndarray]) -> list[np.ndarray]:
                if self.name == CUDA:
                    owner.ran += [one.shape for one in feed.values()]
                match owner.fails.get(self.name):
                    case "memory":
                        raise ort_state.Fail("Failed to allocate memory for requested buffer of size 99")
                    case "nonsense":
                        return [np.full_like(one, np.inf) for one in self.real.run(names, feed)]
                return self.real.run(names, feed)

        patch.setattr(ort, "InferenceSession", Session)
        patch.setattr(providers, "MEMORY", {TENSORRT: "cpu", CUDA: "cpu"})
        patch.setattr(ort, "get_available_providers", lambda: [TENSORRT, CUDA, CPU])
        patch.setattr(gpu, "gpu_name", lambda: "Orin (nvgpu)")
        patch.setattr(gpu, "tensorrt_version", lambda: "100300")


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


def test_no_tensorrt_engine_is_built_in_flight(tiny: Path, machine: Machine) -> None:
    model = opened(tiny)
    assert model.provider == CUDA and machine.options == []
    (over,) = model.rejected_providers
    assert over.provider == TENSORRT and "no engine" in over.reason and "terrafix models build" in over.reason


def test_all_preset_sizes_are_run_once_before_take_off(tiny: Path, machine: Machine) -> None:
    model = opened(tiny)
    assert model.provider == CUDA and machine.ran == [(1, 3, 32, 64), (1, 3, 64, 64)]


def test_a_model_without_presets_does_not_use_tensorrt(tiny: Path, machine: Machine) -> None:
    described = tiny.with_suffix(".toml")
    described.write_text(described.read_text().split("[[presets]]")[0])
    model = opened(tiny, build=True)
    assert model.provider == CUDA and "has no preset" in model.rejected_providers[0].reason
    assert machine.ran == [(1, 3, runtime.WARM_UP_SIZE, runtime.WARM_UP_SIZE)]


def test_a_built_tensorrt_engine_is_used(tiny: Path, machine: Machine) -> None:
    assert opened(tiny, build=True).provider == TENSORRT
    machine.options.clear()
    model = opened(tiny)
    assert model.provider == TENSORRT and model.rejected_providers == []
    assert [o["trt_profile_opt_shapes"] for o in machine.options] == ["input:1x3x32x64", "input:1x3x64x64"]
    for options in machine.options:
        assert options["trt_profile_min_shapes"] == options["trt_profile_max_shapes"]
        assert (options["trt_fp16_enable"], options["trt_engine_cache_enable"]) == ("True", "True")
        ready = json.loads((Path(options["trt_engine_cache_path"]) / providers.READY).read_text())
        assert ready["precision"] == "fp16"
    assert len(model.run(GRAY)) == 1


def test_an_engine_is_specific_to_model_gpu_tensorrt_precision_and_size(
    tiny: Path, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    presets = manifest.read(tiny.with_suffix(".toml")).presets
    folder = providers.engine_folder(tiny.parent, "a" * 64, presets[0])
    others = [
        providers.engine_folder(tiny.parent, "b" * 64, presets[0]),
        providers.engine_folder(tiny.parent, "a" * 64, presets[1]),
        providers.engine_folder(tiny.parent, "a" * 64, manifest.Preset(sizes=presets[0].sizes, precision="fp32")),
    ]
    with monkeypatch.context() as patch:
        patch.setattr(gpu, "gpu_name", lambda: "Xavier")
        others.append(providers.engine_folder(tiny.parent, "a" * 64, presets[0]))
    with monkeypatch.context() as patch:
        patch.setattr(gpu, "tensorrt_version", lambda: "8601")
        others.append(providers.engine_folder(tiny.parent, "a" * 64, presets[0]))
    assert len({folder, *others}) == 6


def test_an_incomplete_engine_is_not_used(tiny: Path, machine: Machine) -> None:
    machine.fails[TENSORRT] = "memory"
    built = opened(tiny, build=True)
    assert built.provider == CUDA and "Failed to allocate memory" in built.rejected_providers[0].reason
    del machine.fails[TENSORRT]
    assert opened(tiny).provider == CUDA
    machine.builds = False  # an engine folder that is marked as ready but has no engine file
    opened(tiny, build=True)
    for engine in tiny.parent.rglob("*.engine"):
        engine.unlink()
    assert opened(tiny).provider == CUDA


@pytest.mark.parametrize(("kind", "says"), [("start", "could not start it"), ("session", "out of memory")])
def test_a_provider_that_does_not_start_is_skipped(tiny: Path, machine: Machine, kind: str, says: str) -> None:
    machine.fails[CUDA] = kind
    model = opened(tiny)
    assert (
        model.provider == CPU
        and says in model.rejected_providers[1].reason
        and "\n" not in model.rejected_providers[1].reason
    )


def test_a_computer_without_cuda_device_uses_the_cpu(
    tiny: Path, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "gpu_name", lambda: None)
    model = opened(tiny)
    assert model.provider == CPU and {one.reason for one in model.rejected_providers} == {
        "the driver finds no CUDA device"
    }


@pytest.mark.parametrize(("kind", "says"), [("memory", "Failed to allocate memory"), ("nonsense", "has NaN")])
def test_a_provider_that_fails_in_flight_is_replaced_by_the_next_one(
    tiny: Path, machine: Machine, kind: str, says: str
) -> None:
    model = opened(tiny)
    before = model.run(GRAY)
    machine.fails[CUDA] = kind
    assert np.array_equal(model.run(GRAY), before)  # the same frame is run again on the next provider
    assert model.provider == CPU
    assert model.rejected_providers[-1].provider == CUDA and says in model.rejected_providers[-1].reason
    del machine.fails[CUDA]
    model.run(GRAY)
    assert model.provider == CPU  # no return to a provider that has failed


def test_every_run_raises_when_all_providers_have_failed(tiny: Path, machine: Machine) -> None:
    model = opened(tiny)
    machine.fails |= {CUDA: "memory", CPU: "session"}
    for _ in range(2):
        with pytest.raises(ModelRunError, match="tiny"):
            model.run(GRAY)


def test_a_frame_size_without_engine_runs_on_the_next_provider(tiny: Path, machine: Machine) -> None:
    opened(tiny, build=True)
    model = opened(tiny)
    assert model.side_lengths(20, 60) == (32, 64) and model.side_lengths(33, 10) == (64, 64)
    model.run(np.full((1, 3, *model.side_lengths(100, 60)), 0.5, np.float32))
    assert model.provider == CUDA and "no session for inputs" in model.rejected_providers[-1].reason


def test_on_the_cpu_a_frame_is_padded_only_to_the_stride(tiny: Path) -> None:
    assert opened(tiny).side_lengths(100, 57) == (104, 64)


def test_without_a_driver_there_is_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "CUDA", ("libnothing-of-that-name.so.7",))
    monkeypatch.setattr(gpu, "TENSORRT", ("libnothing-of-that-name.so.7",))
    assert gpu.gpu_name() is None and gpu.tensorrt_version() is None
