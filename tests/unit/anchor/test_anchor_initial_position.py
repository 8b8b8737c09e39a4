"""Initial position from GNSS: check in the anchor, which has the map, and the whole chain from receiver to estimate."""

from typing import Any

import msgspec
import numpy as np
import pytest

from single_map_place import ORIGIN, SIDE_M, TRUE_M, R, SingleMapPackage, predicted
from terrafix import messages as m
from terrafix.anchor.node import AnchorNode
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.estimator.node import EstimatorNode
from terrafix.link.node import LinkNode
from terrafix.runtime.inbox import merge_predictions
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.in_process import InProcessShell
from textured_ground import PINHOLE, view

FRAME = LocalFrame(ORIGIN.lat_deg, ORIGIN.lon_deg)
UNKNOWN = msgspec.structs.replace(ORIGIN, start_sigma_m=5000.0)
GROUND_M, SIGMA_M = 37.0, 2.0
PLACE_M = (40.0, -30.0)
S = 1_000_000_000


class Place(SingleMapPackage):
    """A map of elevated ground that covers only this place."""

    def covers_start(self, lat_deg: float, lon_deg: float, sigma_m: float) -> bool:
        assert sigma_m == SIGMA_M
        return bool(np.max(np.abs(FRAME.to_local(lat_deg, lon_deg))) < SIDE_M / 2)

    def ground_amsl_m(self, _lat_deg: float, _lon_deg: float) -> float:
        return GROUND_M


def anchor(ground: np.ndarray) -> tuple[AnchorNode, MemoryFrameStore]:
    package: Any = Place(ground)
    frames = MemoryFrameStore(8)
    return AnchorNode(frames, package, GradientDescriber(), 1.0), frames


def gnss_start(t_ns: int, at_m: tuple[float, float] | None = PLACE_M) -> m.GnssInitialPosition:
    lat_deg, lon_deg = (None, None) if at_m is None else FRAME.to_wgs84(*at_m)
    sigma_m = None if at_m is None else SIGMA_M
    return m.GnssInitialPosition(t_ns=t_ns, lat_deg=lat_deg, lon_deg=lon_deg, sigma_m=sigma_m, receiver=0)


def test_every_gnss_start_is_answered_with_the_ground_height_of_the_map(ground: np.ndarray) -> None:
    node, _ = anchor(ground)
    start = gnss_start(S)
    (answer,) = node.on(start)
    place = {"lat_deg": start.lat_deg, "lon_deg": start.lon_deg, "sigma_m": SIGMA_M, "ground_amsl_m": GROUND_M}
    assert answer == m.InitialPosition(t_ns=S, verdict=m.Verdict.ACCEPTED, **place)  # type: ignore[arg-type]
    assert list(node.on(start)) == [answer]  # repeated for subscribers that missed it


def test_a_gnss_start_outside_the_map_is_rejected_and_invalidates_the_previous_one(ground: np.ndarray) -> None:
    node, _ = anchor(ground)
    list(node.on(gnss_start(S)))
    (answer,) = node.on(gnss_start(2 * S, (SIDE_M, 0.0)))
    assert isinstance(answer, m.InitialPosition)
    assert (answer.verdict, answer.lat_deg, answer.sigma_m) == (m.Verdict.OUTSIDE_MAP, None, None)
    (withdrawn,) = node.on(gnss_start(3 * S, None))
    assert isinstance(withdrawn, m.InitialPosition)
    assert (withdrawn.verdict, withdrawn.lat_deg, withdrawn.sigma_m) == (m.Verdict.ACCEPTED, None, None)


def test_the_first_prediction_based_on_a_start_ends_the_search(ground: np.ndarray) -> None:
    node, frames = anchor(ground)
    list(node.on(UNKNOWN))
    steps = []
    for frame_id, sigma_m, prior_t_ns in ((1, 100.0, 0), (2, 10.0, S), (3, 10.0, S)):
        frames.put(frame_id, view(ground, PINHOLE, R, TRUE_M))
        match, *_ = node.on(predicted(frame_id, sigma_m, prior_t_ns=prior_t_ns))
        assert isinstance(match, m.MapMatch)
        steps.append((match.verdict is m.Verdict.ACCEPTED, match.search.step))
    assert steps == [(False, m.SearchStep.WHOLE_MAP), (True, m.SearchStep.NORMAL), (True, m.SearchStep.NORMAL)]


