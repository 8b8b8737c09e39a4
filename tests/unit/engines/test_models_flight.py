"""A learned model that fails in flight: the failure is contained, published and recorded; then it is abandoned."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import tiny_onnx
from map_matches import position_of
from single_map_place import ORIGIN, SIDE_M, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.anchor.matching.frame_matcher import FrameMatcher, PatchFix
from terrafix.anchor.model_monitor import MAX_MODEL_FAILURES
from terrafix.anchor.node import AnchorNode, make_node
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.relocalizer import LOST_SIGMA_M
from terrafix.core.config import Config, Models
from terrafix.core.errors import ModelError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.messages import (
    Health,
    MapMatch,
    Message,
    ModelChange,
    ModelEvent,
    SearchStep,
    ThermalBand,
    Verdict,
)
from terrafix_engines.features import open_describer
from terrafix_engines.features.xfeat import XFeatDescriber
from terrafix_engines.providers import CUDA, RejectedProvider
from terrafix_engines.runtime import ModelRunError
from textured_ground import PINHOLE, texture, view

STARTED = msgspec.structs.replace(ORIGIN, t_ns=7)


@pytest.fixture
def no_gradient_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Patches of gradients give no pose while there is a model."""
    whole = FrameMatcher._fix_with

    def fix_with(self: FrameMatcher, describer: Describer, *seen: Any) -> PatchFix | None:
        return None if describer is not self._describer else whole(self, describer, *seen)

    monkeypatch.setattr(FrameMatcher, "_fix_with", fix_with)


class ModelFlight:
    """An anchor node with a model that fails on cells of pure blue, as ``blue`` has. ``seen``: the frame at TRUE_M."""

    def __init__(self, folder: Path, ground: np.ndarray, start_sigma_m: float = 10.0) -> None:
        tiny_onnx.write(folder, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like("blue"))
        describer = open_describer("tiny", str(folder))
        assert isinstance(describer, XFeatDescriber)
        self.describer, self.frames, self.frame_id = describer, MemoryFrameStore(4), 0
        self.seen = view(ground, PINHOLE, R, TRUE_M)
        self.blue = self.seen.copy()
        self.blue[100:200, 200:300] = (255, 0, 0)
        package: Any = SingleMapPackage(ground)
        self.node = AnchorNode(self.frames, package, describer, 1.0)
        self.begun = list(self.node.on(msgspec.structs.replace(STARTED, start_sigma_m=start_sigma_m)))

    def frame(self, image: np.ndarray, sigma_m: float = 10.0) -> tuple[MapMatch, list[ModelEvent]]:
        self.frame_id += 1
        self.frames.put(self.frame_id, image)
        published: list[Message] = list(self.node.on(predicted(self.frame_id, sigma_m)))
        (match,) = (m for m in published if isinstance(m, MapMatch))
        return match, [m for m in published if isinstance(m, ModelEvent)]


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, SIDE_M)


@pytest.fixture
def flight(tmp_path: Path, ground: np.ndarray) -> ModelFlight:
    return ModelFlight(tmp_path, ground)


def test_the_provider_and_the_reasons_against_better_ones_are_published(flight: ModelFlight) -> None:
    (event,) = flight.begun
    assert isinstance(event, ModelEvent)
    assert (event.t_ns, event.model, event.change) == (7, "xfeat", ModelChange.OPENED)
    assert event.provider and flight.describer.model.sha256[:12] in event.detail
    for over in flight.describer.model.rejected_providers:
        assert str(over) in event.detail


def test_without_need_the_model_does_not_run_and_the_match_says_so(flight: ModelFlight) -> None:
    match, events = flight.frame(flight.blue)
    assert (match.verdict, match.matcher, events) == (Verdict.ACCEPTED, "gradient", [])
    assert flight.describer.model.run_count == 0


@pytest.mark.usefixtures("no_gradient_pose")
def test_a_failed_inference_loses_one_frame_only(flight: ModelFlight) -> None:
    match, events = flight.frame(flight.blue)
    assert (match.verdict, match.search.step, match.matcher) == (Verdict.MODEL_FAILED, SearchStep.SKIP, "xfeat")
    assert match.pose is None
    assert [e.change for e in events] == [ModelChange.FAILED] and "has NaN" in events[0].detail
    match, events = flight.frame(flight.seen)
    assert match.verdict is not Verdict.MODEL_FAILED and match.matcher == "xfeat" and events == []


