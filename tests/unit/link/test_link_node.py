"""GPS_INPUT of the link node: prediction, age limits, jumps, degradation levels, silence, GPS time."""

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest

from link_rig import (
    ALT,
    LAT,
    LON,
    MS,
    SPEED_EAST,
    TICK_NS,
    S,
    covariance,
    east_error_m,
    estimate,
    every,
    fly,
    gps,
    texts,
)
from link_wire import WiredEdge
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import NodeContext
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, LinkCheckpointWriter
from terrafix.link.integrity import fix_type
from terrafix.link.integrity.output_predictor import (
    InertialBuffer,
    distance_m,
    offset,
    predict_to,
    worst_horizontal_variance,
)
from terrafix.link.node import LinkNode, make_node
from terrafix.link.output.gps_time import WEEK_MS, week_and_ms
from vision_origin import PINHOLE_ORIGIN


def no_messages(_: int) -> list[m.Message]:
    return []


def gps_since(published: list[m.Message], since_ns: int = 0) -> list[m.GpsInput]:
    return [g for g in gps(published) if g.t_ns >= since_ns]


def verdicts(published: list[m.Message]) -> list[m.MeasurementVerdict]:
    return [x for x in published if isinstance(x, m.MeasurementVerdict)]


# --- good estimates ---


def test_late_estimates_at_2_hz_give_accurate_gps_input_at_10_hz() -> None:
    published = fly(LinkNode(10.0), 0, 20 * S, every(500 * MS, lambda t: estimate(t, late_ns=300 * MS), 300 * MS))
    good = [g for g in gps(published) if g.fix_type == 3]
    assert len(good) >= 195
    assert max(abs(east_error_m(g)) for g in good) < 0.01
    assert all((b.t_ns - a.t_ns) == 100 * MS for a, b in pairwise(good))
    assert all(g.ve_mps == SPEED_EAST and g.vn_mps == 0.0 and g.alt_amsl_m == ALT for g in good)
    assert {v.verdict for v in verdicts(published)} == {m.Verdict.ACCEPTED}


