"""What the link tells the autopilot: carry-forward, freshness, jumps, the ladder, silence, wall time."""

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

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
from link_wire import MemoryWire
from terrafix import messages as m
from terrafix.core.config import Config, LinkSection
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import NodeContext
from terrafix.link.autopilot.checkpoint import ArmedAutopilot, CheckpointWriter
from terrafix.link.edge import MavlinkEdge
from terrafix.link.integrity import fix_type
from terrafix.link.integrity.output_predictor import (
    Attitudes,
    distance_m,
    offset,
    predict_to,
    worst_horizontal_variance,
)
from terrafix.link.node import LinkNode, make_node
from terrafix.link.output.gps_time import WEEK_MS, week_and_ms


def nothing(_: int) -> list[m.Message]:
    return []


def reported(said: list[m.Message], since_ns: int = 0) -> list[m.GpsInput]:
    return [g for g in gps(said) if g.t_ns >= since_ns]


def verdicts(said: list[m.Message]) -> list[m.MeasurementVerdict]:
    return [x for x in said if isinstance(x, m.MeasurementVerdict)]


# --- the good flight ---


def test_late_estimates_at_2_hz_become_an_accurate_10_hz() -> None:
    said = fly(LinkNode(10.0), 0, 20 * S, every(500 * MS, lambda t: estimate(t, late_ns=300 * MS), 300 * MS))
    good = [g for g in gps(said) if g.fix_type == 3]
    assert len(good) >= 195
    assert max(abs(east_error_m(g)) for g in good) < 0.01
    assert all((b.t_ns - a.t_ns) == 100 * MS for a, b in pairwise(good))
    assert all(g.ve_mps == SPEED_EAST and g.vn_mps == 0.0 and g.alt_amsl_m == ALT for g in good)
    assert {v.verdict for v in verdicts(said)} == {m.Verdict.ACCEPTED}


def test_never_the_same_position_twice() -> None:
    said = fly(LinkNode(10.0), 0, 10 * S, every(1 * S, estimate))
    places = [(g.lat_deg, g.lon_deg) for g in gps(said) if g.fix_type == 3]
    assert len(places) == len(set(places)) > 90


def test_the_same_messages_give_the_same_output() -> None:
    feed = every(300 * MS, lambda t: estimate(t, east_m=math.sin(t / S) * 3))
    assert fly(LinkNode(10.0), 0, 30 * S, feed) == fly(LinkNode(10.0), 0, 30 * S, feed)


def test_covariance_grows_with_age() -> None:
    said = fly(LinkNode(10.0), 0, 3 * S, lambda now: [estimate(now)] if now == 0 else [])
    grown = [g.horiz_accuracy_m for g in gps(said) if g.fix_type == 3]
    assert grown[0] == pytest.approx(4.0)
    assert all(b > a for a, b in pairwise(grown))
    # 4 m, 0.5 m/s and the 1 m/s^2 of a vehicle without attitude, after 1.4 s: there the speed passes 1.5 m/s
    assert grown[-1] == pytest.approx(math.sqrt(16 + 0.7**2 + 0.98**2))


# --- no fix ---


def test_before_the_first_estimate_it_says_fix_1_and_no_position() -> None:
    node = LinkNode(10.0)
    origin = m.Origin(
        t_ns=0,
        camera=m.Camera(width=1, height=1, fx=1, fy=1, cx=0, cy=0),
        lat_deg=LAT,
        lon_deg=LON,
        ground_amsl_m=500.0,
        start_sigma_m=5,
        yaw_sigma_deg=1,
        agl_sigma_m=1,
        attitude_sigma_deg=1,
    )
    said = gps(fly(node, 0, 60 * S, lambda now: [origin] if now == 0 else []))
    assert len(said) == 600  # not silent: it never had anything, and a booting autopilot must see 1, not 0
    assert {(g.fix_type, g.lat_deg, g.lon_deg, g.satellites_visible) for g in said} == {(1, 0.0, 0.0, 0)}
    assert {g.alt_amsl_m for g in said} == {500.0}
    assert {g.reason for g in said} == {"no estimate yet"}


