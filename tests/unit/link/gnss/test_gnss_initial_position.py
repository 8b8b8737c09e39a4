"""Initial position from GNSS: when it is published and withdrawn, and the texts about it."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from link_rig import LAT, LON, MS, S, estimate, fly, texts
from origins import origin_of
from terrafix import messages as m
from terrafix.link.gnss.initial_position import (
    MAX_CLAIMED_SIGMA_M,
    MAX_TRANSPORT_SPEED_MPS,
    START_MOVED_SIGMAS,
    STATIONARY_NS,
)
from terrafix.link.gnss.spoofing_detector import DEFAULT_RECEIVER_SIGMA_M, MIN_RECEIVER_SIGMA_M
from terrafix.link.integrity.output_predictor import distance_m, offset
from terrafix.link.node import LinkNode

UNKNOWN_START_SIGMA_M = 2000.0
Where = Callable[[float], tuple[float, float] | None]  # s -> metres east and north; None: no fix


def origin(start_sigma_m: float = UNKNOWN_START_SIGMA_M) -> m.Origin:
    return origin_of(m.Camera(width=1, height=1, fx=1, fy=1, cx=0, cy=0), start_sigma_m=start_sigma_m)


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


def run_standing(
    where: Where = here,
    seconds: float = 20.0,
    *,
    node: LinkNode | None = None,
    armed: Callable[[float], bool | None] = lambda _: False,
    start_sigma_m: float = UNKNOWN_START_SIGMA_M,
    second: Where | None = None,
    extra: Callable[[int], list[m.Message]] = lambda _: [],
    **changes: Any,
) -> list[m.Message]:
    """-> messages of a link that gets attitudes at 10 Hz and readings at 5 Hz of one or two receivers. ``where``,
    ``second``: position of the receivers over time. ``extra``: further messages at a time."""

    def feed(now_ns: int) -> list[m.Message]:
        t_s, before_s = now_ns / S, max(0.0, now_ns / S - 0.2)
        published: list[m.Message] = [origin(start_sigma_m)] if now_ns == 0 else []
        published += [state(now_ns, armed(t_s))] if now_ns % (100 * MS) == 0 else []
        if now_ns % (200 * MS) == 0:
            at_m, before_m = where(t_s), where(before_s)
            speed = {} if at_m is None or before_m is None else {"speed_mps": math.dist(at_m, before_m) / 0.2}
            published += [reading(now_ns, at_m, **speed | changes)]
            published += [] if second is None else [reading(now_ns, second(t_s), 1)]
        return published + extra(now_ns)

    return fly(node or LinkNode(10.0), 0, round(seconds * S), feed)


def starts(published: list[m.Message]) -> list[m.GnssInitialPosition]:
    """The different GnssInitialPosition messages, without repetitions."""
    found = {x.t_ns: x for x in published if isinstance(x, m.GnssInitialPosition)}
    return list(found.values())


def distance_to_m(start: m.GnssInitialPosition, at_m: tuple[float, float]) -> float:
    assert start.lat_deg is not None and start.lon_deg is not None
    return distance_m(start.lat_deg, start.lon_deg, *offset(LAT, LON, *at_m))


def test_a_position_held_for_five_seconds_becomes_the_start_and_is_published_every_second() -> None:
    published = run_standing()
    (start,) = starts(published)
    assert distance_to_m(start, here(0.0)) < 0.1 and start.sigma_m == 2.0 and start.receiver == 0
    assert start.t_ns == STATIONARY_NS
    assert 14 <= sum(isinstance(x, m.GnssInitialPosition) for x in published) <= 16


@pytest.mark.parametrize(
    ("claimed_m", "sigma_m"),
    [
        (0.3, MIN_RECEIVER_SIGMA_M),
        (None, DEFAULT_RECEIVER_SIGMA_M),
        (MAX_CLAIMED_SIGMA_M, MAX_CLAIMED_SIGMA_M),
        (1.01 * MAX_CLAIMED_SIGMA_M, None),
        (25.0, None),
    ],
)
def test_the_sigma_of_the_start_is_the_claim_of_the_receiver_within_limits(
    claimed_m: float | None, sigma_m: float | None
) -> None:
    found = starts(run_standing(horizontal_m=claimed_m))
    assert [start.sigma_m for start in found] == ([] if sigma_m is None else [sigma_m])


@pytest.mark.parametrize("changes", [{"fix_type": 2}, {"fix_type": 1}])
def test_a_fix_below_3d_gives_no_start(changes: dict[str, Any]) -> None:
    assert not starts(run_standing(**changes))


def test_a_configured_start_is_not_replaced() -> None:
    assert not starts(run_standing(start_sigma_m=100.0))
    assert starts(run_standing(start_sigma_m=101.0))


def test_the_start_from_gnss_can_be_disabled() -> None:
    assert not starts(run_standing(node=LinkNode(10.0, gnss_start=False)))


@pytest.mark.parametrize("armed", [None, True])
def test_a_vehicle_that_may_be_armed_gets_no_start(armed: bool | None) -> None:
    assert not starts(run_standing(armed=lambda _: armed))


def test_arming_ends_the_start_from_gnss_and_disarming_does_not_restart_it() -> None:
    assert not [x for x in run_standing(armed=lambda t: t > 3.0) if isinstance(x, m.GnssInitialPosition)]
    assert not starts(run_standing(seconds=60.0, armed=lambda t: 3.0 < t < 20.0))
    published = run_standing(seconds=30.0, armed=lambda t: t > 10.0)
    assert max(x.t_ns for x in published if isinstance(x, m.GpsInput)) > 29 * S
    repeated = [x for x in published if isinstance(x, m.GnssInitialPosition)]
    assert len(repeated) <= 6  # repetitions end at arming


def test_after_a_map_fix_there_is_no_start_from_gnss() -> None:
    anchored = run_standing(extra=lambda now: [estimate(now)] if now == S else [])
    assert not starts(anchored)
    unanchored = run_standing(extra=lambda now: [estimate(now, anchor_age_ms=-1)] if now == S else [])
    assert starts(unanchored)


def test_the_start_is_withdrawn_while_the_vehicle_is_carried_and_published_at_its_new_place() -> None:
    def carried(t_s: float) -> tuple[float, float]:
        return 300.0 + 1.5 * min(max(t_s - 20.0, 0.0), 40.0), -200.0

    published = run_standing(carried, 80.0)
    first, withdrawn, last = starts(published)
    assert distance_to_m(first, (300.0, -200.0)) < 0.1 and distance_to_m(last, (360.0, -200.0)) < 0.1
    assert (withdrawn.lat_deg, withdrawn.lon_deg, withdrawn.sigma_m) == (None, None, None)
    reached_s = 20.0 + START_MOVED_SIGMAS * math.hypot(2.0, 2.0) / 1.5
    assert reached_s < withdrawn.t_ns / S < reached_s + 1.0 and 64.0 < last.t_ns / S < 66.0
    assert [t for t in texts(published) if "GPS" in t] == ["Terrafix: GPS 1 moves: no start"]


def test_a_receiver_that_wanders_within_its_claim_gives_one_start() -> None:
    def wandering(t_s: float) -> tuple[float, float]:
        return 300.0 + 2.0 * math.sin(t_s / 9.0), -200.0 + 2.0 * math.cos(t_s / 13.0)

    assert len(starts(run_standing(wandering, 120.0))) == 1


def test_a_start_is_replaced_when_its_accuracy_improves_by_half() -> None:
    node = LinkNode(10.0)
    found = starts(run_standing(node=node, horizontal_m=9.0))
    for step in range(100):
        better_m = 9.0 - 0.05 * step
        found += starts(list(node.on(reading(20 * S + step * 200 * MS, here(0.0), horizontal_m=better_m))))
    first, *_, last = {start.t_ns: start for start in found}.values()
    assert first.sigma_m == 9.0 and last.sigma_m == pytest.approx(4.45)


def test_a_jump_that_no_transport_explains_withdraws_the_start_for_good() -> None:
    """A start that was published before is withdrawn too, because one of the two positions is wrong."""
    published = run_standing(lambda t: here(t) if t < 10.0 else (300.0, 300.0), 60.0)
    first, withdrawn = starts(published)
    assert first.sigma_m == 2.0 and withdrawn.lat_deg is None and withdrawn.t_ns == 10 * S
    assert [t for t in texts(published) if "GPS" in t] == ["Terrafix: GPS 1 jumped 500 m: no start"]
    assert max(x.t_ns for x in published if isinstance(x, m.GnssInitialPosition)) == withdrawn.t_ns
    assert sum(isinstance(x, m.GnssInitialPosition) and x.lat_deg is None for x in published) > 40


def test_a_car_ride_without_reception_is_not_a_jump() -> None:
    def ridden(t_s: float) -> tuple[float, float] | None:
        return (
            here(t_s) if t_s < 10.0 else None if t_s < 40.0 else (300.0 + 0.8 * MAX_TRANSPORT_SPEED_MPS * 30.0, -200.0)
        )

    published = run_standing(ridden, 60.0)
    assert [start.lat_deg is None for start in starts(published)] == [False, True, False]
    assert not [t for t in texts(published) if "jumped" in t]


@pytest.mark.parametrize(("from_s", "until_s"), [(3.0, 3.2), (1.0, 6.0)])
def test_the_five_seconds_start_again_after_a_loss_of_the_fix(from_s: float, until_s: float) -> None:
    broken = run_standing(lambda t: None if from_s <= t < until_s else here(t))
    assert [start.t_ns / S for start in starts(broken)] == [pytest.approx(until_s + STATIONARY_NS / S, abs=0.01)]


def test_five_seconds_without_readings_do_not_count_as_stationary() -> None:
    node = LinkNode(10.0)
    published = [x for message in (origin(), state(0, armed=False)) for x in node.on(message)]
    for now_ns in (0, 200 * MS, 6 * S, 6200 * MS):
        published += node.on(reading(now_ns, here(0.0)))
    assert not starts(published)


def test_a_receiver_without_readings_does_not_contradict_another() -> None:
    """Receiver 1 stops; receiver 2 is carried to another place."""
    node = LinkNode(10.0)
    published = [x for message in (origin(), state(0, armed=False)) for x in node.on(message)]
    for step in range(250):
        now_ns, on_m = step * 200 * MS, min(max(step - 60, 0) * 2.0, 200.0)
        published += node.on(reading(now_ns, (300.0 + on_m, -200.0), 1, speed_mps=10.0 if 0.0 < on_m < 200.0 else 0.0))
        published += node.on(reading(now_ns, here(0.0))) if step < 50 else []
    assert distance_to_m(starts(published)[-1], (500.0, -200.0)) < 0.1
    assert not [text for text in texts(published) if "disagree" in text]


def test_the_start_remains_when_the_receiver_is_jammed_afterwards() -> None:
    published = run_standing(lambda t: here(t) if t < 10.0 else None, 60.0)
    assert len(starts(published)) == 1
    # Repetitions, for subscribers that missed one.
    assert sum(isinstance(x, m.GnssInitialPosition) for x in published) > 50


def test_two_receivers_that_disagree_give_no_start() -> None:
    published = run_standing(second=lambda _: (300.0, -100.0), seconds=60.0)
    first, withdrawn = starts(published)  # of one reading; t_ns differs
    assert (
        first.lat_deg is not None
        and withdrawn.lat_deg is None
        and STATIONARY_NS == first.t_ns < withdrawn.t_ns < STATIONARY_NS + S
    )
    assert [t for t in texts(published) if "GPS" in t] == ["Terrafix: GPS 1 and GPS 2 disagree: no start"]
    (agreed,) = starts(run_standing(second=lambda _: (304.0, -200.0), seconds=60.0))
    assert distance_to_m(agreed, here(0.0)) < 5.0


def on_answer(**changes: Any) -> list[m.Message]:
    fields: dict[str, Any] = {"t_ns": S, "verdict": m.Verdict.ACCEPTED, "lat_deg": LAT, "lon_deg": LON, "sigma_m": 2.6}
    node, start = LinkNode(10.0), m.InitialPosition(**fields | {"ground_amsl_m": None} | changes)
    return [*node.on(start), *node.on(start)]


def test_the_answer_to_a_start_is_reported_to_the_pilot_once() -> None:
    assert texts(on_answer()) == ["Terrafix: start from GNSS, 3 m"]
    none = {"lat_deg": None, "lon_deg": None, "sigma_m": None}
    assert texts(on_answer(verdict=m.Verdict.OUTSIDE_MAP, **none)) == ["Terrafix: GPS is not on the map: no start"]
    assert texts(on_answer(**none)) == []  # the text was sent with the withdrawal


def test_texts_about_the_start_fit_into_a_statustext() -> None:
    far = run_standing(lambda t: here(t) if t < 10.0 else (9e6, 0.0), 12.0)
    disagree = run_standing(second=lambda _: (300.0, -100.0))
    published = texts([*far, *disagree, *on_answer(verdict=m.Verdict.OUTSIDE_MAP, lat_deg=None)])
    assert published and all(len(text) <= 50 for text in published)
