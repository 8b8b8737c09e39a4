"""What the map's error, learnt from a receiver before that is jammed, is worth: the same flights with and without.

python -m terrafix_tools.sim.judge.offset --flights 100"""

import argparse
import json
import math
import random
import sys

import numpy as np

from terrafix_tools.sim.judge.flight import Vision, fly
from terrafix_tools.sim.sensors.gnss_events import AnyEvent, Drag, Outage

LEARNT_S = (180.0, 300.0, 600.0)  # from take-off to the jamming
AFTER_S = 300.0
INSIDE_95 = 5.991  # chi-square, 2 degrees of freedom


def measured(
    flights: int, before_s: float, steady_share: float | None, drag_mps: float, seed: int
) -> dict[str, dict[str, float]]:
    """``steady_share``: of the estimate's variance, the map's own; None: 0 to 0.8. ``drag_mps``: a spoofer leads
    the receiver away from the first minute on, until the jamming; 0: nobody does."""
    sent: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for number in range(flights):
        draw = random.Random(f"{seed} {number} offset")
        vision = Vision(
            sigma_m=draw.uniform(2.0, 6.0),
            steady_share=draw.uniform(0.0, 0.8) if steady_share is None else steady_share,
            wander_s=draw.choice((5.0, 20.0, 60.0, 150.0)),
            velocity_sigma_mps=draw.uniform(0.3, 0.9),
        )
        angle = draw.uniform(0.0, math.tau)
        events: list[AnyEvent] = [Outage(start_s=before_s, end_s=math.inf)]
        if drag_mps > 0.0:
            east, north = drag_mps * math.cos(angle), drag_mps * math.sin(angle)
            events.append(Drag(start_s=60.0, end_s=before_s, east_mps=east, north_mps=north))
        for learns, errors in sent.items():
            told = fly(before_s + AFTER_S, vision, tuple(events), seed * 100_000 + number, map_offset=learns)
            errors.append(np.array([row for row in told.sent if row[0] >= before_s]))
    return {"learnt" if learns else "not learnt": _summary(errors) for learns, errors in sent.items()}


def _summary(flights: list[np.ndarray]) -> dict[str, float]:
    rows = np.vstack(flights)
    off_m = np.hypot(rows[:, 1], rows[:, 2])
    squared = (off_m / rows[:, 3]) ** 2
    return {
        "median_m": round(float(np.median(off_m)), 2),
        "p95_m": round(float(np.percentile(off_m, 95)), 2),
        "max_m": round(float(np.max(off_m)), 2),
        "claimed_sigma_m": round(float(np.median(rows[:, 3])), 2),
        "nees": round(float(np.mean(squared)), 2),
        "inside_95": round(float(np.mean(squared <= INSIDE_95)), 3),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--steady", type=float, help="the map's share of the estimate's variance")
    parser.add_argument("--drag", type=float, default=0.0, help="a spoofer's speed, m/s")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for before_s in LEARNT_S:
        row = {"seconds with GNSS": before_s, **measured(args.flights, before_s, args.steady, args.drag, args.seed)}
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