def test_stale_means_fix_1_then_silence_and_back_at_once() -> None:
    def feed(now: int) -> list[m.Message]:
        level = m.VehicleState(t_ns=now, source="mavlink", yaw_rad=1.57, roll_rad=0.0, pitch_rad=0.0)
        return [level, *(every(500 * MS, estimate)(now) if now < 10 * S or now > 60 * S else [])]

    said = fly(LinkNode(10.0), 0, 62 * S, feed)
    last_estimate = 9_500 * MS
    for g in reported(said, S):
        assert g.fix_type == (3 if g.t_ns <= last_estimate + fix_type.MAX_AGE_NS or g.t_ns > 60 * S else 1)
        assert g.fix_type == 3 or (g.lat_deg == g.lon_deg == 0.0 and "old" in g.reason)
    quiet = [(a.t_ns, b.t_ns) for a, b in pairwise(gps(said)) if b.t_ns - a.t_ns > 200 * MS]
    assert len(quiet) == 1
    assert quiet[0][0] == pytest.approx(last_estimate + fix_type.SILENT_AFTER_NS, abs=100 * MS)
    assert quiet[0][1] == pytest.approx(60 * S, abs=400 * MS)
    assert any("silent" in t for t in texts(said))


@pytest.mark.parametrize(("sigma_m", "fix_type"), [(4.0, 3), (35.0, 3), (60.0, 1), (1e6, 1)])
def test_covariance_decides_the_fix_type(sigma_m: float, fix_type: int) -> None:
    said = fly(LinkNode(10.0), 0, 5 * S, every(200 * MS, lambda t: estimate(t, sigma_m=sigma_m)))
    last = gps(said)[-1]
    assert last.fix_type == fix_type
    assert last.horiz_accuracy_m <= 100.0
    if fix_type == 3:
        assert last.horiz_accuracy_m >= sigma_m


@pytest.mark.parametrize(("sigma_mps", "fix_type"), [(0.3, 3), (1.0, 3), (1.6, 1)])
def test_speed_accuracy_above_1_5_lowers_the_fix(sigma_mps: float, fix_type: int) -> None:
    feed = every(100 * MS, lambda t: estimate(t, velocity_sigma=sigma_mps))
    last = gps(fly(LinkNode(10.0), 0, 5 * S, feed))[-1]
    assert last.fix_type == fix_type
    if fix_type == 3:
        assert sigma_mps <= last.speed_accuracy_mps < 1.5


def test_near_the_limit_the_fix_does_not_flap() -> None:
    said = fly(
        LinkNode(10.0), 0, 30 * S, every(200 * MS, lambda t: estimate(t, sigma_m=49.0 if (t // S) % 2 else 51.0))
    )
    assert sum(a.fix_type != b.fix_type for a, b in pairwise(gps(said))) <= 1


def test_an_accuracy_spike_lowers_the_fix_instead_of_opening_the_gate() -> None:
    def make(t: int) -> m.NavEstimate:
        return estimate(t, sigma_m=30.0 if 5 * S <= t < 6 * S or t >= 10 * S else 3.0)

    sent = gps(fly(LinkNode(10.0), 0, 16 * S, every(200 * MS, make)))
    during = [g for g in sent if 5_300 * MS < g.t_ns < 6_100 * MS]
    assert {g.fix_type for g in during} == {1}
    assert all("at once" in g.reason for g in during)
    assert {g.fix_type for g in sent if 6_500 * MS < g.t_ns < 10 * S} == {3}
    late = [g for g in sent if g.t_ns > 13 * S]  # a spike that stays is the truth
    assert {g.fix_type for g in late} == {3}
    assert min(g.horiz_accuracy_m for g in late) >= 30.0


# --- jumps ---


def test_one_wrong_estimate_of_350_m_never_goes_out() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=350.0 if t == 5 * S else 0.0))
    said = fly(LinkNode(10.0), 0, 10 * S, feed)
    assert max(abs(east_error_m(g)) for g in gps(said) if g.fix_type == 3) < 1.0
    held = [g for g in reported(said, S) if g.fix_type == 1]
    assert 3 <= len(held) <= 6  # from its arrival to the next estimate
    assert all("350 m" in g.reason for g in held)
    wrong = [v for v in verdicts(said) if v.verdict is not m.Verdict.ACCEPTED]
    assert [(v.frame_id, v.verdict) for v in wrong] == [(5000, m.Verdict.IMPLAUSIBLE)]


def test_a_big_correction_is_held_until_consistent_and_then_taken() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=300.0 if t >= 5 * S else 0.0))
    sent = gps(fly(LinkNode(10.0), 0, 15 * S, feed))
    first_wrong = next(g for g in sent if g.fix_type == 3 and east_error_m(g) > 100.0)
    assert 5 * S + 3 * S <= first_wrong.t_ns <= 5 * S + 4 * S
    assert {g.fix_type for g in sent if 5_200 * MS < g.t_ns < first_wrong.t_ns} == {1}
    assert {g.fix_type for g in sent if g.t_ns > first_wrong.t_ns} == {3}