def test_a_prediction_without_prior_time_after_an_estimator_restart_does_not_reset_the_anchor(
    ground: np.ndarray,
) -> None:
    node, frames = anchor(ground)
    list(node.on(UNKNOWN))
    for frame_id, sigma_m, prior_t_ns in ((1, 10.0, S), (2, 100.0, 0)):
        frames.put(frame_id, view(ground, PINHOLE, R, TRUE_M))
        match, *_ = node.on(predicted(frame_id, sigma_m, prior_t_ns=prior_t_ns))
        assert isinstance(match, m.MapMatch) and match.verdict is m.Verdict.ACCEPTED


def test_merged_predictions_are_the_newer_one_with_the_steps_of_both() -> None:
    older, newer = predicted(1, 100.0, step_m=3.0), predicted(2, 10.0, step_m=4.0, prior_t_ns=S)
    newer = msgspec.structs.replace(newer, radial_k1=0.01)
    merged = merge_predictions(older, newer)
    assert isinstance(merged, m.Prediction)
    assert merged.step_m == tuple(a + b for a, b in zip(older.step_m, newer.step_m, strict=True))
    assert merged.step_cov_m2 == tuple(a + b for a, b in zip(older.step_cov_m2, newer.step_cov_m2, strict=True))
    assert msgspec.structs.replace(merged, step_m=newer.step_m, step_cov_m2=newer.step_cov_m2) == newer


def test_a_gnss_start_reaches_the_estimate_through_link_anchor_and_estimator(ground: np.ndarray) -> None:
    """Nodes of the flight stack with a copter that stands, is armed, and whose receiver is spoofed afterwards."""
    messages: list[m.Message] = []
    nodes = {"link": LinkNode(10.0), "anchor": anchor(ground)[0], "estimator": EstimatorNode()}
    shell = InProcessShell(nodes, lambda _, message: messages.append(message))
    shell.feed(UNKNOWN)
    for step in range(200):
        t_ns, armed = step * S // 10, step >= 100
        state = {"yaw_rad": 0.0, "pitch_rad": 0.0, "roll_rad": 0.0, "agl_m": 0.3, "armed": armed}
        attitude = m.VehicleState(t_ns=t_ns, source="mavlink", **state)  # type: ignore[arg-type]
        nodes["link"].on(attitude)  # messages of the link's edge also reach the node of the same process
        shell.feed(attitude)
        if step % 2 == 0:
            lat_deg, lon_deg = FRAME.to_wgs84(PLACE_M[0] + 500.0 * armed, PLACE_M[1])
            receiver = {"receiver": 0, "fix_type": 3, "horizontal_m": SIGMA_M, "speed_mps": 0.1, "satellites": 12}
            reading = m.GnssReading(t_ns=t_ns, lat_deg=lat_deg, lon_deg=lon_deg, **receiver)  # type: ignore[arg-type]
            for answer in nodes["link"].on(reading):
                messages.append(answer)
                shell.feed(answer)
        if step % 5 == 0:
            shell.feed(m.Odometry(t_ns=t_ns, frame_id=step, keyframe_id=step, verdict=m.Verdict.NO_FEATURES))
        shell.tick(t_ns)
    found = [x for x in messages if isinstance(x, m.NavEstimate)]
    assert min(estimate.cov[0] for estimate in found if estimate.t_ns < 5 * S) > 4900.0**2  # before the GNSS start
    for estimate in (x for x in found if 5 * S <= x.t_ns < 10 * S):
        at_m = FRAME.to_local(estimate.lat_deg, estimate.lon_deg)
        assert at_m == pytest.approx(PLACE_M, abs=0.1) and estimate.cov[0] < (1.2 * SIGMA_M) ** 2
        assert estimate.alt_amsl_m == pytest.approx(GROUND_M + 0.3, abs=1.0)
    last = found[-1]  # ten seconds after arming, without a frame
    off_m = np.hypot(*np.subtract(FRAME.to_local(last.lat_deg, last.lon_deg), PLACE_M))
    assert off_m < 1.0
    texts = [x.text for x in messages if isinstance(x, m.StatusText) and "GNSS" in x.text]
    assert texts == ["Terrafix: start from GNSS, 2 m"]
    assert any(x.fix_type == 3 for x in messages if isinstance(x, m.GpsInput))
