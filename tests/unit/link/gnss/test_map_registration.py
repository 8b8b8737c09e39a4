"""Map offset: estimated with a trusted receiver, subtracted from GPS_INPUT and from nothing else."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gnss_rig import READING_AGE_NS, accurate, feed_receiver, reading
from link_rig import LAT, LON, SPEED_EAST, S, estimate
from terrafix import messages as m
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, LinkCheckpointWriter, load_checkpoint
from terrafix.link.autopilot.ekf_dead_reckoning import DeadReckoningRecorder
from terrafix.link.gnss.map_registration import (
    MAX_DISTANCE_SIGMAS,
    MAX_SLEW_MPS,
    Batch,
    MapOffsetEstimator,
    MapOffsetFilter,
)
from terrafix.link.integrity.output_predictor import InertialBuffer, east_north_m, offset, predict_to
from terrafix.link.node import LinkNode

MAP_M = 3.5
OFF_M = 7.0  # error of the map and so of the estimate, east
CLAIMS = {"sigma_m": 4.0, "map_sigma_m": MAP_M}


def fly_with_receiver(node: LinkNode, seconds: float, *, begin_s: float = 0.0, gnss: bool = True) -> list[m.Message]:
    """-> messages of a flight. Errors: of the map OFF_M east, of the receiver 1 m east and 1 m south."""
    where = accurate if gnss else lambda _: None
    return feed_receiver(node, seconds, where, begin_s=begin_s, ours=lambda _: OFF_M, **CLAIMS)


def node_with_map_offset(prior: m.MapOffset | None = None) -> LinkNode:
    return LinkNode(10.0, map_offsets=MapOffsetEstimator(prior))


def sent(published: list[m.Message]) -> list[m.GpsInput]:
    return [x for x in published if isinstance(x, m.GpsInput) and x.fix_type >= 3]


def off_m(gps: m.GpsInput) -> tuple[float, float]:
    return east_north_m(offset(LAT, LON, SPEED_EAST * gps.t_ns / S, 0.0), (gps.lat_deg, gps.lon_deg))


def map_offsets(published: list[m.Message]) -> list[m.MapOffset]:
    return [x for x in published if isinstance(x, m.MapOffset)]


def test_the_map_offset_at_a_place_equals_the_predicted_state_and_covariance_there() -> None:
    layer = MapOffsetFilter(MAP_M)
    for i in range(8):
        layer.update(Batch(20 * i * S, (LAT, LON), np.array([3.0, 1.0]), np.array([20.0, 2.0 * i]), 0.5))
        for way_m in (0.0, 3000.0, 40_000.0):
            place = offset(LAT, LON, way_m, 0.0)
            x, p = layer._predicted(place, 1.0)
            off_m, variance_m2 = layer.offset_at(place)
            assert off_m == pytest.approx(x[:2]) and variance_m2 == pytest.approx(np.linalg.eigvalsh(p[:2, :2])[-1])
        layer.reset_receiver()


def test_the_map_offset_from_a_trusted_receiver_is_applied_slowly_with_its_covariance() -> None:
    published = fly_with_receiver(node_with_map_offset(), 240.0)
    positions = sent(published)
    before, after = positions[100], positions[-1]
    assert off_m(before)[0] == pytest.approx(OFF_M, abs=0.3) and before.map_offset_m == (0.0, 0.0)
    # The receiver is 1 m east of the truth; along a straight course the age of its readings may be half of the rest.
    assert 1.0 < off_m(after)[0] < OFF_M - 1.5
    assert after.map_offset_m[0] == pytest.approx(OFF_M - off_m(after)[0], abs=0.3)
    assert after.horiz_accuracy_m < 0.95 * before.horiz_accuracy_m
    steps = np.diff([p.map_offset_m for p in positions], axis=0)
    assert np.hypot(*steps.T).max() <= MAX_SLEW_MPS * 0.13
    assert max(p.horiz_accuracy_m for p in positions[100:]) <= before.horiz_accuracy_m + 0.05
    pilot_texts = [x.text for x in published if isinstance(x, m.StatusText) and "map is" in x.text]
    assert len(pilot_texts) == 1 and pilot_texts[0].endswith("m off GPS 1")


def test_the_map_offset_stays_applied_after_the_loss_of_the_receiver() -> None:
    node = node_with_map_offset()
    before = sent(fly_with_receiver(node, 240.0))[-1]
    after = sent(fly_with_receiver(node, 30.0, begin_s=240.0, gnss=False))[-1]
    assert after.map_offset_m == pytest.approx(before.map_offset_m, abs=0.5)
    assert abs(off_m(after)[0]) < abs(off_m(before)[0]) + 0.5


def test_the_spoofing_detector_compares_with_the_uncorrected_estimate() -> None:
    """Otherwise a receiver would be compared with an estimate that it has corrected itself."""
    verdicts = [x for x in fly_with_receiver(node_with_map_offset(), 240.0) if isinstance(x, m.GnssVerdict)]
    plain = [x for x in fly_with_receiver(LinkNode(10.0), 240.0) if isinstance(x, m.GnssVerdict)]
    assert verdicts == plain and verdicts[-1].distance_m == pytest.approx(6.1, abs=0.3)


def test_a_disabled_map_offset_is_neither_estimated_nor_applied() -> None:
    published = fly_with_receiver(LinkNode(10.0), 240.0)
    assert not map_offsets(published) and sent(published)[-1].map_offset_m == (0.0, 0.0)


def test_readings_of_the_minute_before_a_loss_of_trust_are_not_learnt() -> None:
    def drags(t_s: float) -> tuple[float, float]:
        return 1.0, -1.0 + max(0.0, t_s - 160.0)

    node = node_with_map_offset()
    published = feed_receiver(node, 220.0, drags, ours=lambda _: OFF_M, **CLAIMS)
    spoofed_s = next(x.t_ns for x in published if isinstance(x, m.GnssVerdict) and x.state is m.GnssState.SPOOFED) / S
    assert spoofed_s > 165.0
    assert max(x.t_ns for x in map_offsets(published)) / S < spoofed_s - 60.0
    assert abs(sent(published)[-1].map_offset_m[1]) < 1.5


@pytest.mark.parametrize("mps", [0.05, 0.1, 0.2])
def test_an_undetected_slow_spoofer_moves_the_map_offset_no_further_than_the_stated_map_error(mps: float) -> None:
    published = feed_receiver(node_with_map_offset(), 600.0, lambda t: (0.0, mps * t), **CLAIMS)
    applied_m = [math.hypot(*p.map_offset_m) for p in sent(published)]
    assert max(applied_m) <= MAX_DISTANCE_SIGMAS * MAP_M + 0.01


def test_the_covariance_reaches_back_to_the_uncorrected_position() -> None:
    after = sent(fly_with_receiver(node_with_map_offset(), 240.0))[-1]
    assert after.horiz_accuracy_m > 0.45 * math.hypot(*after.map_offset_m)


def batches(layer: MapOffsetFilter, distances_m: list[tuple[float, float]], velocity: tuple[float, float]) -> None:
    """Updates ``layer`` with a batch every 20 s at one place. ``distances_m``: estimate minus receiver."""
    for i, distance_m in enumerate(distances_m):
        layer.update(batch(i, distance_m, velocity))


def batch(i: int, distance_m: tuple[float, float], velocity: tuple[float, float]) -> Batch:
    return Batch((i + 1) * 20 * S, (LAT, LON), np.array(distance_m), np.array(velocity), 1.0)


def test_reading_delay_and_map_offset_are_separated_by_turns() -> None:
    straight, turning = MapOffsetFilter(MAP_M), MapOffsetFilter(MAP_M)
    batches(straight, [(3.0, 0.0)] * 12, (25.0, 0.0))
    for i in range(12):
        turning.update(batch(i, (3.0, 0.0), (25.0, 0.0) if i % 2 else (-25.0, 0.0)))
    assert straight.offset_at((LAT, LON))[1] > 2.0 * turning.offset_at((LAT, LON))[1]


def test_no_map_offset_is_applied_while_map_and_receiver_contradict_each_other() -> None:
    layer = MapOffsetFilter(MAP_M)
    batches(layer, [(1.5 * MAX_DISTANCE_SIGMAS * MAP_M, 0.0)] * 8, (0.0, 0.0))
    offset_m, variance_m2 = layer.offset_at((LAT, LON))
    assert not offset_m.any() and variance_m2 == MAP_M**2


def test_far_from_its_place_the_map_offset_returns_to_the_prior() -> None:
    layer = MapOffsetFilter(MAP_M)
    batches(layer, [(4.0, 0.0)] * 10, (0.0, 20.0))
    here, sigma2 = layer.offset_at((LAT, LON))
    far, far_sigma2 = layer.offset_at(offset(LAT, LON, 60_000.0, 0.0))
    assert here[0] > 2.0 and sigma2 < 0.4 * MAP_M**2
    assert abs(far[0]) < 0.1 and far_sigma2 == pytest.approx(MAP_M**2, rel=0.01)


def test_a_batch_outside_the_gate_is_rejected_and_three_in_a_row_reset_the_filter() -> None:
    layer = MapOffsetFilter(MAP_M)
    batches(layer, [(0.0, 0.0)] * 10, (0.0, 0.0))
    assert layer.update(batch(11, (12.0, 0.0), (0.0, 0.0))) is None
    assert abs(layer.offset_at((LAT, LON))[0][0]) < 0.1
    assert layer.update(batch(12, (12.0, 0.0), (0.0, 0.0))) is None
    after_reset = layer.update(batch(13, (12.0, 0.0), (0.0, 0.0)))
    assert after_reset is not None and after_reset.state == (0.0,) * 5


def test_the_error_of_another_receiver_is_independent() -> None:
    layer = MapOffsetFilter(MAP_M)
    batches(layer, [(2.0, 0.0)] * 30, (0.0, 0.0))
    before = layer.offset_at((LAT, LON))[1]
    layer.reset_receiver()
    assert layer.offset_at((LAT, LON))[1] == pytest.approx(before)
    for i in range(31, 50):
        layer.update(batch(i, (2.0, 0.0), (0.0, 0.0)))
    assert layer.offset_at((LAT, LON))[1] < 0.8 * before


def test_the_covariance_of_the_map_offset_is_consistent_with_its_errors() -> None:
    """Mean NEES, 2 when consistent, over 300 maps and receivers that are drawn from their claims. Nothing is applied
    for the twentieth with the largest distances; their claim is that of the map."""
    draw = np.random.default_rng(5)
    nees = []
    for _ in range(300):
        layer, error_m, receiver = MapOffsetFilter(MAP_M), draw.normal(0.0, MAP_M, 2), draw.normal(0.0, 1.5, 2)
        delay_s = draw.normal(0.0, 0.1)
        for i in range(9):
            velocity = 20.0 * np.array([math.cos(0.4 * i), math.sin(0.4 * i)])
            distance_m = error_m + receiver + delay_s * velocity + draw.normal(0.0, 1.0, 2)
            layer.update(batch(i, tuple(distance_m), tuple(velocity)))
            correlation = math.exp(-20.0 / 600.0)
            receiver = correlation * receiver + draw.normal(0.0, 1.5 * math.sqrt(1.0 - correlation**2), 2)
        estimated, variance_m2 = layer.offset_at((LAT, LON))
        nees.append(float(np.sum((estimated - error_m) ** 2)) / variance_m2)
    assert 1.6 < np.mean(nees) < 2.4


def test_each_map_layer_has_its_own_offset() -> None:
    offsets = MapOffsetEstimator()
    for i in range(1200):
        t_ns = i * S // 5
        current = estimate(t_ns - READING_AGE_NS, east_m=OFF_M, **CLAIMS)
        vision = predict_to(current, t_ns - READING_AGE_NS, InertialBuffer())
        offsets.update(reading(t_ns, (0.0, 0.0)), vision, current, trusted=True)
        offsets.correct(current, t_ns)
    assert offsets.correct(current, t_ns)[1][0] > 2.0
    other = msgspec.structs.replace(current, map_sigma_m=2.0)
    _, at_first = offsets.correct(other, t_ns + S // 10)
    _, later = offsets.correct(other, t_ns + 60 * S)
    assert at_first[0] > 2.0 and later == (0.0, 0.0)


def test_readings_over_two_layers_are_not_one_batch() -> None:
    offsets = MapOffsetEstimator()
    for i in range(1200):
        t_ns = i * S // 5
        layer_m = MAP_M if i // 50 % 2 else 2.0  # ten seconds on each layer; a batch needs twenty
        current = estimate(t_ns - READING_AGE_NS, east_m=OFF_M, **(CLAIMS | {"map_sigma_m": layer_m}))
        vision = predict_to(current, t_ns - READING_AGE_NS, InertialBuffer())
        assert offsets.update(reading(t_ns, (0.0, 0.0)), vision, current, trusted=True) is None


def test_a_restarted_link_continues_with_the_map_offset_of_the_checkpoint(tmp_path: Path) -> None:
    published = fly_with_receiver(node_with_map_offset(), 240.0)
    checkpoint_writer = LinkCheckpointWriter(tmp_path / "link")
    checkpoint_writer.on_heartbeat(ArmedAutopilot(1, 3, 1))
    checkpoint_writer.on_map_offset(map_offsets(published)[-1])
    checkpoint_writer.on_fix(None, 0.0)
    checkpoint = load_checkpoint(tmp_path / "link")
    assert checkpoint is not None
    restarted = node_with_map_offset(checkpoint.map_offset)
    assert sent(fly_with_receiver(restarted, 5.0, begin_s=240.0))[0].map_offset_m == pytest.approx(
        sent(published)[-1].map_offset_m, abs=0.5
    )


def test_dead_reckoning_after_a_restart_starts_at_the_uncorrected_position() -> None:
    """The estimator works in the frame of the map, so the message must contain the uncorrected position."""
    recorder = DeadReckoningRecorder(None, lambda boot_ns, _: boot_ns)
    published = sent(fly_with_receiver(node_with_map_offset(), 240.0))
    t_ns = published[-1].t_ns - 50_000_000
    lat, lon = (round(v * 1e7) for v in offset(LAT, LON, SPEED_EAST * t_ns / S, 0.0))
    recorder.on_gps_input(published[-2])
    message = mavlink.MAVLink_global_position_int_message(t_ns // 1_000_000, lat, lon, 0, 0, 0, 2000, 0, 0)
    assert not list(recorder.on_message(message, t_ns, None))
    recorder.on_gps_input(published[-1])
    assert recorder.last is not None
    truth = offset(LAT, LON, SPEED_EAST * t_ns / S, 0.0)
    east_m, _ = east_north_m(truth, (recorder.last.lat_deg, recorder.last.lon_deg))
    assert east_m == pytest.approx(OFF_M, abs=0.5)