def test_no_position_is_sent_twice() -> None:
    published = fly(LinkNode(10.0), 0, 10 * S, every(S // 2, estimate))
    places = [(g.lat_deg, g.lon_deg) for g in gps(published) if g.fix_type == 3]
    assert len(places) == len(set(places)) > 90


def test_the_link_node_is_deterministic() -> None:
    feed = every(300 * MS, lambda t: estimate(t, east_m=math.sin(t / S) * 3))
    assert fly(LinkNode(10.0), 0, 30 * S, feed) == fly(LinkNode(10.0), 0, 30 * S, feed)


def test_reported_accuracy_grows_with_the_age_of_the_estimate() -> None:
    published = fly(LinkNode(10.0), 0, 3 * S, lambda now: [estimate(now)] if now == 0 else [])
    grown = [g.horiz_accuracy_m for g in gps(published) if g.fix_type == 3]
    assert grown[0] == pytest.approx(4.0)
    assert all(b > a for a, b in pairwise(grown))
    # 4 m, 0.5 m/s and the 1.9 m/s^2 of a vehicle without attitude, after 0.7 s: there the speed passes 1.5 m/s
    unmodelled_m = 0.5 * 9.81 * math.tan(math.radians(30.0)) / 3.0 * 0.7**2
    assert grown[-1] == pytest.approx(math.sqrt(16 + 0.35**2 + unmodelled_m**2))


# --- no fix ---


def test_before_the_first_estimate_fix_type_is_1_without_a_position() -> None:
    node = LinkNode(10.0)
    origin = msgspec.structs.replace(PINHOLE_ORIGIN, ground_amsl_m=500.0)
    published = gps(fly(node, 0, 60 * S, lambda now: [origin] if now == 0 else []))
    assert len(published) == 600  # no silence before the first estimate: a booting autopilot must receive fix type 1
    assert {(g.fix_type, g.lat_deg, g.lon_deg, g.satellites_visible) for g in published} == {(1, 0.0, 0.0, 0)}
    assert {g.alt_amsl_m for g in published} == {500.0}
    assert {g.no_fix_reason for g in published} == {"no estimate yet"}


def test_a_stale_estimate_gives_fix_type_1_then_silence_and_recovers_immediately() -> None:
    def feed(now: int) -> list[m.Message]:
        level = m.VehicleState(t_ns=now, source="mavlink", yaw_rad=1.57, roll_rad=0.0, pitch_rad=0.0)
        return [level, *(every(500 * MS, estimate)(now) if now < 10 * S or now > 60 * S else [])]

    published = fly(LinkNode(10.0), 0, 62 * S, feed)
    last_estimate = 9_500 * MS
    for g in gps_since(published, S):
        assert g.fix_type == (3 if g.t_ns <= last_estimate + fix_type.MAX_PREDICTION_AGE_NS or g.t_ns > 60 * S else 1)
        assert g.fix_type == 3 or (g.lat_deg == g.lon_deg == 0.0 and "old" in g.no_fix_reason)
    quiet = [(a.t_ns, b.t_ns) for a, b in pairwise(gps(published)) if b.t_ns - a.t_ns > 200 * MS]
    assert len(quiet) == 1
    assert quiet[0][0] == pytest.approx(last_estimate + fix_type.SILENCE_AFTER_NS, abs=100 * MS)
    assert quiet[0][1] == pytest.approx(60 * S, abs=400 * MS)
    assert any("GPS_INPUT stopped" in t for t in texts(published))


def test_an_old_estimate_is_moved_on_by_inertial_readings_as_long_as_its_accuracy_allows() -> None:
    """Pictures that are 1.4 s late from one moment on: their estimates are 2.4 s old when the next one comes."""
    late_ns, samples = 1_900 * MS, [(0, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0)]

    def feed(now: int) -> list[m.Message]:
        level = m.VehicleState(t_ns=now, source="mavlink", yaw_rad=1.57, roll_rad=0.0, pitch_rad=0.0)
        readings = m.Imu(t_ns=now, source="mavlink", samples=samples)
        ends = now < 20 * S
        return [level, readings, *(every(500 * MS, estimate, late_ns)(now) if ends else [])]

    published = gps_since(fly(LinkNode(10.0), 0, 26 * S, feed), 4 * S)
    sent = [g for g in published if g.fix_type == 3]
    assert all(g in sent for g in published if g.t_ns < 20 * S)
    assert max(abs(east_error_m(g)) for g in sent) < 0.1
    assert sent[-1].t_ns < 22 * S and sent[-1].speed_accuracy_mps < 1.5  # then it is too inaccurate


@pytest.mark.parametrize(
    ("sigma_m", "sigma_mps", "fix_type"),
    [(4.0, 0.5, 3), (35.0, 0.5, 3), (60.0, 0.5, 1), (1e6, 0.5, 1), (4.0, 0.3, 3), (4.0, 1.0, 3), (4.0, 1.6, 1)],
)
def test_the_accuracy_of_position_and_speed_decides_the_fix_type(
    sigma_m: float, sigma_mps: float, fix_type: int
) -> None:
    feed = every(100 * MS, lambda t: estimate(t, sigma_m=sigma_m, velocity_sigma=sigma_mps))
    last = gps(fly(LinkNode(10.0), 0, 5 * S, feed))[-1]
    assert last.fix_type == fix_type and last.horiz_accuracy_m <= 100.0
    assert fix_type == 1 or (last.horiz_accuracy_m >= sigma_m and sigma_mps <= last.speed_accuracy_mps < 1.5)


def test_the_fix_type_has_hysteresis_at_the_accuracy_limit() -> None:
    published = fly(
        LinkNode(10.0), 0, 30 * S, every(200 * MS, lambda t: estimate(t, sigma_m=49.0 if (t // S) % 2 else 51.0))
    )
    assert sum(a.fix_type != b.fix_type for a, b in pairwise(gps(published))) <= 1


def test_a_withdrawn_fix_stays_away_for_a_second_and_returns_by_narrower_limits() -> None:
    """Estimates of a computer that is too slow: the speed accuracy crosses the limit ten times a second."""
    make = lambda t: estimate(t, velocity_sigma=1.6 if t % (200 * MS) else 1.4)  # noqa: E731
    slow = fly(LinkNode(10.0), 0, 20 * S, every(100 * MS, lambda t: estimate(t) if t < 2 * S else make(t)))
    assert sum(a.fix_type != b.fix_type for a, b in pairwise(gps(slow))) <= 2
    once = fly(
        LinkNode(10.0), 0, 9 * S, every(100 * MS, lambda t: estimate(t, velocity_sigma=9.0 if t == 5 * S else 0.5))
    )
    away = [g.t_ns for g in gps_since(once, 4 * S) if g.fix_type == 1]
    assert 900 * MS <= away[-1] - away[0] <= 1100 * MS
    assert {g.fix_type for g in gps_since(once, 7 * S)} == {3}


def test_a_position_that_no_place_stands_behind_is_no_fix() -> None:
    sent = gps(
        fly(LinkNode(10.0), 0, 3 * S, every(200 * MS, lambda t: estimate(t, source_label=m.SourceLabel.NOT_PLACED)))
    )
    assert {g.fix_type for g in sent} == {1} and sent[-1].no_fix_reason == "not found on the map yet"


def test_an_unknown_elevation_is_sent_with_the_largest_vertical_accuracy() -> None:
    sent = gps(fly(LinkNode(10.0), 0, 3 * S, every(200 * MS, lambda t: estimate(t, amsl_known=False))))
    assert sent[-1].fix_type == 3 and sent[-1].vert_accuracy_m == 100.0


def test_an_accuracy_spike_lowers_the_fix_instead_of_opening_the_gate() -> None:
    def make(t: int) -> m.NavEstimate:
        return estimate(t, sigma_m=30.0 if 5 * S <= t < 6 * S or t >= 10 * S else 3.0)

    sent = gps(fly(LinkNode(10.0), 0, 16 * S, every(200 * MS, make)))
    during = [g for g in sent if 5_300 * MS < g.t_ns < 6_100 * MS]
    assert {g.fix_type for g in during} == {1}
    assert all("at once" in g.no_fix_reason for g in during)
    assert {g.fix_type for g in sent if 6_500 * MS < g.t_ns < 10 * S} == {3}
    late = [g for g in sent if g.t_ns > 13 * S]  # a lasting increase is accepted
    assert {g.fix_type for g in late} == {3}
    assert min(g.horiz_accuracy_m for g in late) >= 30.0


GAP_S = 20


@pytest.mark.parametrize(
    ("sigma_m", "speed_mps", "reason", "until_s"),
    [
        (lambda after_s: 8.0 - 4.0 * after_s, 0.5, "first accuracy", 0.5),
        (lambda _: 12.0, 0.5, "first accuracy", 1.2),  # a coarse map is not better later
        (lambda _: 4.0, 1.35, "speed accuracy", 10.0),
    ],
)
def test_after_a_gap_the_first_accuracy_is_one_that_opens_the_alignment_checks(
    sigma_m: Callable[[float], float], speed_mps: float, reason: str, until_s: float
) -> None:
    """The firmware judges by the first sample after 5 s without a 3D fix (test_fact_after_20_s...)."""
    back_ns = (10 + GAP_S) * S

    def make(t: int) -> m.NavEstimate:
        after_s = (t - back_ns) / S
        return estimate(t, sigma_m=max(4.0, sigma_m(after_s)), velocity_sigma=speed_mps)

    node = LinkNode(10.0)
    fly(node, 0, 10 * S, every(100 * MS, lambda t: estimate(t, sigma_m=3.0)))
    fly(node, 10 * S, back_ns, lambda _: [])
    sent = gps(fly(node, back_ns, back_ns + 10 * S, every(100 * MS, make)))
    waits = [g for g in sent if g.t_ns > back_ns + 200 * MS and g.fix_type == 1]
    assert waits
    assert all(reason in g.no_fix_reason for g in waits)
    assert (waits[-1].t_ns - back_ns) / S <= until_s + 0.2
    again = [g for g in sent if g.t_ns > back_ns and g.fix_type == 3]
    assert not again or again[0].speed_accuracy_mps <= 1.3
    assert bool(again) is (until_s < 10.0)


def test_after_a_gap_below_5_s_no_better_accuracy_is_awaited() -> None:
    node = LinkNode(10.0)
    fly(node, 0, 10 * S, every(100 * MS, lambda t: estimate(t, sigma_m=3.0)))
    fly(node, 10 * S, 14 * S, lambda _: [])
    sent = gps(fly(node, 14 * S, 16 * S, every(100 * MS, lambda t: estimate(t, sigma_m=8.0, velocity_sigma=1.2))))
    assert {g.fix_type for g in sent if g.t_ns > 14_300 * MS} == {3}


# --- jumps ---


def test_a_single_350_m_jump_is_not_sent() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=350.0 if t == 5 * S else 0.0))
    published = fly(LinkNode(10.0), 0, 10 * S, feed)
    assert max(abs(east_error_m(g)) for g in gps(published) if g.fix_type == 3) < 1.0
    no_fix = [g for g in gps_since(published, S) if g.fix_type == 1]
    assert 3 <= len(no_fix) <= 6  # from its arrival to the next estimate
    assert all("350 m" in g.no_fix_reason for g in no_fix)
    wrong = [v for v in verdicts(published) if v.verdict is not m.Verdict.ACCEPTED]
    assert [(v.frame_id, v.verdict) for v in wrong] == [(5000, m.Verdict.IMPLAUSIBLE)]


def test_a_large_jump_is_accepted_after_consistent_estimates() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=300.0 if t >= 5 * S else 0.0))
    sent = gps(fly(LinkNode(10.0), 0, 15 * S, feed))
    first_wrong = next(g for g in sent if g.fix_type == 3 and east_error_m(g) > 100.0)
    assert 5 * S + 3 * S <= first_wrong.t_ns <= 5 * S + 4 * S
    assert {g.fix_type for g in sent if 5_200 * MS < g.t_ns < first_wrong.t_ns} == {1}
    assert {g.fix_type for g in sent if g.t_ns > first_wrong.t_ns} == {3}


def test_a_large_jump_within_the_claimed_covariance_still_needs_confirmation() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=250.0 if t >= 5 * S else 0.0, sigma_m=39.0))
    sent = gps(fly(LinkNode(10.0), 0, 12 * S, feed))
    assert {g.fix_type for g in sent if 5_200 * MS < g.t_ns < 7_500 * MS} == {1}
    assert sent[-1].fix_type == 3


