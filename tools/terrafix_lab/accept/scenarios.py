"""The named scenarios: ground, fault, requirement. Described in docs/acceptance.md."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from terrafix.core.node import Image, Node, NodeContext
from terrafix_lab.accept.false_inputs.maps import REACH, stale_along
from terrafix_lab.accept.false_inputs.scenarios import LIES
from terrafix_lab.accept.flight import AcceptFlight
from terrafix_lab.accept.measuring.criteria import EVERYWHERE, WITH_SPAN
from terrafix_lab.accept.measuring.results import Marks
from terrafix_lab.accept.plan import CLOSED_LOOP, FRAMES, Plan, Scenario, plan_of, scenario_of, without_fault
from terrafix_lab.faults import edits, pictures
from terrafix_lab.faults.edits import Span
from terrafix_lab.faults.fault import lacking
from terrafix_lab.faults.messages import OUTLIER_EVERY, HotComputer
from terrafix_lab.faults.table import FAULTS, IMPRECISE_INPUTS
from terrafix_tools.replay import make_nodes

COMMAND = "terrafix accept --scenario"  # of terrafix_lab.faults.fault.CAMPAIGNS
FOREIGN_AT = (0.3, 0.55, 0.8)  # of the frames
FAR_M = 350.0
BLACKOUT_S, STALL_S = 60.0, 10.0
BEFORE_S, AFTER_S = 20.0, 25.0  # flight time before and after a blackout
UNMATCHABLE, UNMATCHABLE_WITHIN = 0.20, (0.10, 0.90)  # shares of the frames: a fifth of the route, not at its ends
UNMATCHABLE_STEP = 0.05
HOT = (1 / 3, 2 / 3)
LONG_FRAMES = 1500
WATER_FRAMES = 250  # the shortest flight that lasts for 30 s, the floor of AC-15, after the lake
KIDNAPPED_M = np.array([700.0, 700.0])  # east, north, or the opposite: 990 m, with a stated sigma of tens of metres


def _foreign_frame(flight: AcceptFlight) -> Plan | str:
    if len(flight.frame_refs) < 8:
        return f"the flight has only {len(flight.frame_refs)} frames"
    mirrored = pictures.mirrored(flight.picture(0))
    return _foreign({flight.frame_refs[flight.at(share)].file: mirrored for share in FOREIGN_AT})


def _far_frame(flight: AcceptFlight) -> Plan | str:
    track = flight.track_m()
    away = np.hypot(*(track[:, None] - track[None, :]).transpose(2, 0, 1))
    there = np.where(away >= FAR_M, away, np.inf).argmin(axis=1)  # the nearest frame that is far enough
    has = np.flatnonzero((away[np.arange(len(track)), there] >= FAR_M) & (np.arange(len(track)) > 0))
    if len(has) < len(FOREIGN_AT):
        return f"no two places of the flight are {FAR_M:.0f} m apart"
    at = [int(has[round(share * (len(has) - 1))]) for share in FOREIGN_AT]
    return _foreign({flight.frame_refs[i].file: flight.picture(int(there[i])) for i in at})


def _foreign(shown: dict[str, Image]) -> Plan:
    return Plan(
        edits.foreign_frames(shown),
        marks=Marks(wrong_files=frozenset(map(edits.foreign_name, shown))),
    )


def _outlier_fix(flight: AcceptFlight) -> Plan | str:
    plan = plan_of(FAULTS["350 m outlier fix"], flight)
    wrong = frozenset(s.file for s in flight.frame_refs[OUTLIER_EVERY // 2 :: OUTLIER_EVERY])
    return plan if isinstance(plan, str) else replace(plan, marks=Marks(wrong_files=wrong))


def _gap(flight: AcceptFlight, low: int, high: int, turning: bool) -> tuple[int, int] | str:
    """(first, end) of the frames to delete so that the frames before and after them do not overlap.

    Between the frames ``low`` and ``high``: where the track turns most, or (``turning`` False) the shortest gap."""
    track = flight.track_m()
    best: tuple[float, int, int] | None = None
    for first in range(low + 1, high):
        away = np.hypot(*(track[first:high] - track[first - 1]).T)
        far = np.flatnonzero(away >= flight.footprint_m)
        if not len(far) or first + int(far[0]) + 1 >= high:
            continue
        end = first + int(far[0])
        before, after = track[first - 1] - track[first - 2], track[end + 1] - track[end]
        turn = abs(float(np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after)))
        worth = turn if turning else float(first - end)
        if best is None or worth > best[0]:
            best = (worth, first, end)
    return (best[1], best[2]) if best else "no part of the flight is long enough to leave ground out"


def _gaps(flight: AcceptFlight, parts: tuple[tuple[float, float], ...], turning: bool) -> Plan | str:
    gone: set[str] = set()
    spans, breaks = [], []
    for low, high in parts:
        gap = _gap(flight, max(2, flight.at(low)), flight.at(high), turning)
        if isinstance(gap, str):
            return gap
        gone |= {s.file for s in flight.frame_refs[gap[0] : gap[1]]}
        breaks.append(flight.frame_refs[gap[1]].t_s)
        spans.append(Span(flight.frame_refs[gap[0]].t_s, breaks[-1], "no frames"))
    return Plan(edits.without_frames(frozenset(gone)), marks=Marks(spans=tuple(spans), breaks_s=tuple(breaks)))


def _sharp_turn(flight: AcceptFlight) -> Plan | str:
    return _gaps(flight, ((0.25, 0.75),), turning=True)


def _three_fragments(flight: AcceptFlight) -> Plan | str:
    return _gaps(flight, ((0.15, 0.5), (0.5, 0.85)), turning=False)


def _share_of(flight: AcceptFlight, shares: tuple[float, float], text: str) -> Span:
    return Span(flight.frame_refs[flight.at(shares[0])].t_s, flight.frame_refs[flight.at(shares[1])].t_s, text)


def _unmatchable(flight: AcceptFlight) -> Plan | str:
    if not flight.has_raster_map:
        return "needs the map as a GeoTIFF, to make it stale along a fifth of the route"
    shares = _fifth(flight)
    first, last = (flight.at(share) for share in shares)
    stretch = [flight.truth[s.file] for s in flight.frame_refs[first : last + 1] if s.file in flight.truth]

    def other_map(given: Path, out: Path) -> str:
        return stale_along(given, out, stretch, flight.footprint_m)

    return Plan(other_map=other_map, marks=Marks(spans=(_share_of(flight, shares, "the map shows other ground"),)))


def _fifth(flight: AcceptFlight) -> tuple[float, float]:
    """Start and end, as shares of the frames, of the fifth whose ground is least visible in the other frames.

    Otherwise a flight that circles over this ground would have no usable map."""
    track, visible = flight.track_m(), {}
    for begin in np.arange(UNMATCHABLE_WITHIN[0], UNMATCHABLE_WITHIN[1] - UNMATCHABLE + 1e-6, UNMATCHABLE_STEP):
        first, end = flight.at(begin), flight.at(begin + UNMATCHABLE) + 1
        others = np.delete(track, np.s_[first:end], axis=0)
        away = np.hypot(*(others[:, None] - track[None, first:end]).transpose(2, 0, 1))
        near = np.nan_to_num(away, nan=np.inf).min(axis=1) < REACH * flight.footprint_m
        visible[float(begin)] = int(near.sum())
    begin = min(visible, key=visible.__getitem__)
    return begin, begin + UNMATCHABLE


def _long_route(_: AcceptFlight) -> Plan:
    return Plan(long_route=True)


def _blackout(flight: AcceptFlight) -> Plan | str:
    needed_s = BEFORE_S + BLACKOUT_S + AFTER_S
    if flight.duration_s < needed_s:
        return f"the flight lasts {flight.duration_s:.0f} s, and {needed_s:.0f} s are needed"
    from_s = flight.frame_refs[0].t_s + (flight.duration_s - BLACKOUT_S) * BEFORE_S / (BEFORE_S + AFTER_S)
    span = Span(from_s, from_s + BLACKOUT_S, "black pictures")
    return Plan(pictures.black(span), marks=Marks(spans=(span,)))


def _stall(flight: AcceptFlight) -> Plan | str:
    if flight.duration_s < 3 * STALL_S:
        return f"the flight lasts only {flight.duration_s:.0f} s"
    from_s = flight.frame_refs[flight.at(0.5)].t_s
    span = Span(from_s, from_s + STALL_S, "the same picture again and again")
    return Plan(pictures.frozen(span), marks=Marks(spans=(span,)))


def _over_water(flight: AcceptFlight) -> Plan:
    from terrafix_lab.accept.generated import WATER  # only for generated ground

    return Plan(marks=Marks(spans=(_share_of(flight, WATER, "over open water"),)))


def _kidnapped(flight: AcceptFlight) -> Plan:
    # Towards the centre of the flight, where the map is.
    ahead = np.where(np.nanmean(flight.track_m(), axis=0) < 0.0, -1.0, 1.0)
    return Plan(origin=edits.start_moved(*(ahead * KIDNAPPED_M).tolist()))


def _hot_day(flight: AcceptFlight) -> Plan:
    span = _share_of(flight, HOT, "thermal throttle")

    def nodes(ctx: NodeContext) -> Mapping[str, Node]:
        made = make_nodes(ctx)
        return made | {"estimator": HotComputer(made["estimator"], span)}

    return Plan(nodes=nodes, marks=Marks(spans=(span,)))


IN_THE_LOOP = (
    "within 50 m", "within 20 m", "not localised", "claims", "coverage", "false fixes",
    "interval", "gap", "vehicle error", "failsafes",
)  # fmt: skip
BASELINE = (
    *EVERYWHERE, "latency", "odometry", "odometry px", "map px", "drift", "drift share", "first position", "memory",
    "asks",
)  # fmt: skip
SCENARIOS: tuple[Scenario, ...] = (
    Scenario("baseline", "A flight without faults.", BASELINE, without_fault),
    Scenario(
        "foreign frame", "Three pictures of another place among the frames: rejected, without effect on the next ones.",
        (*EVERYWHERE, "wrong ones rejected", "next frame"), _foreign_frame),
    Scenario(
        "350 m frame", "Three frames are repeated 350 m from their place: rejected, and the next one is correct.",
        (*EVERYWHERE, "wrong ones rejected", "next frame"), _far_frame),
    Scenario(
        "350 m outlier fix", FAULTS["350 m outlier fix"].words,
        (*EVERYWHERE, "wrong ones rejected", "next frame"), _outlier_fix),
    Scenario(
        "sharp turn", "Frames are missing where the track turns most, without overlap: a new fragment.",
        (*EVERYWHERE, "fragments", "fragments merged", "fragments accurate"), _sharp_turn),
    Scenario(
        "three fragments", "Two such gaps: three fragments, merged through geography.",
        (*EVERYWHERE, "fragments", "fragments merged", "fragments accurate"), _three_fragments),
    Scenario(
        "20 % unmatchable", "Other ground on the map along a fifth of the route: odometry goes on, the label changes.",
        (*EVERYWHERE, "says so", "asks", "drift", "drift share", "found again"), _unmatchable),
    Scenario(
        "long route", "1500 frames.", (*EVERYWHERE, "odometry", "drift", "memory"), _long_route, frames=LONG_FRAMES),
    Scenario(
        "60 s blackout", "Black pictures for 60 s: no false fix, and a correct position again afterwards.",
        (*WITH_SPAN, "asks"), _blackout, frames=270),
    Scenario(
        "GNSS jam", "Jammed after 40 s, with Terrafix as second GPS: the aircraft flies on. Closed loop.",
        IN_THE_LOOP, without_fault, ground=CLOSED_LOOP),
    Scenario(
        "slow spoof", "GNSS is correct for 40 s, then drifts at 2 m/s: the aircraft does not follow it. Closed loop.",
        IN_THE_LOOP, without_fault, ground=CLOSED_LOOP, frames=300),
    Scenario(
        "season change", "Camera and map in the two seasons that differ most.",
        EVERYWHERE, without_fault, ground="season"),
    Scenario("low texture", "Ground of an eighth of the contrast.", EVERYWHERE, without_fault, ground="low texture"),
    Scenario(
        "water", "A third of the route over open water: no map fix there, and no false one.",
        WITH_SPAN, _over_water, ground="water", frames=WATER_FRAMES),
    Scenario("hill country", "Relief of some 300 m, a kilometre wide.", EVERYWHERE, without_fault, ground="hills"),
    *(scenario_of(fault, EVERYWHERE, FRAMES) for fault in IMPRECISE_INPUTS),
    Scenario(
        "kidnapped", "The start coordinate has an error of a kilometre and a stated sigma of tens of metres.",
        ("claims", "coverage", "false fixes", "found again", "asks"), _kidnapped),
    Scenario(
        "hot day", "The computer throttles in the middle third: the cheaper covariance mode, and back.",
        (*EVERYWHERE, "mode"), _hot_day),
    Scenario("camera stall", "The camera repeats one picture for 10 s.", WITH_SPAN, _stall),
)  # fmt: skip
BY_NAME = {scenario.name: scenario for scenario in (*SCENARIOS, *LIES)}
BY_NAME |= {name: scenario_of(row) for name, row in FAULTS.items() if name not in BY_NAME and not lacking(COMMAND, row)}