@pytest.mark.usefixtures("no_gradient_pose")
def test_a_model_that_always_fails_is_abandoned_and_the_flight_continues(flight: ModelFlight) -> None:
    for _ in range(MAX_MODEL_FAILURES):
        match, events = flight.frame(flight.blue)
    assert match.verdict is Verdict.MODEL_FAILED
    assert [e.change for e in events] == [ModelChange.FAILED, ModelChange.GIVEN_UP]
    match, events = flight.frame(flight.seen)
    assert (match.verdict, match.matcher, events) == (Verdict.ACCEPTED, "gradient", [])
    assert np.hypot(*(np.array(position_of(match)) - TRUE_M)[:2]) < 3.0


@pytest.mark.usefixtures("no_gradient_pose")
def test_only_consecutive_failures_count(flight: ModelFlight) -> None:
    for image in [*[flight.blue] * (MAX_MODEL_FAILURES - 1), flight.seen, *[flight.blue] * (MAX_MODEL_FAILURES - 1)]:
        match, _ = flight.frame(image)
    assert match.matcher == "xfeat"
    match, events = flight.frame(flight.blue)
    assert events[-1].change is ModelChange.GIVEN_UP


@pytest.mark.usefixtures("no_gradient_pose")
def test_a_learned_model_is_suspended_while_the_thermal_band_is_critical(flight: ModelFlight) -> None:
    changes = []
    for band in (ThermalBand.HOT, ThermalBand.CRITICAL, ThermalBand.CRITICAL, ThermalBand.NORMAL):
        health = Health(t_ns=0, band=band, temperature_c=96.0, throttled=False, disk_free_mb=None, cause="test")
        list(flight.node.on(health))
        match, events = flight.frame(flight.seen)
        changes.append((match.matcher, [event.change for event in events]))
    suspended, resumed = [ModelChange.SUSPENDED], [ModelChange.RESUMED]
    assert changes == [("xfeat", []), ("gradient", suspended), ("gradient", []), ("xfeat", resumed)]


def test_a_failed_provider_is_published(flight: ModelFlight) -> None:
    flight.describer.model.rejected_providers.append(RejectedProvider(CUDA, "failed while it ran: out of memory"))
    _, events = flight.frame(flight.seen)
    (event,) = events
    assert event.change is ModelChange.PROVIDER and event.detail == "CUDA: failed while it ran: out of memory"
    assert flight.frame(flight.seen)[1] == []


def test_a_failing_model_during_a_search_leaves_the_search_state_unchanged(
    tmp_path: Path, ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ModelRunError("no answer")

    monkeypatch.setattr(MapSearch, "process_frame", broken)
    flight = ModelFlight(tmp_path, ground, start_sigma_m=5000.0)
    for _ in range(MAX_MODEL_FAILURES):
        match, events = flight.frame(flight.seen, sigma_m=100.0)
        assert (match.verdict, match.search.sigma_m) == (Verdict.LOST, LOST_SIGMA_M)
    assert events[-1].change is ModelChange.GIVEN_UP
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    match, _ = flight.frame(flight.seen, sigma_m=100.0)
    assert (match.verdict, match.search.sigma_m, match.matcher) == (Verdict.LOST, LOST_SIGMA_M, "gradient")


def test_a_model_that_cannot_be_opened_is_an_error_on_the_ground_and_skipped_in_flight(tmp_path: Path) -> None:
    (tmp_path / "xfeat.onnx").write_bytes(b"half a file")
    config = Config(models=Models(xfeat=str(tmp_path / "xfeat.onnx")))

    def context(epoch_ns: int | None) -> NodeContext:
        return NodeContext(config, MemoryFrameStore(2), None, tmp_path, epoch_ns=epoch_ns)

    with pytest.raises(ModelError, match=r"xfeat\.onnx: cannot be run"):
        make_node(context(None))
    (event,) = make_node(context(5)).on(STARTED)
    assert isinstance(event, ModelEvent)
    assert (event.change, event.model) == (ModelChange.GIVEN_UP, "gradient") and "cannot be run" in event.detail


def test_a_model_runs_on_as_many_threads_as_the_process_has_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny_onnx.write(tmp_path, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like())
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3, 5, 7})
    describer = open_describer("tiny", str(tmp_path))
    assert isinstance(describer, XFeatDescriber)
    options = [session.get_session_options() for session in describer.model._sessions.values()]
    assert [one.intra_op_num_threads for one in options] == [3]