def test_scattered_jumps_are_not_confirmed() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=(t // (500 * MS) % 7) * 400.0 + 1000.0 if t >= 5 * S else 0.0))
    sent = gps(fly(LinkNode(10.0), 0, 25 * S, feed))
    assert {g.fix_type for g in sent if g.t_ns > 5_200 * MS} == {1}


def test_a_small_jump_within_the_claimed_covariance_is_accepted() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=40.0 if t >= 5 * S else 0.0, sigma_m=10.0))
    assert {g.fix_type for g in gps(fly(LinkNode(10.0), 0, 10 * S, feed))[1:]} == {3}


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"lat_deg": math.nan}, m.Verdict.IMPLAUSIBLE),
        ({"lat_deg": 91.0}, m.Verdict.IMPLAUSIBLE),
        ({"alt_amsl_m": 20_000.0}, m.Verdict.IMPLAUSIBLE),
        ({"velocity_enu_mps": (150.0, 0.0, 0.0)}, m.Verdict.IMPLAUSIBLE),
        ({"velocity_enu_mps": (0.0, 0.0, 60.0)}, m.Verdict.IMPLAUSIBLE),
        ({"cov": (0.0,) * 36}, m.Verdict.IMPLAUSIBLE),
        ({"cov": covariance(4.0)[:6]}, m.Verdict.IMPLAUSIBLE),
        ({"velocity_sigma_mps": math.inf}, m.Verdict.IMPLAUSIBLE),
        ({"emitted_at_ns": 0}, m.Verdict.IMPLAUSIBLE),  # in the future
        ({"emitted_at_ns": 200 * S}, m.Verdict.STALE),
        ({"emitted_at_ns": 101_100 * MS}, m.Verdict.STALE),  # without readings since
    ],
)
def test_an_implausible_or_stale_estimate_is_rejected_with_a_reason(
    changes: dict[str, Any], verdict: m.Verdict
) -> None:
    node = LinkNode(10.0)
    (published,) = node.on(estimate(100 * S, **changes))
    assert isinstance(published, m.MeasurementVerdict)
    assert published.verdict is verdict
    assert published.detail
    assert {g.fix_type for g in gps(fly(node, 100 * S, 101 * S, no_messages))} == {1}


