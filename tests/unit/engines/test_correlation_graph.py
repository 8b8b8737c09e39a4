"""Correlation as an ONNX graph, on the CPU provider: values of NumPy, half precision, batches, failures."""

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
from typer.testing import CliRunner

from single_map_place import ORIGIN, SIDE_M, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.matching import frame_matcher
from terrafix.anchor.matching.ncc import CorrelationWindow
from terrafix.anchor.node import AnchorNode, make_node
from terrafix.core.config import Config, Models
from terrafix.core.errors import ModelError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.messages import MapMatch, ModelChange, ModelEvent, Verdict
from terrafix_engines import correlation
from terrafix_engines.correlation import BATCHES, GraphCorrelator, export, graph, open_correlator
from terrafix_engines.features.gradient import CHANNELS, GradientDescriber
from terrafix_engines.manifest import ManifestError, read
from terrafix_engines.providers import CPU
from terrafix_engines.runtime import ModelFileError, ModelRunError
from terrafix_tools.models.cli import app
from textured_ground import PINHOLE, texture, view


def run_graph(content: bytes, images: np.ndarray, templates: np.ndarray) -> np.ndarray:
    session = ort.InferenceSession(content, providers=[CPU])
    (found,) = session.run(["correlation"], {"images": images, "templates": templates})
    return np.asarray(found)


def by_numpy(images: np.ndarray, templates: np.ndarray) -> np.ndarray:
    spectrum = np.fft.rfft2(images.astype(float)) * np.fft.rfft2(templates.astype(float)).conj()
    return np.asarray(np.fft.irfft2(spectrum.sum(axis=1), s=images.shape[-2:]))


def random_cells(count: int, side: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.2, 1.0, (count, CHANNELS, side, side)).astype(np.float32)


@pytest.mark.parametrize(("side", "images", "templates"), [(24, 1, 3), (24, 3, 3), (15, 1, 1)])
def test_the_graph_has_the_circular_correlations_of_numpy(side: int, images: int, templates: int) -> None:
    a, b = random_cells(images, side, 1), random_cells(templates, side, 2)
    expected = by_numpy(a, b)
    found = run_graph(graph(side), a, b)
    assert found.shape == (templates, side, side) and found.dtype == np.float32
    assert np.abs(found - expected).max() < 1e-5 * expected.std()


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_in_half_precision_the_error_is_below_a_fiftieth_of_the_surface_and_nothing_overflows(scale: float) -> None:
    a, b = random_cells(1, 40, 3), scale * random_cells(2, 40, 4)
    b -= b.mean(axis=(2, 3), keepdims=True)
    expected = by_numpy(a, b)
    error = np.abs(run_graph(graph(40, half=True), a, b) - expected).max() / expected.std()
    assert 1e-5 < error < 0.02
    assert not run_graph(graph(40, half=True), a, np.zeros_like(b)).any()  # a template without energy


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> GraphCorrelator:
    monkeypatch.setattr(correlation, "SIDES", (48, 96))
    export(tmp_path, half=False)
    return open_correlator(str(tmp_path), (CPU,))


def test_a_window_is_correlated_as_by_opencv_with_one_template_and_with_many(small: GraphCorrelator) -> None:
    rng = np.random.default_rng(5)
    for width in (46, 90):  # the first on the small graph
        window = rng.normal(size=(CHANNELS, 45, width)).astype(np.float32)
        valid = np.ones((45, width), bool)
        valid[:12] = False
        templates = []
        for i in range(BATCHES[-1] + 2):
            mask = np.ones((16 + i, 20), bool)
            mask[:3, :4] = False
            templates.append((rng.normal(size=(CHANNELS, *mask.shape)).astype(np.float32), mask))
        plain, by_graph = CorrelationWindow(window, valid), CorrelationWindow(window, valid, correlator=small)
        expected = [plain.correlate(*one) for one in templates]
        found = [*by_graph.correlate_all(templates), by_graph.correlate(*templates[3])]
        assert np.isfinite(expected[0]).any() and np.isnan(expected[0]).any()
        for one, other in zip(found, [*expected, expected[3]], strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)
    assert [model.run_count for model in small._models.values()] == [3, 3]


