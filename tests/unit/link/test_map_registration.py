"""How far the map is off, as a trusted receiver shows it: learnt, taken out of what is sent, and of nothing else."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gnss_rig import READING_AGE_NS, reading, right, watched
from link_rig import LAT, LON, SPEED_EAST, S, estimate
from terrafix import messages as m
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, CheckpointWriter, load_checkpoint
from terrafix.link.autopilot.ekf_dead_reckoning import DeadReckoningRecorder
from terrafix.link.gnss.map_registration import REACH, SLEW_MPS, Batch, MapOffsets, Registration
from terrafix.link.integrity.output_predictor import Attitudes, apart_m, offset, predict_to
from terrafix.link.node import LinkNode

MAP_M = 3.5
OFF_M = 7.0  # east
CLAIMS = {"sigma_m": 4.0, "map_sigma_m": MAP_M}


def flown(node: LinkNode, seconds: float, *, begin_s: float = 0.0, gnss: bool = True) -> list[m.Message]:
    """The map is OFF_M off; the receiver by 1 m east and 1 m south."""
    where = right if gnss else lambda _: None
    return watched(node, seconds, where, begin_s=begin_s, ours=lambda _: OFF_M, **CLAIMS)


def learning(found: m.MapOffset | None = None) -> LinkNode:
    return LinkNode(10.0, map_offsets=MapOffsets(found))


def sent(heard: list[m.Message]) -> list[m.GpsInput]:
    return [x for x in heard if isinstance(x, m.GpsInput) and x.fix_type >= 3]


def off_m(gps: m.GpsInput) -> tuple[float, float]:
    return apart_m(offset(LAT, LON, SPEED_EAST * gps.t_ns / S, 0.0), (gps.lat_deg, gps.lon_deg))


def learnt(heard: list[m.Message]) -> list[m.MapOffset]:
    return [x for x in heard if isinstance(x, m.MapOffset)]


def test_at_a_place_it_is_what_the_covariance_that_is_moved_there_says() -> None:
    known = Registration(MAP_M)
    for i in range(8):
        known.take(Batch(20 * i * S, (LAT, LON), np.array([3.0, 1.0]), np.array([20.0, 2.0 * i]), 0.5))
        for way_m in (0.0, 3000.0, 40_000.0):
            place = offset(LAT, LON, way_m, 0.0)
            x, p = known._moved(place, 1.0)
            off_m, variance_m2 = known.at(place)
            assert off_m == pytest.approx(x[:2]) and variance_m2 == pytest.approx(np.linalg.eigvalsh(p[:2, :2])[-1])
        known.other_receiver()


def test_what_a_trusted_receiver_shows_is_taken_out_slowly_and_claimed() -> None:
    heard = flown(learning(), 240.0)
    positions = sent(heard)
    before, after = positions[100], positions[-1]
    assert off_m(before)[0] == pytest.approx(OFF_M, abs=0.3) and before.map_offset_m == (0.0, 0.0)
    # The receiver is 1 m east of the truth; along a straight course the age of its readings may be half of the rest.
    assert 1.0 < off_m(after)[0] < OFF_M - 1.5
    assert after.map_offset_m[0] == pytest.approx(OFF_M - off_m(after)[0], abs=0.3)
    assert after.horiz_accuracy_m < 0.95 * before.horiz_accuracy_m
    steps = np.diff([p.map_offset_m for p in positions], axis=0)
    assert np.hypot(*steps.T).max() <= SLEW_MPS * 0.13
    assert max(p.horiz_accuracy_m for p in positions[100:]) <= before.horiz_accuracy_m + 0.05
    said = [x.text for x in heard if isinstance(x, m.StatusText) and "map is" in x.text]
    assert len(said) == 1 and said[0].endswith("m off GPS 1")


def test_it_stays_when_the_receiver_is_gone() -> None:
    node = learning()
    before = sent(flown(node, 240.0))[-1]
    after = sent(flown(node, 30.0, begin_s=240.0, gnss=False))[-1]
    assert after.map_offset_m == pytest.approx(before.map_offset_m, abs=0.5)
    assert abs(off_m(after)[0]) < abs(off_m(before)[0]) + 0.5


def test_the_judge_compares_with_what_the_map_says() -> None:
    """Or a receiver would be judged by what it has taught."""
    verdicts = [x for x in flown(learning(), 240.0) if isinstance(x, m.GnssVerdict)]
    plain = [x for x in flown(LinkNode(10.0), 240.0) if isinstance(x, m.GnssVerdict)]
    assert verdicts == plain and verdicts[-1].distance_m == pytest.approx(6.1, abs=0.3)


def test_switched_off_nothing_is_learnt() -> None:
    heard = flown(LinkNode(10.0), 240.0)
    assert not learnt(heard) and sent(heard)[-1].map_offset_m == (0.0, 0.0)


def test_a_minute_before_a_receiver_loses_its_trust_counts_for_nothing() -> None:
    def drags(t_s: float) -> tuple[float, float]:
        return 1.0, -1.0 + max(0.0, t_s - 160.0)

    node = learning()
    heard = watched(node, 220.0, drags, ours=lambda _: OFF_M, **CLAIMS)
    spoofed_s = next(x.t_ns for x in heard if isinstance(x, m.GnssVerdict) and x.state is m.GnssState.SPOOFED) / S
    assert spoofed_s > 165.0
    assert max(x.t_ns for x in learnt(heard)) / S < spoofed_s - 60.0
    assert abs(sent(heard)[-1].map_offset_m[1]) < 1.5


@pytest.mark.parametrize("mps", [0.05, 0.1, 0.2])
def test_a_spoofer_who_is_too_slow_for_the_judge_gets_no_further_than_the_map_may_be_off(mps: float) -> None:
    heard = watched(learning(), 600.0, lambda t: (0.0, mps * t), **CLAIMS)
    taken_out = [math.hypot(*p.map_offset_m) for p in sent(heard)]
    assert max(taken_out) <= REACH * MAP_M + 0.01


def test_what_was_taken_out_may_have_been_a_lie_and_the_claim_says_so() -> None:
    after = sent(flown(learning(), 240.0))[-1]
    assert after.horiz_accuracy_m > 0.45 * math.hypot(*after.map_offset_m)


def batches(known: Registration, apart: list[tuple[float, float]], velocity: tuple[float, float]) -> None:
    """Every 20 s at one place, off by ``apart``."""
    for i, off in enumerate(apart):
        known.take(batch(i, off, velocity))


def batch(i: int, apart: tuple[float, float], velocity: tuple[float, float]) -> Batch:
    return Batch((i + 1) * 20 * S, (LAT, LON), np.array(apart), np.array(velocity), 1.0)


def test_the_age_of_readings_looks_the_same_until_the_vehicle_turns() -> None:
    straight, turning = Registration(MAP_M), Registration(MAP_M)
    batches(straight, [(3.0, 0.0)] * 12, (25.0, 0.0))
    for i in range(12):
        turning.take(batch(i, (3.0, 0.0), (25.0, 0.0) if i % 2 else (-25.0, 0.0)))
    assert straight.at((LAT, LON))[1] > 2.0 * turning.at((LAT, LON))[1]


def test_a_map_and_a_receiver_that_cannot_both_be_right_teach_nothing() -> None:
    known = Registration(MAP_M)
    batches(known, [(1.5 * REACH * MAP_M, 0.0)] * 8, (0.0, 0.0))
    off, variance_m2 = known.at((LAT, LON))
    assert not off.any() and variance_m2 == MAP_M**2


def test_far_from_where_it_was_learnt_the_map_is_unknown_again() -> None:
    known = Registration(MAP_M)
    batches(known, [(4.0, 0.0)] * 10, (0.0, 20.0))
    here, sigma2 = known.at((LAT, LON))
    far, far_sigma2 = known.at(offset(LAT, LON, 60_000.0, 0.0))
    assert here[0] > 2.0 and sigma2 < 0.4 * MAP_M**2
    assert abs(far[0]) < 0.1 and far_sigma2 == pytest.approx(MAP_M**2, rel=0.01)


def test_what_contradicts_is_not_taken_and_in_the_end_begins_anew() -> None:
    known = Registration(MAP_M)
    batches(known, [(0.0, 0.0)] * 10, (0.0, 0.0))
    assert known.take(batch(11, (12.0, 0.0), (0.0, 0.0))) is None
    assert abs(known.at((LAT, LON))[0][0]) < 0.1
    assert known.take(batch(12, (12.0, 0.0), (0.0, 0.0))) is None
    forgotten = known.take(batch(13, (12.0, 0.0), (0.0, 0.0)))
    assert forgotten is not None and forgotten.state == (0.0,) * 5


def test_another_receiver_errs_in_its_own_way() -> None:
    known = Registration(MAP_M)
    batches(known, [(2.0, 0.0)] * 30, (0.0, 0.0))
    before = known.at((LAT, LON))[1]
    known.other_receiver()
    assert known.at((LAT, LON))[1] == pytest.approx(before)
    for i in range(31, 50):
        known.take(batch(i, (2.0, 0.0), (0.0, 0.0)))
    assert known.at((LAT, LON))[1] < 0.8 * before


def test_claims_of_what_is_learnt_are_honest() -> None:
    """Mean squared error over claim, 2 when true, of 300 maps and receivers drawn as they are claimed. Of a twentieth
    nothing is taken out: the farthest, whose claim is then that of the map."""
    draw = np.random.default_rng(5)
    squared = []
    for _ in range(300):
        known, off, receiver = Registration(MAP_M), draw.normal(0.0, MAP_M, 2), draw.normal(0.0, 1.5, 2)
        late = draw.normal(0.0, 0.1)
        for i in range(9):
            velocity = 20.0 * np.array([math.cos(0.4 * i), math.sin(0.4 * i)])
            known.take(batch(i, tuple(off + receiver + late * velocity + draw.normal(0.0, 1.0, 2)), tuple(velocity)))
            keep = math.exp(-20.0 / 600.0)
            receiver = keep * receiver + draw.normal(0.0, 1.5 * math.sqrt(1.0 - keep**2), 2)
        told, variance_m2 = known.at((LAT, LON))
        squared.append(float(np.sum((told - off) ** 2)) / variance_m2)
    assert 1.6 < np.mean(squared) < 2.4


def test_each_layer_of_a_map_has_its_own() -> None:
    offsets = MapOffsets()
    for i in range(1200):
        t_ns = i * S // 5
        said = estimate(t_ns - READING_AGE_NS, east_m=OFF_M, **CLAIMS)
        vision = predict_to(said, t_ns - READING_AGE_NS, Attitudes())
        offsets.take(reading(t_ns, (0.0, 0.0)), vision, said, trusted=True)
        offsets.corrected(said, t_ns)
    assert offsets.corrected(said, t_ns)[1][0] > 2.0
    other = msgspec.structs.replace(said, map_sigma_m=2.0)
    _, at_first = offsets.corrected(other, t_ns + S // 10)
    _, later = offsets.corrected(other, t_ns + 60 * S)
    assert at_first[0] > 2.0 and later == (0.0, 0.0)


def test_readings_over_two_layers_are_no_batch_of_either() -> None:
    offsets = MapOffsets()
    for i in range(1200):
        t_ns = i * S // 5
        layer_m = MAP_M if i // 50 % 2 else 2.0  # ten seconds each, a batch takes twenty
        said = estimate(t_ns - READING_AGE_NS, east_m=OFF_M, **(CLAIMS | {"map_sigma_m": layer_m}))
        vision = predict_to(said, t_ns - READING_AGE_NS, Attitudes())
        assert offsets.take(reading(t_ns, (0.0, 0.0)), vision, said, trusted=True) is None


def test_the_next_link_goes_on_with_it(tmp_path: Path) -> None:
    heard = flown(learning(), 240.0)
    keeper = CheckpointWriter(tmp_path / "link")
    keeper.heard(ArmedAutopilot(1, 3, 1))
    keeper.learnt(learnt(heard)[-1])
    keeper.flies(None, 0.0)
    found = load_checkpoint(tmp_path / "link")
    assert found is not None
    restarted = learning(found.map_offset)
    assert sent(flown(restarted, 5.0, begin_s=240.0))[0].map_offset_m == pytest.approx(
        sent(heard)[-1].map_offset_m, abs=0.5
    )


def test_where_the_estimator_begins_again_is_on_the_map() -> None:
    """Coasted tells it our last fix, and it knows nothing of what was taken out."""
    coast = DeadReckoningRecorder(None, lambda boot_ns, _: boot_ns)
    heard = sent(flown(learning(), 240.0))
    t_ns = heard[-1].t_ns - 50_000_000
    lat, lon = (round(v * 1e7) for v in offset(LAT, LON, SPEED_EAST * t_ns / S, 0.0))
    coast.sent(heard[-2])
    message = mavlink.MAVLink_global_position_int_message(t_ns // 1_000_000, lat, lon, 0, 0, 0, 2000, 0, 0)
    assert not list(coast.take(message, t_ns, None))
    coast.sent(heard[-1])
    assert coast.last is not None
    east_m, _ = apart_m(offset(LAT, LON, SPEED_EAST * t_ns / S, 0.0), (coast.last.lat_deg, coast.last.lon_deg))
    assert east_m == pytest.approx(OFF_M, abs=0.5)