def test_a_big_correction_is_held_even_if_the_claim_allows_it() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=250.0 if t >= 5 * S else 0.0, sigma_m=39.0))
    sent = gps(fly(LinkNode(10.0), 0, 12 * S, feed))
    assert {g.fix_type for g in sent if 5_200 * MS < g.t_ns < 7_500 * MS} == {1}
    assert sent[-1].fix_type == 3


def test_scattered_wrong_estimates_never_prove_themselves() -> None:
    feed = every(500 * MS, lambda t: estimate(t, east_m=(t // (500 * MS) % 7) * 400.0 + 1000.0 if t >= 5 * S else 0.0))
    sent = gps(fly(LinkNode(10.0), 0, 25 * S, feed))
    assert {g.fix_type for g in sent if g.t_ns > 5_200 * MS} == {1}


def test_a_correction_within_the_claims_passes() -> None:
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
        ({"emitted_at_ns": 0}, m.Verdict.IMPLAUSIBLE),  # of the future
        ({"emitted_at_ns": 200 * S}, m.Verdict.STALE),
    ],
)
def test_what_cannot_be_is_refused_with_a_reason(changes: dict[str, Any], verdict: m.Verdict) -> None:
    node = LinkNode(10.0)
    (said,) = node.on(estimate(100 * S, **changes))
    assert isinstance(said, m.MeasurementVerdict)
    assert said.verdict is verdict
    assert said.detail
    assert {g.fix_type for g in gps(fly(node, 100 * S, 101 * S, nothing))} == {1}


def test_an_older_estimate_does_not_replace_a_newer() -> None:
    node = LinkNode(10.0)
    node.tick(10 * S)
    answers = [next(iter(node.on(estimate(t)))) for t in (10 * S, 9 * S, 10 * S)]
    assert [a.verdict for a in answers] == ["accepted", "stale", "accepted"]  # type: ignore[attr-defined]


# --- the ladder ---


def test_the_caution_ladder_shows_in_accuracy_and_text() -> None:
    def make(t: int) -> m.NavEstimate:
        label = m.SourceLabel.SATELLITE_ANCHORED if t < 5 * S else m.SourceLabel.VISUAL_PROPAGATED
        return estimate(t, anchor_age_ms=max(0, (t - 5 * S) // MS), source_label=label)

    said = fly(LinkNode(10.0), 0, 60 * S, every(200 * MS, make, late_ns=20 * MS))
    accuracy = {s: next(g.horiz_accuracy_m for g in gps(said) if g.t_ns >= s * S) for s in (4, 12, 25, 50)}
    assert accuracy[4] < accuracy[12] < accuracy[25] < accuracy[50]
    assert accuracy[50] == pytest.approx(2 * accuracy[4], rel=0.05)
    ladder = [t for t in texts(said) if "map fix" in t]
    assert ladder == [f"Terrafix: no map fix for {s} s" for s in (5, 15, 35)]
    assert {g.fix_type for g in reported(said, 1 * S)} == {3}  # odometry holds, the covariance is honest


def test_dead_reckoning_on_the_last_rung_has_no_fix() -> None:
    feed = every(
        200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS, source_label=m.SourceLabel.DEAD_RECKONED, sigma_m=5.0)
    )
    sent = gps(fly(LinkNode(10.0), 0, 50 * S, feed))
    assert {g.fix_type for g in sent if S < g.t_ns < 34 * S} == {3}
    assert {g.fix_type for g in sent if g.t_ns > 36 * S} == {1}


def armed(t_ns: int, yes: bool | None) -> m.VehicleState:
    return m.VehicleState(t_ns=t_ns, source="mavlink", armed=yes)


@pytest.mark.parametrize(
    ("first_seen", "fix_type"),
    [(True, 1), (False, 3), (None, 3)],
    ids=["in flight", "on the ground", "no autopilot"],
)
def test_a_start_coordinate_is_no_fix_for_a_vehicle_that_already_flies(first_seen: bool | None, fix_type: int) -> None:
    """The computer was started again in the air: it begins where the flight began, and claims to be good."""
    node = LinkNode(10.0)
    list(node.on(armed(0, first_seen)))
    if first_seen is False:
        list(node.on(armed(1, True)))  # and then it took off
    unproved = fly(node, 0, 5 * S, every(500 * MS, lambda t: estimate(t, anchor_age_ms=-1)))
    assert {g.fix_type for g in reported(unproved, S)} == {fix_type}
    assert (texts(unproved).count("Terrafix: started in flight, searching the map") == 1) == (fix_type == 1)
    found = fly(node, 5 * S, 8 * S, every(500 * MS, lambda t: estimate(t, anchor_age_ms=200)))
    assert {g.fix_type for g in reported(found, 6 * S)} == {3}


def test_pilot_hears_fix_lost_and_found_without_a_flood() -> None:
    feed = every(200 * MS, lambda t: estimate(t, sigma_m=4.0 if (t // S) % 2 else 90.0, anchor_age_ms=0))
    said = fly(LinkNode(10.0), 0, 60 * S, feed)
    assert 2 <= len(texts(said)) <= 13
    assert all(len(t) <= 50 for t in texts(said))


def test_the_pilot_hears_of_a_dead_estimator_and_a_hot_computer() -> None:
    node = LinkNode(10.0)
    died = node.on(m.ProcessEvent(t_ns=0, process="estimator", event="died"))
    hot = node.on(
        m.Health(
            t_ns=0, band=m.ThermalBand.CRITICAL, temperature_c=97.0, throttled=True, disk_free_mb=None, cause="cpu"
        )
    )
    assert texts(list(died) + list(hot)) == ["Terrafix: estimator died", "Terrafix: computer is critical, 97 C"]
    assert gps(list(node.tick(0)))[0].reason == "estimator died"
    assert not list(node.on(m.ProcessEvent(t_ns=0, process="recorder", event="died")))


# --- wall time ---


def test_week_is_of_the_moment_the_position_was_carried_to() -> None:
    node = LinkNode(10.0)
    unix = 1_795_000_000 * S
    node.on(m.WallClock(t_ns=50 * S, unix_ns=unix, source="system"))
    for g in gps(fly(node, 100 * S, 105 * S, every(500 * MS, estimate))):
        assert (g.time_week, g.time_week_ms) == week_and_ms(unix + g.t_ns - 50 * S)


def test_without_a_plausible_clock_the_week_is_0() -> None:
    node = LinkNode(10.0)
    node.on(m.WallClock(t_ns=0, unix_ns=None, source="none"))
    assert {(g.time_week, g.time_week_ms) for g in gps(fly(node, 0, S, nothing))} == {(0, 0)}


def clock_said(wrong_ns: Callable[[int], int], armed: bool | None) -> tuple[list[int], list[str]]:
    """A minute with a wall clock that is ``wrong_ns`` (of the time) off, of a vehicle that is ``armed`` or not.

    -> (from one GPS_INPUT to the next, ms of GPS time; what was refused)"""
    node, unix = LinkNode(10.0), 1_795_000_000 * S

    def feed(now: int) -> list[m.Message]:
        if now % S:
            return []
        vehicle = m.VehicleState(t_ns=now, source="mavlink", armed=armed)
        return [vehicle, m.WallClock(t_ns=now, unix_ns=unix + now + wrong_ns(now), source="autopilot")]

    said = fly(node, 0, 60 * S, feed)
    stamps = [g.time_week * WEEK_MS + g.time_week_ms for g in gps(said)]
    refused = [x.detail for x in said if isinstance(x, m.MeasurementVerdict) and x.measurement == "wall clock"]
    return [b - a for a, b in pairwise(stamps)], refused


def test_a_creeping_wall_clock_does_not_bend_time() -> None:
    steps, refused = clock_said(lambda now: now // 200, armed=False)  # 0.5 % fast
    assert set(steps) == {100} and refused == []


HOUR_MS = 3_600_000
TWENTY_YEARS_NS = 7305 * 24 * 3600 * S


@pytest.mark.parametrize("step_ms", [HOUR_MS, -25 * HOUR_MS, -600])
def test_on_the_ground_a_step_of_the_clock_is_learnt_when_it_has_lasted(step_ms: int) -> None:
    steps, refused = clock_said(lambda now: 0 if now < 10 * S else step_ms * MS, armed=False)
    assert [(i, step) for i, step in enumerate(steps) if step != 100] == [(300 - 1, step_ms + 100)]
    assert len(refused) == 20 and set(refused) == {f"autopilot clock steps by {step_ms / 1000:.1f} s"}


@pytest.mark.parametrize("armed", [True, None])
@pytest.mark.parametrize("step_ns", [HOUR_MS * MS, -25 * HOUR_MS * MS, -600 * MS, TWENTY_YEARS_NS])
def test_in_flight_time_goes_on_whatever_the_clock_says(step_ns: int, armed: bool | None) -> None:
    """Not armed by nobody's word, and a week was sent: it may fly."""
    steps, refused = clock_said(lambda now: 0 if now < 10 * S else step_ns, armed=armed)
    assert set(steps) == {100} and len(refused) == 50


def test_a_clock_that_goes_back_and_forth_is_not_learnt() -> None:
    steps, _ = clock_said(lambda now: HOUR_MS * MS if now // (15 * S) % 2 else 0, armed=False)
    assert set(steps) == {100}


def test_a_clock_that_steps_on_is_learnt_where_it_stays() -> None:
    def wrong_ns(now: int) -> int:
        return HOUR_MS * MS * (0 if now < 10 * S else 1 if now < 25 * S else 2)

    steps, _ = clock_said(wrong_ns, armed=False)
    assert [(i, step) for i, step in enumerate(steps) if step != 100] == [(450 - 1, 2 * HOUR_MS + 100)]


def test_a_year_that_cannot_be_is_not_learnt_on_the_ground_either() -> None:
    steps, refused = clock_said(lambda now: 0 if now < 10 * S else TWENTY_YEARS_NS, armed=False)
    assert set(steps) == {100} and "cannot be" in refused[0]


def test_a_link_that_is_started_again_goes_on_with_the_time_of_before(tmp_path: Path) -> None:
    unix = 1_795_000_000 * S
    first = LinkNode(10.0)
    first.on(m.WallClock(t_ns=50 * S, unix_ns=unix, source="system"))
    keeper = CheckpointWriter(tmp_path / "link.checkpoint")
    keeper.heard(ArmedAutopilot(1, 3, 1))
    edge = MavlinkEdge(LinkSection(), MemoryWire(), lambda: 0, keeper=keeper)
    for sent in gps(fly(first, 100 * S, 101 * S, every(500 * MS, estimate))):
        edge.heard(sent)
    second = make_node(
        NodeContext(Config(), MemoryFrameStore(), None, tmp_path, checkpoint=tmp_path / "link.checkpoint")
    )
    second.on(m.VehicleState(t_ns=102 * S, source="mavlink", armed=True))
    second.on(m.WallClock(t_ns=102 * S, unix_ns=unix - 25 * HOUR_MS * MS, source="system"))
    for sent in gps(fly(second, 102 * S, 103 * S, nothing)):
        assert sent.time_week_ms == pytest.approx(week_and_ms(unix + sent.t_ns - 50 * S)[1], abs=2)


# --- steps of the estimate ---


def test_jumps_that_were_accepted_are_counted_in_what_is_sent() -> None:
    node = LinkNode(10.0)
    said = fly(node, 0, 20 * S, every(500 * MS, lambda t_ns: estimate(t_ns, east_m=100.0 if t_ns > 10 * S else 0.0)))
    resets = [g.resets for g in gps(said) if g.fix_type == 3]
    assert resets[0] == 0 and resets[-1] == 1 and sorted(resets) == resets


# --- geometry ---


def test_offset_and_distance_agree_with_the_projection() -> None:
    for lat in (-60.0, 0.0, 48.0, 70.0):
        frame = LocalFrame(lat, 11.0)
        lat2, lon2 = offset(lat, 11.0, 300.0, -400.0)
        e_m, n_m = frame.to_local(lat2, lon2)
        assert (e_m, n_m) == pytest.approx((300.0, -400.0), abs=0.1)
        assert distance_m(lat, 11.0, lat2, lon2) == pytest.approx(500.0, abs=0.1)
    assert offset(0.0, 179.9999, 100.0, 0.0)[1] < -179.99


def test_accuracy_is_the_worst_axis() -> None:
    cov = list(covariance(1.0))
    cov[0], cov[1], cov[6], cov[7] = 25.0, 24.0, 24.0, 25.0
    assert worst_horizontal_variance(cov) == pytest.approx(49.0)


def attitudes(yaw_rate: float, roll: float, end_ns: int) -> Attitudes:
    history = Attitudes()
    for t in range(0, end_ns + 1, 40 * MS):
        yaw = math.remainder(math.pi / 2 + yaw_rate * t / S, math.tau)
        history.add(m.VehicleState(t_ns=t, source="mavlink", yaw_rad=yaw, roll_rad=roll, pitch_rad=0.0))
    return history


def test_a_banked_turn_is_carried_along_the_arc() -> None:
    bank = math.radians(25.0)
    rate = 9.81 * math.tan(bank) / SPEED_EAST
    carried = predict_to(estimate(0), 1 * S, attitudes(rate, bank, 1 * S))
    radius = SPEED_EAST / rate
    true_lat, true_lon = offset(LAT, LON, radius * math.sin(rate), -radius * (1 - math.cos(rate)))
    straight_lat, straight_lon = offset(LAT, LON, SPEED_EAST, 0.0)
    assert distance_m(carried.lat_deg, carried.lon_deg, true_lat, true_lon) < 0.3
    assert distance_m(straight_lat, straight_lon, true_lat, true_lon) > 2.0
    ve, vn, _ = carried.velocity_enu_mps
    assert math.hypot(ve - SPEED_EAST * math.cos(rate), vn + SPEED_EAST * math.sin(rate)) < 0.7


@pytest.mark.parametrize(("yaw_rate", "roll"), [(1.0, 0.0), (0.0, 0.4), (0.5, -0.4)])
def test_yawing_or_leaning_alone_is_not_a_turn(yaw_rate: float, roll: float) -> None:
    carried = predict_to(estimate(0), 1 * S, attitudes(yaw_rate, roll, 1 * S))
    assert carried.velocity_enu_mps == pytest.approx((SPEED_EAST, 0.0, 0.0))


def test_old_attitude_is_no_attitude() -> None:
    blind = predict_to(estimate(2 * S), 3 * S, attitudes(0.0, 0.0, 1 * S))
    seeing = predict_to(estimate(2 * S), 3 * S, attitudes(0.0, 0.0, 3 * S))
    assert blind.horizontal_sigma_m > seeing.horizontal_sigma_m


def test_tick_is_at_the_rate_of_the_process_table() -> None:
    from terrafix.link.node import TICK_HZ
    from terrafix.processes import PROCESSES

    assert next(p for p in PROCESSES if p.name == "link").tick_hz == TICK_HZ == S / TICK_NS
