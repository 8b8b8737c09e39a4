"""Detection delays and false alarms of the GNSS spoofing detector over many simulated flights, as messages.

python -m terrafix_lab.sim.gnss_evaluation.table --flights 200 --minutes 60
"""

import argparse
import json
import math
import random
import statistics
import sys
from collections import Counter
from dataclasses import dataclass, field

from terrafix.messages import GnssState
from terrafix_lab.sim.gnss_evaluation.flight import DetectorResult, Vision, fly
from terrafix_lab.sim.sensors.gnss_events import AnyEvent, Drag, Jam, Jump, Outage
from terrafix_tools.score import quantile

KINDS = ("clean", "outage", "jam", "jump", "drag")
DRAG_MPS, DRAG_LIMIT_M = 1.0, 30.0
PRECISE_M = 4.5
EVENT_S = 180.0
ALARMS = (GnssState.SPOOFED, GnssState.DISPUTED, GnssState.LOST)


@dataclass
class Table:
    flights: Counter[str] = field(default_factory=Counter)
    clean_hours: float = 0.0  # before the event, and whole flights without event
    false_alarms: Counter[str] = field(default_factory=Counter)
    detected_s: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    missed: Counter[str] = field(default_factory=Counter)
    # of the drags, those where vision states PRECISE_M or better
    precise_drag_s: list[float] = field(default_factory=list)
    trusted_again_s: list[float] = field(default_factory=list)  # after the end of a spoofing event


def table(flights: int, minutes: float, seed: int = 1) -> Table:
    result = Table()
    for number in range(flights):
        _simulate_one(result, KINDS[number % len(KINDS)], minutes * 60.0, seed * 100_000 + number)
    return result


def _simulate_one(result: Table, kind: str, duration_s: float, seed: int) -> None:
    rng = random.Random(seed)
    vision = Vision(
        sigma_m=rng.uniform(2.0, 6.0),
        constant_share=rng.uniform(0.0, 0.8),
        wander_s=rng.choice((5.0, 20.0, 60.0, 150.0)),
        velocity_sigma_mps=rng.uniform(0.3, 0.9),
        gap=_gap(rng, duration_s),
    )
    start_s = rng.uniform(0.6, 0.8) * duration_s
    event = _event(kind, start_s, rng)
    flight_result = fly(duration_s, vision, (event,) if event else (), seed)
    result.flights[kind] += 1
    clean_s = start_s if event else duration_s
    result.clean_hours += clean_s / 3600
    for t_s, state in flight_result.states:
        if t_s < clean_s and state in ALARMS:
            result.false_alarms[state] += 1
    if event is not None:
        detected_at_s = _count_event(result, kind, start_s, flight_result)
        if kind == "drag" and detected_at_s is not None and vision.sigma_m <= PRECISE_M:
            result.precise_drag_s.append(detected_at_s)


def _count_event(result: Table, kind: str, start_s: float, flight_result: DetectorResult) -> float | None:
    """Returns the seconds until detection; None when it was not detected during the event."""
    wanted = (GnssState.LOST,) if kind in ("outage", "jam") else (GnssState.SPOOFED,)
    from_s = flight_result.lost_fix_s if kind == "jam" and flight_result.lost_fix_s is not None else start_s
    detected_at_s = flight_result.first(start_s, *wanted)
    if detected_at_s is None or detected_at_s > start_s + EVENT_S:
        result.missed[kind] += 1
        return None
    result.detected_s[kind].append(max(0.0, detected_at_s - from_s))
    if wanted == (GnssState.SPOOFED,):
        trusted_s = flight_result.first(detected_at_s, GnssState.TRUSTED)
        if trusted_s is not None:
            result.trusted_again_s.append(trusted_s - start_s - EVENT_S)
    return result.detected_s[kind][-1]


def _gap(rng: random.Random, duration_s: float) -> tuple[float, float]:
    if rng.random() < 0.75:
        return 0.0, 0.0
    from_s = rng.uniform(0.1, 0.4) * duration_s
    return from_s, from_s + rng.uniform(20.0, 60.0)


def _event(kind: str, start_s: float, rng: random.Random) -> AnyEvent | None:
    angle = rng.uniform(0.0, math.tau)
    east, north = math.cos(angle), math.sin(angle)
    end_s = start_s + EVENT_S
    match kind:
        case "outage":
            return Outage(start_s=start_s, end_s=end_s)
        case "jam":
            return Jam(start_s=start_s, end_s=end_s, fade_s=rng.uniform(1.0, 15.0))
        case "jump":
            away_m = math.exp(rng.uniform(math.log(60.0), math.log(3000.0)))
            return Jump(start_s=start_s, end_s=end_s, east_m=away_m * east, north_m=away_m * north)
        case "drag":
            return Drag(start_s=start_s, end_s=end_s, east_mps=DRAG_MPS * east, north_mps=DRAG_MPS * north)
    return None


def summary(result: Table) -> dict[str, object]:
    rows: dict[str, object] = {
        "flights": dict(result.flights),
        "clean_hours": round(result.clean_hours, 1),
        "false_alarms": dict(result.false_alarms),
        "missed": dict(result.missed),
    }
    for kind, seconds in result.detected_s.items():
        if seconds:
            rows[f"{kind}_seconds"] = _quantiles(seconds)
    if result.precise_drag_s:
        rows["drag_seconds_where_vision_claims_4_5_m"] = _quantiles(result.precise_drag_s)
        late = sum(seconds > DRAG_LIMIT_M / DRAG_MPS for seconds in result.detected_s["drag"])
        rows["drags_beyond_30_m"] = late
    if result.trusted_again_s:
        rows["trusted_again_after_spoofing_seconds"] = _quantiles(result.trusted_again_s)
    return rows


def _quantiles(seconds: list[float]) -> dict[str, float]:
    p95 = quantile(seconds, 0.95)
    assert p95 is not None
    values = {"least": min(seconds), "median": statistics.median(seconds), "p95": p95, "worst": max(seconds)}
    return {name: round(value, 2) for name, value in values.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    sys.stdout.write(json.dumps(summary(table(args.flights, args.minutes, args.seed)), indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
