"""Interval of GPS_INPUT, and age of the image behind it, from a flight record."""

from collections.abc import Iterable
from itertools import pairwise

import msgspec

from terrafix.messages import GpsInput, Message, ProcessEvent
from terrafix_tools.score import quantile

MEDIAN_MS, P99_MS, GAP_MS = 100.0, 120.0, 245.0  # AC-14; the autopilot reports a GPS as unhealthy after two longer gaps
MEDIAN_WITHIN_MS = 2.0
ROUNDING_NS = 1_000_000  # of the age: images are further apart
UNPLANNED_EVENTS = ("died", "stuck", "gave_up", "restarted")


class IntervalStats(msgspec.Struct, frozen=True, kw_only=True):
    """Times in milliseconds; None without data."""

    gps_inputs: int
    duration_s: float
    interval_median_ms: float | None
    interval_p99_ms: float | None
    longest_gap_ms: float | None
    over_p99_floor: int  # intervals above 120 ms
    over_gap_floor: int  # ... above 245 ms
    first_age_median_ms: float | None  # from an image to the first GPS_INPUT that it contributed to
    first_age_p95_ms: float | None
    age_p95_ms: float | None  # of the image behind every GPS_INPUT; it grows until the next image
    fix3_share: float
    trouble: list[str]  # processes that died, hung or were restarted

    @property
    def meets_ac14(self) -> bool:
        """AC-14."""
        median, p99, gap = self.interval_median_ms, self.interval_p99_ms, self.longest_gap_ms
        if median is None or p99 is None or gap is None:
            return False
        return abs(median - MEDIAN_MS) <= MEDIAN_WITHIN_MS and p99 <= P99_MS and gap <= GAP_MS


def lines_of(stats: IntervalStats) -> dict[str, str]:
    """For people: name -> value."""
    return {
        "GPS_INPUT": f"{stats.gps_inputs} in {stats.duration_s:.0f} s, 3D fix in {stats.fix3_share:.1%}",
        "interval": f"median {_ms(stats.interval_median_ms)}, p99 {_ms(stats.interval_p99_ms)}",
        "longest gap": _ms(stats.longest_gap_ms),
        "over 120 ms": f"{stats.over_p99_floor}, over 245 ms {stats.over_gap_floor}",
        "AC-14": "met" if stats.meets_ac14 else "not met",
        "image to first GPS_INPUT": f"median {_ms(stats.first_age_median_ms)}, p95 {_ms(stats.first_age_p95_ms)}",
        "age of the image": f"p95 {_ms(stats.age_p95_ms)}",
        "processes": ", ".join(stats.trouble) or "none died or hung",
    }


def _ms(value: float | None) -> str:
    return "no data" if value is None else f"{value:.1f} ms"


def measure(messages: Iterable[Message]) -> IntervalStats:
    times_ns: list[int] = []
    ages_ms: list[float] = []
    first_ages_ms: list[float] = []
    trouble: list[str] = []
    newest_image_ns: int | None = None
    fixes = 0
    for message in messages:
        match message:
            case GpsInput():
                times_ns.append(message.t_ns)
                fixes += message.fix_type >= 3
                if message.fix_type < 3 or message.estimate_age_ms < 0:
                    continue
                ages_ms.append(message.estimate_age_ms)
                image_ns = message.t_ns - round(message.estimate_age_ms * 1e6)
                if newest_image_ns is None or image_ns - newest_image_ns > ROUNDING_NS:
                    first_ages_ms.append(message.estimate_age_ms)
                    newest_image_ns = image_ns
            case ProcessEvent() if message.event in UNPLANNED_EVENTS:
                trouble.append(f"{message.process} {message.event}")
            case _:
                pass
    gaps_ms = [(b - a) * 1e-6 for a, b in pairwise(times_ns)]
    return IntervalStats(
        gps_inputs=len(times_ns),
        duration_s=(times_ns[-1] - times_ns[0]) * 1e-9 if times_ns else 0.0,
        interval_median_ms=quantile(gaps_ms, 0.5),
        interval_p99_ms=quantile(gaps_ms, 0.99),
        longest_gap_ms=max(gaps_ms, default=None),
        over_p99_floor=sum(gap > P99_MS for gap in gaps_ms),
        over_gap_floor=sum(gap > GAP_MS for gap in gaps_ms),
        first_age_median_ms=quantile(first_ages_ms, 0.5),
        first_age_p95_ms=quantile(first_ages_ms, 0.95),
        age_p95_ms=quantile(ages_ms, 0.95),
        fix3_share=fixes / len(times_ns) if times_ns else 0.0,
        trouble=trouble,
    )