def test_an_older_estimate_does_not_replace_a_newer_one() -> None:
    node = LinkNode(10.0)
    node.tick(10 * S)
    verdicts_in_order = [next(iter(node.on(estimate(t)))) for t in (10 * S, 9 * S, 10 * S)]
    assert [a.verdict for a in verdicts_in_order] == ["accepted", "stale", "accepted"]  # type: ignore[attr-defined]


# --- degradation levels ---


def test_the_degradation_level_changes_accuracy_and_text() -> None:
    def make(t: int) -> m.NavEstimate:
        label = m.SourceLabel.SATELLITE_ANCHORED if t < 5 * S else m.SourceLabel.VISUAL_PROPAGATED
        return estimate(t, anchor_age_ms=max(0, (t - 5 * S) // MS), source_label=label)

    published = fly(LinkNode(10.0), 0, 60 * S, every(200 * MS, make, late_ns=20 * MS))
    accuracy = {s: next(g.horiz_accuracy_m for g in gps(published) if g.t_ns >= s * S) for s in (4, 12, 25, 50)}
    assert accuracy[4] < accuracy[12] < accuracy[25] < accuracy[50]
    assert accuracy[50] == pytest.approx(2 * accuracy[4], rel=0.05)
    ladder = [t for t in texts(published) if "map fix" in t]
    assert ladder == [f"Terrafix: no map fix for {s} s" for s in (5, 15, 35)]
    # Odometry continues, and the covariance covers its error.
    assert {g.fix_type for g in gps_since(published, 1 * S)} == {3}


def test_dead_reckoning_on_the_last_degradation_level_has_no_fix() -> None:
    feed = every(
        200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS, source_label=m.SourceLabel.DEAD_RECKONED, sigma_m=5.0)
    )
    sent = gps(fly(LinkNode(10.0), 0, 50 * S, feed))
    assert {g.fix_type for g in sent if S < g.t_ns < 34 * S} == {3}
    assert {g.fix_type for g in sent if g.t_ns > 36 * S} == {1}


def armed(t_ns: int, yes: bool | None) -> m.VehicleState:
    return m.VehicleState(t_ns=t_ns, source="mavlink", armed=yes)


GNSS_START = m.InitialPosition(
    t_ns=1, verdict=m.Verdict.ACCEPTED, lat_deg=LAT, lon_deg=LON, sigma_m=2.0, ground_amsl_m=None
)


@pytest.mark.parametrize(
    ("first_seen", "ground_fix", "received", "fix_type"),
    [
        (True, False, None, 1),
        (True, True, None, 1),
        (False, False, None, 1),
        (False, True, None, 3),
        (False, False, GNSS_START, 3),
        (False, False, msgspec.structs.replace(GNSS_START, verdict=m.Verdict.OUTSIDE_MAP), 1),
        (None, False, None, 3),
    ],
    ids=["in flight", "in flight, by mistake", "disarmed", "on the ground", "measured", "elsewhere", "no autopilot"],
)
def test_a_start_is_a_fix_before_the_map_if_it_was_measured_to_stand_or_stated_to(
    first_seen: bool | None, ground_fix: bool, received: m.InitialPosition | None, fix_type: int
) -> None:
    """After a restart in flight the estimate is at the start coordinate, with a small claimed covariance; disarmed, the
    vehicle may stand on a deck."""
    node = LinkNode(10.0, ground_fix=ground_fix)
    list(node.on(armed(0, first_seen)))
    if received is not None:
        list(node.on(received))
    unproved = fly(node, 0, 5 * S, every(500 * MS, lambda t: estimate(t, anchor_age_ms=-1)))
    assert {g.fix_type for g in gps_since(unproved, S)} == {fix_type}
    if first_seen is False:
        list(node.on(armed(5 * S, True)))  # takes off
    assert texts(unproved).count("Terrafix: started in flight, searching the map") == (first_seen is True)
    unproved = fly(node, 5 * S, 10 * S, every(500 * MS, lambda t: estimate(t, anchor_age_ms=-1)))
    assert {g.fix_type for g in gps_since(unproved, 6 * S)} == {fix_type}
    found = fly(node, 10 * S, 13 * S, every(500 * MS, lambda t: estimate(t, anchor_age_ms=200)))
    assert {g.fix_type for g in gps_since(found, 11 * S)} == {3}


def test_texts_about_a_flapping_fix_are_debounced() -> None:
    feed = every(200 * MS, lambda t: estimate(t, sigma_m=4.0 if (t // S) % 2 else 90.0, anchor_age_ms=0))
    published = fly(LinkNode(10.0), 0, 60 * S, feed)
    assert 2 <= len(texts(published)) <= 13
    assert all(len(t) <= 50 for t in texts(published))


def test_estimator_failure_and_overheating_are_reported_to_the_pilot() -> None:
    node = LinkNode(10.0)
    died = node.on(m.ProcessEvent(t_ns=0, process="estimator", event="died"))
    hot = node.on(
        m.Health(
            t_ns=0, band=m.ThermalBand.CRITICAL, temperature_c=97.0, throttled=True, disk_free_mb=None, cause="cpu"
        )
    )
    assert texts(list(died) + list(hot)) == ["Terrafix: estimator died", "Terrafix: computer is critical, 97 C"]
    assert gps(list(node.tick(0)))[0].no_fix_reason == "estimator died"
    assert not list(node.on(m.ProcessEvent(t_ns=0, process="recorder", event="died")))


# --- GPS time ---


def test_the_gps_week_is_that_of_the_predicted_position() -> None:
    node = LinkNode(10.0)
    unix = 1_795_000_000 * S
    node.on(m.WallClock(t_ns=50 * S, unix_ns=unix, source="system"))
    for g in gps(fly(node, 100 * S, 105 * S, every(500 * MS, estimate))):
        assert (g.time_week, g.time_week_ms) == week_and_ms(unix + g.t_ns - 50 * S)


def test_without_a_plausible_clock_the_gps_week_is_0() -> None:
    node = LinkNode(10.0)
    node.on(m.WallClock(t_ns=0, unix_ns=None, source="none"))
    assert {(g.time_week, g.time_week_ms) for g in gps(fly(node, 0, S, no_messages))} == {(0, 0)}


def run_with_clock_error(wrong_ns: Callable[[int], int], armed: bool | None) -> tuple[list[int], list[str]]:
    """Runs the node for a minute with a wall clock whose error is ``wrong_ns`` (a function of the time in ns).

    -> (steps of GPS time between successive GPS_INPUT [ms], details of the rejections)"""
    node, unix = LinkNode(10.0), 1_795_000_000 * S

    def feed(now: int) -> list[m.Message]:
        if now % S:
            return []
        vehicle = m.VehicleState(t_ns=now, source="mavlink", armed=armed)
        return [vehicle, m.WallClock(t_ns=now, unix_ns=unix + now + wrong_ns(now), source="autopilot")]

    published = fly(node, 0, 60 * S, feed)
    stamps = [g.time_week * WEEK_MS + g.time_week_ms for g in gps(published)]
    rejected = [x.detail for x in published if isinstance(x, m.MeasurementVerdict) and x.measurement == "wall clock"]
    return [b - a for a, b in pairwise(stamps)], rejected


def test_a_drifting_wall_clock_does_not_change_gps_time() -> None:
    steps, rejected = run_with_clock_error(lambda now: now // 200, armed=False)  # 0.5 % fast
    assert set(steps) == {100} and rejected == []


HOUR_MS = 3_600_000
TWENTY_YEARS_NS = 7305 * 24 * 3600 * S


@pytest.mark.parametrize("step_ms", [HOUR_MS, -25 * HOUR_MS, -600])
def test_on_the_ground_a_clock_step_is_accepted_after_20_s(step_ms: int) -> None:
    steps, rejected = run_with_clock_error(lambda now: 0 if now < 10 * S else step_ms * MS, armed=False)
    assert [(i, step) for i, step in enumerate(steps) if step != 100] == [(300 - 1, step_ms + 100)]
    assert len(rejected) == 20 and set(rejected) == {f"autopilot clock steps by {step_ms / 1000:.1f} s"}


@pytest.mark.parametrize("armed", [True, None])
@pytest.mark.parametrize("step_ns", [HOUR_MS * MS, -25 * HOUR_MS * MS, -600 * MS, TWENTY_YEARS_NS])
def test_in_flight_clock_steps_are_rejected(step_ns: int, armed: bool | None) -> None:
    """``armed`` None: unknown; it may be in flight because a GPS week was sent."""
    steps, rejected = run_with_clock_error(lambda now: 0 if now < 10 * S else step_ns, armed=armed)
    assert set(steps) == {100} and len(rejected) == 50


def test_a_clock_that_alternates_is_rejected() -> None:
    steps, _ = run_with_clock_error(lambda now: HOUR_MS * MS if now // (15 * S) % 2 else 0, armed=False)
    assert set(steps) == {100}


def test_a_clock_that_steps_twice_is_accepted_at_its_final_value() -> None:
    def wrong_ns(now: int) -> int:
        return HOUR_MS * MS * (0 if now < 10 * S else 1 if now < 25 * S else 2)

    steps, _ = run_with_clock_error(wrong_ns, armed=False)
    assert [(i, step) for i, step in enumerate(steps) if step != 100] == [(450 - 1, 2 * HOUR_MS + 100)]


def test_an_implausible_year_is_rejected_on_the_ground() -> None:
    steps, rejected = run_with_clock_error(lambda now: 0 if now < 10 * S else TWENTY_YEARS_NS, armed=False)
    assert set(steps) == {100} and "cannot be" in rejected[0]


def test_a_restarted_link_continues_with_the_clock_of_the_checkpoint(tmp_path: Path) -> None:
    unix = 1_795_000_000 * S
    first = LinkNode(10.0)
    first.on(m.WallClock(t_ns=50 * S, unix_ns=unix, source="system"))
    checkpoint = tmp_path / "link.checkpoint"
    LinkCheckpointWriter(checkpoint).on_heartbeat(ArmedAutopilot(1, 3, 1))
    link = WiredEdge(checkpoint=checkpoint)
    for sent in gps(fly(first, 100 * S, 101 * S, every(500 * MS, estimate))):
        link.edge.on_message(sent)
    second = make_node(NodeContext(Config(), MemoryFrameStore(), None, tmp_path, checkpoint=checkpoint))
    second.on(m.VehicleState(t_ns=102 * S, source="mavlink", armed=True))
    second.on(m.WallClock(t_ns=102 * S, unix_ns=unix - 25 * HOUR_MS * MS, source="system"))
    for sent in gps(fly(second, 102 * S, 103 * S, no_messages)):
        assert sent.time_week_ms == pytest.approx(week_and_ms(unix + sent.t_ns - 50 * S)[1], abs=2)


# --- jumps of the estimate ---


def test_accepted_jumps_are_counted_in_gps_input() -> None:
    node = LinkNode(10.0)
    published = fly(
        node, 0, 20 * S, every(500 * MS, lambda t_ns: estimate(t_ns, east_m=100.0 if t_ns > 10 * S else 0.0))
    )
    resets = [g.resets for g in gps(published) if g.fix_type == 3]
    assert resets[0] == 0 and resets[-1] == 1 and sorted(resets) == resets


# --- geometry ---


def test_offset_and_distance_agree_with_the_local_projection() -> None:
    for lat in (-60.0, 0.0, 48.0, 70.0):
        frame = LocalFrame(lat, 11.0)
        lat2, lon2 = offset(lat, 11.0, 300.0, -400.0)
        e_m, n_m = frame.to_local(lat2, lon2)
        assert (e_m, n_m) == pytest.approx((300.0, -400.0), abs=0.1)
        assert distance_m(lat, 11.0, lat2, lon2) == pytest.approx(500.0, abs=0.1)
    assert offset(0.0, 179.9999, 100.0, 0.0)[1] < -179.99


def test_horizontal_accuracy_is_the_worst_axis() -> None:
    cov = list(covariance(1.0))
    cov[0], cov[1], cov[6], cov[7] = 25.0, 24.0, 24.0, 25.0
    assert worst_horizontal_variance(cov) == pytest.approx(49.0)


def attitudes(yaw_rate: float, roll: float, end_ns: int) -> InertialBuffer:
    history = InertialBuffer()
    for t in range(0, end_ns + 1, 40 * MS):
        yaw = math.remainder(math.pi / 2 + yaw_rate * t / S, math.tau)
        history.add_attitude(m.VehicleState(t_ns=t, source="mavlink", yaw_rad=yaw, roll_rad=roll, pitch_rad=0.0))
    return history


def test_a_banked_turn_is_predicted_along_the_arc() -> None:
    bank = math.radians(25.0)
    rate = 9.81 * math.tan(bank) / SPEED_EAST
    predicted = predict_to(estimate(0), 1 * S, attitudes(rate, bank, 1 * S))
    radius = SPEED_EAST / rate
    true_lat, true_lon = offset(LAT, LON, radius * math.sin(rate), -radius * (1 - math.cos(rate)))
    straight_lat, straight_lon = offset(LAT, LON, SPEED_EAST, 0.0)
    assert distance_m(predicted.lat_deg, predicted.lon_deg, true_lat, true_lon) < 0.3
    assert distance_m(straight_lat, straight_lon, true_lat, true_lon) > 2.0
    ve, vn, _ = predicted.velocity_enu_mps
    assert math.hypot(ve - SPEED_EAST * math.cos(rate), vn + SPEED_EAST * math.sin(rate)) < 0.7


@pytest.mark.parametrize(("yaw_rate", "roll"), [(1.0, 0.0), (0.0, 0.4), (0.5, -0.4)])
def test_yaw_or_roll_alone_is_not_predicted_as_a_turn(yaw_rate: float, roll: float) -> None:
    predicted = predict_to(estimate(0), 1 * S, attitudes(yaw_rate, roll, 1 * S))
    assert predicted.velocity_enu_mps == pytest.approx((SPEED_EAST, 0.0, 0.0))


def test_an_old_attitude_is_not_used_for_prediction() -> None:
    blind = predict_to(estimate(2 * S), 3 * S, attitudes(0.0, 0.0, 1 * S))
    seeing = predict_to(estimate(2 * S), 3 * S, attitudes(0.0, 0.0, 3 * S))
    assert blind.horizontal_sigma_m > seeing.horizontal_sigma_m


def test_tick_rate_equals_the_process_table() -> None:
    from terrafix.link.node import TICK_HZ
    from terrafix.processes import PROCESSES

    assert next(p for p in PROCESSES if p.name == "link").tick_hz == TICK_HZ == S / TICK_NS
