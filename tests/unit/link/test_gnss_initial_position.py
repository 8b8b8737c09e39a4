"""The start from GNSS: when the link says one, when it is silent, and what the pilot reads."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from link_rig import LAT, LON, MS, S, estimate, fly, texts
from terrafix import messages as m
from terrafix.link.gnss.initial_position import AWAY_SIGMAS, CARRIED_MPS, GOOD_M, STEADY_NS
from terrafix.link.gnss.spoofing_detector import LEAST_M, UNKNOWN_M
from terrafix.link.integrity.output_predictor import distance_m, offset
from terrafix.link.node import LinkNode

CAMERA = m.Camera(width=1, height=1, fx=1, fy=1, cx=0, cy=0)
NOBODY_SAID_M = 2000.0
Where = Callable[[float], tuple[float, float] | None]  # s -> metres east and north; None: no fix


def origin(start_sigma_m: float = NOBODY_SAID_M) -> m.Origin:
    sigmas = {"yaw_sigma_deg": 1.0, "agl_sigma_m": 1.0, "attitude_sigma_deg": 1.0}
    place = {"lat_deg": LAT, "lon_deg": LON, "ground_amsl_m": 500.0, "start_sigma_m": start_sigma_m}
    return m.Origin(t_ns=0, camera=CAMERA, **place, **sigmas)


def here(_: float) -> tuple[float, float]:
    return 300.0, -200.0


def reading(t_ns: int, at_m: tuple[float, float] | None, receiver: int = 0, **changes: Any) -> m.GnssReading:
    fields: dict[str, Any] = {"t_ns": t_ns, "receiver": receiver, "fix_type": 3, "satellites": 14, "horizontal_m": 2.0}
    fields |= {"speed_mps": 0.0, "lat_deg": None, "lon_deg": None}
    if at_m is None:
        fields |= {"fix_type": 1}
    else:
        fields["lat_deg"], fields["lon_deg"] = offset(LAT, LON, *at_m)
    return m.GnssReading(**fields | changes)


def state(t_ns: int, armed: bool | None) -> m.VehicleState:
    return m.VehicleState(t_ns=t_ns, source="mavlink", armed=armed)


def stood(
    where: Where = here,
    seconds: float = 20.0,
    *,
    node: LinkNode | None = None,
    armed: Callable[[float], bool | None] = lambda _: False,
    start_sigma_m: float = NOBODY_SAID_M,
    second: Where | None = None,
    also: Callable[[int], list[m.Message]] = lambda _: [],
    **changes: Any,
) -> list[m.Message]:
    """Attitudes at 10 Hz and readings at 5 Hz of one or two receivers."""

    def feed(now_ns: int) -> list[m.Message]:
        t_s, before_s = now_ns / S, max(0.0, now_ns / S - 0.2)
        said: list[m.Message] = [origin(start_sigma_m)] if now_ns == 0 else []
        said += [state(now_ns, armed(t_s))] if now_ns % (100 * MS) == 0 else []
        if now_ns % (200 * MS) == 0:
            at_m, before_m = where(t_s), where(before_s)
            speed = {} if at_m is None or before_m is None else {"speed_mps": math.dist(at_m, before_m) / 0.2}
            said += [reading(now_ns, at_m, **speed | changes)]
            said += [] if second is None else [reading(now_ns, second(t_s), 1)]
        return said + also(now_ns)

    return fly(node or LinkNode(10.0), 0, round(seconds * S), feed)


def starts(said: list[m.Message]) -> list[m.GnssStart]:
    """Each once."""
    found = {x.t_ns: x for x in said if isinstance(x, m.GnssStart)}
    return list(found.values())


def away_m(start: m.GnssStart, at_m: tuple[float, float]) -> float:
    assert start.lat_deg is not None and start.lon_deg is not None
    return distance_m(start.lat_deg, start.lon_deg, *offset(LAT, LON, *at_m))


def test_where_it_stood_for_five_seconds_is_the_start_and_said_again_every_second() -> None:
    said = stood()
    (start,) = starts(said)
    assert away_m(start, here(0.0)) < 0.1 and start.sigma_m == 2.0 and start.receiver == 0
    assert start.t_ns == STEADY_NS
    assert 14 <= sum(isinstance(x, m.GnssStart) for x in said) <= 16


@pytest.mark.parametrize(
    ("claimed_m", "sigma_m"), [(0.3, LEAST_M), (None, UNKNOWN_M), (GOOD_M, GOOD_M), (1.01 * GOOD_M, None), (25.0, None)]
)
def test_what_the_receiver_claims_is_the_sigma_within_bounds(claimed_m: float | None, sigma_m: float | None) -> None:
    found = starts(stood(horizontal_m=claimed_m))
    assert [start.sigma_m for start in found] == ([] if sigma_m is None else [sigma_m])


@pytest.mark.parametrize("changes", [{"fix_type": 2}, {"fix_type": 1}])
def test_a_fix_below_3d_is_none(changes: dict[str, Any]) -> None:
    assert not starts(stood(**changes))


def test_a_start_that_somebody_said_is_left_alone() -> None:
    assert not starts(stood(start_sigma_m=100.0))
    assert starts(stood(start_sigma_m=101.0))


def test_it_can_be_switched_off() -> None:
    assert not starts(stood(node=LinkNode(10.0, gnss_start=False)))


@pytest.mark.parametrize("armed", [None, True])
def test_nothing_is_taken_of_a_vehicle_that_may_fly(armed: bool | None) -> None:
    assert not starts(stood(armed=lambda _: armed))


def test_once_armed_it_is_over_and_a_landing_does_not_begin_it_again() -> None:
    assert not [x for x in stood(armed=lambda t: t > 3.0) if isinstance(x, m.GnssStart)]
    assert not starts(stood(seconds=60.0, armed=lambda t: 3.0 < t < 20.0))
    heard = stood(seconds=30.0, armed=lambda t: t > 10.0)
    assert max(x.t_ns for x in heard if isinstance(x, m.GpsInput)) > 29 * S
    said = [x for x in heard if isinstance(x, m.GnssStart)]
    assert len(said) <= 6  # and the repetitions end


def test_a_place_that_the_map_has_told_is_not_given_up_for_a_receiver() -> None:
    anchored = stood(also=lambda now: [estimate(now)] if now == S else [])
    assert not starts(anchored)
    unanchored = stood(also=lambda now: [estimate(now, anchor_age_ms=-1)] if now == S else [])
    assert starts(unanchored)


def test_a_vehicle_that_is_carried_on_takes_its_start_along_and_has_none_on_the_way() -> None:
    def carried(t_s: float) -> tuple[float, float]:
        return 300.0 + 1.5 * min(max(t_s - 20.0, 0.0), 40.0), -200.0

    said = stood(carried, 80.0)
    first, gone, last = starts(said)
    assert away_m(first, (300.0, -200.0)) < 0.1 and away_m(last, (360.0, -200.0)) < 0.1
    assert (gone.lat_deg, gone.lon_deg, gone.sigma_m) == (None, None, None)
    reached_s = 20.0 + AWAY_SIGMAS * math.hypot(2.0, 2.0) / 1.5
    assert reached_s < gone.t_ns / S < reached_s + 1.0 and 64.0 < last.t_ns / S < 66.0
    assert [t for t in texts(said) if "GPS" in t] == ["Terrafix: GPS 1 moves: no start"]


def test_a_receiver_that_wanders_within_what_it_claims_says_one_start() -> None:
    def wandering(t_s: float) -> tuple[float, float]:
        return 300.0 + 2.0 * math.sin(t_s / 9.0), -200.0 + 2.0 * math.cos(t_s / 13.0)

    assert len(starts(stood(wandering, 120.0))) == 1


def test_one_that_gets_much_better_is_said_again() -> None:
    node = LinkNode(10.0)
    found = starts(stood(node=node, horizontal_m=9.0))
    for step in range(100):
        better_m = 9.0 - 0.05 * step
        found += starts(list(node.on(reading(20 * S + step * 200 * MS, here(0.0), horizontal_m=better_m))))
    first, *_, last = {start.t_ns: start for start in found}.values()
    assert first.sigma_m == 9.0 and last.sigma_m == pytest.approx(4.45)


def test_a_jump_that_nobody_can_carry_is_the_end_of_it() -> None:
    """Also with a start that was said before: of the two places one is wrong."""
    said = stood(lambda t: here(t) if t < 10.0 else (300.0, 300.0), 60.0)
    first, gone = starts(said)
    assert first.sigma_m == 2.0 and gone.lat_deg is None and gone.t_ns == 10 * S
    assert [t for t in texts(said) if "GPS" in t] == ["Terrafix: GPS 1 jumped 500 m: no start"]
    assert max(x.t_ns for x in said if isinstance(x, m.GnssStart)) == gone.t_ns
    assert sum(isinstance(x, m.GnssStart) and x.lat_deg is None for x in said) > 40


def test_a_car_ride_without_reception_is_no_jump() -> None:
    def ridden(t_s: float) -> tuple[float, float] | None:
        return here(t_s) if t_s < 10.0 else None if t_s < 40.0 else (300.0 + 0.8 * CARRIED_MPS * 30.0, -200.0)

    said = stood(ridden, 60.0)
    assert [start.lat_deg is None for start in starts(said)] == [False, True, False]
    assert not [t for t in texts(said) if "jumped" in t]


@pytest.mark.parametrize(("from_s", "until_s"), [(3.0, 3.2), (1.0, 6.0)])
def test_five_seconds_are_counted_without_a_break(from_s: float, until_s: float) -> None:
    broken = stood(lambda t: None if from_s <= t < until_s else here(t))
    assert [start.t_ns / S for start in starts(broken)] == [pytest.approx(until_s + STEADY_NS / S, abs=0.01)]


def test_five_seconds_of_silence_are_not_five_seconds_of_readings() -> None:
    node = LinkNode(10.0)
    said = [x for message in (origin(), state(0, armed=False)) for x in node.on(message)]
    for now_ns in (0, 200 * MS, 6 * S, 6200 * MS):
        said += node.on(reading(now_ns, here(0.0)))
    assert not starts(said)


def test_a_receiver_that_has_died_contradicts_nobody() -> None:
    """The other one was carried on, and is heard."""
    node = LinkNode(10.0)
    said = [x for message in (origin(), state(0, armed=False)) for x in node.on(message)]
    for step in range(250):
        now_ns, on_m = step * 200 * MS, min(max(step - 60, 0) * 2.0, 200.0)
        said += node.on(reading(now_ns, (300.0 + on_m, -200.0), 1, speed_mps=10.0 if 0.0 < on_m < 200.0 else 0.0))
        said += node.on(reading(now_ns, here(0.0))) if step < 50 else []
    assert away_m(starts(said)[-1], (500.0, -200.0)) < 0.1
    assert not [text for text in texts(said) if "disagree" in text]


def test_what_was_said_holds_when_the_receiver_is_jammed_afterwards() -> None:
    said = stood(lambda t: here(t) if t < 10.0 else None, 60.0)
    assert len(starts(said)) == 1
    assert sum(isinstance(x, m.GnssStart) for x in said) > 50  # said again: who missed it


def test_two_receivers_that_contradict_each_other_say_nothing() -> None:
    said = stood(second=lambda _: (300.0, -100.0), seconds=60.0)
    first, gone = starts(said)  # of the same moment, and told apart
    assert first.lat_deg is not None and gone.lat_deg is None and STEADY_NS == first.t_ns < gone.t_ns < STEADY_NS + S
    assert [t for t in texts(said) if "GPS" in t] == ["Terrafix: GPS 1 and GPS 2 disagree: no start"]
    (agreed,) = starts(stood(second=lambda _: (304.0, -200.0), seconds=60.0))
    assert away_m(agreed, here(0.0)) < 5.0


def answered(**changes: Any) -> list[m.Message]:
    fields: dict[str, Any] = {"t_ns": S, "verdict": m.Verdict.ACCEPTED, "lat_deg": LAT, "lon_deg": LON, "sigma_m": 2.6}
    node, start = LinkNode(10.0), m.Start(**fields | {"ground_amsl_m": None} | changes)
    return [*node.on(start), *node.on(start)]


def test_the_pilot_reads_it_once() -> None:
    assert texts(answered()) == ["Terrafix: start from GNSS, 3 m"]
    none = {"lat_deg": None, "lon_deg": None, "sigma_m": None}
    assert texts(answered(verdict=m.Verdict.OUTSIDE_MAP, **none)) == ["Terrafix: GPS is not on the map: no start"]
    assert texts(answered(**none)) == []  # that it moves, was said before


def test_no_text_is_longer_than_a_statustext() -> None:
    far = stood(lambda t: here(t) if t < 10.0 else (9e6, 0.0), 12.0)
    disagree = stood(second=lambda _: (300.0, -100.0))
    said = texts([*far, *disagree, *answered(verdict=m.Verdict.OUTSIDE_MAP, lat_deg=None)])
    assert said and all(len(text) <= 50 for text in said)