def test_a_window_that_no_graph_holds_is_left_to_opencv(small: GraphCorrelator) -> None:
    assert small.correlate(np.zeros((CHANNELS, 97, 20), np.float32), [np.zeros((CHANNELS, 5, 5), np.float32)]) is None
    assert small.failure == ""


def test_the_anchor_matches_on_the_graph_and_continues_without_it_when_it_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_matcher, "MAX_WINDOW_CELLS", 130)  # half of the resolution: a faster test
    monkeypatch.setattr(correlation, "SIDES", (224,))
    export(tmp_path, half=True)
    by_graph, frames, ground = open_correlator(str(tmp_path), (CPU,)), MemoryFrameStore(4), texture(8, SIDE_M)
    package: Any = SingleMapPackage(ground)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0, correlator=by_graph)
    (opened,) = node.on(ORIGIN)
    assert isinstance(opened, ModelEvent)
    assert (opened.model, opened.change, opened.provider) == ("correlation", ModelChange.OPENED, "CPU")

    def matched(frame_id: int) -> tuple[MapMatch, list[ModelEvent]]:
        frames.put(frame_id, view(ground, PINHOLE, R, TRUE_M))
        published = list(node.on(predicted(frame_id, 10.0)))
        (match,) = (one for one in published if isinstance(one, MapMatch))
        return match, [one for one in published if isinstance(one, ModelEvent)]

    match, events = matched(1)
    model = by_graph._models[224]
    assert (match.verdict, events, model.run_count) == (Verdict.ACCEPTED, [], 1)

    def out_of_memory(*_: object) -> None:
        raise ModelRunError("out of memory")

    monkeypatch.setattr(model, "run", out_of_memory)
    match, events = matched(2)
    assert match.verdict is Verdict.ACCEPTED
    assert [(event.change, event.detail) for event in events] == [(ModelChange.GIVEN_UP, "out of memory")]
    match, events = matched(3)
    assert (match.verdict, events) == (Verdict.ACCEPTED, [])


def test_the_exported_graphs_have_manifests_with_presets_of_their_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(correlation, "SIDES", (24,))
    options: tuple[list[str], ...] = ([], ["--fp16"])
    for option, precision in zip(options, ("fp32", "fp16"), strict=True):
        done = CliRunner().invoke(app, ["export", "--folder", str(tmp_path), *option])
        assert done.exit_code == 0 and done.output == f"written to {tmp_path / 'correlation-24.onnx'}\n"
        manifest = read(tmp_path / "correlation-24.toml")
        assert [preset.sizes for preset in manifest.presets] == [{"images": 1, "templates": n} for n in (1, 3, 9)]
        assert {preset.precision for preset in manifest.presets} == {precision}
        assert (tmp_path / "correlation-24.onnx").stat().st_size == manifest.size_bytes


def test_without_graphs_or_without_a_gpu_the_configuration_is_refused_before_take_off_and_not_in_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: [CPU])
    monkeypatch.setattr(correlation, "SIDES", (24,))
    config = Config(models=Models(correlation="gpu", folder=str(tmp_path)))

    def context(epoch_ns: int | None) -> NodeContext:
        return NodeContext(config, MemoryFrameStore(2), None, tmp_path, epoch_ns=epoch_ns)

    with pytest.raises(ManifestError):
        open_correlator(str(tmp_path))
    with pytest.raises(ModelError, match=r"no model is called 'correlation-24'.*terrafix models export"):
        make_node(context(None))
    export(tmp_path, half=False)
    with pytest.raises(ModelFileError, match="built without it"):
        open_correlator(str(tmp_path))
    with pytest.raises(ModelError, match=r'built without it.*set \[models\] correlation = "cpu"'):
        make_node(context(None))
    assert list(make_node(context(5)).on(ORIGIN)) == []
