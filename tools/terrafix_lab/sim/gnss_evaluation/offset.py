"""Benefit of a map offset estimated from a receiver before it is jammed: the same flights with and without.

python -m terrafix_lab.sim.gnss_evaluation.offset --flights 100
"""

import argparse
import json
import math
import random
import sys

import numpy as np

from terrafix_lab.sim.gnss_evaluation.flight import Vision, fly
from terrafix_lab.sim.sensors.gnss_events import AnyEvent, Drag, Outage
from terrafix_tools.score import coverage

GNSS_PERIODS_S = (180.0, 300.0, 600.0)  # from take-off to the jamming
AFTER_S = 300.0


def compare_offsets(
    flights: int, before_s: float, constant_share: float | None, drag_mps: float, seed: int
) -> dict[str, dict[str, float]]:
    """Simulates ``flights`` flights and returns the errors after the jamming, with and without the offset estimate.
    ``constant_share``: share of the map's constant error in the estimate's variance; None: random, 0 to 0.8.
    ``drag_mps``: speed at which a spoofer drags the receiver away from the first minute until the jamming; 0: no
    spoofer.
    """
    sent: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for number in range(flights):
        rng = random.Random(f"{seed} {number} offset")
        vision = Vision(
            sigma_m=rng.uniform(2.0, 6.0),
            constant_share=rng.uniform(0.0, 0.8) if constant_share is None else constant_share,
            wander_s=rng.choice((5.0, 20.0, 60.0, 150.0)),
            velocity_sigma_mps=rng.uniform(0.3, 0.9),
        )
        angle = rng.uniform(0.0, math.tau)
        events: list[AnyEvent] = [Outage(start_s=before_s, end_s=math.inf)]
        if drag_mps > 0.0:
            east, north = drag_mps * math.cos(angle), drag_mps * math.sin(angle)
            events.append(Drag(start_s=60.0, end_s=before_s, east_mps=east, north_mps=north))
        for with_offset, errors in sent.items():
            result = fly(before_s + AFTER_S, vision, tuple(events), seed * 100_000 + number, map_offset=with_offset)
            errors.append(np.array([row for row in result.sent if row[0] >= before_s]))
    return {"learnt" if with_offset else "not learnt": _summary(errors) for with_offset, errors in sent.items()}


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
        "inside_95": round(coverage(squared) or 0.0, 3),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--steady", type=float, help="the map's share of the estimate's variance")
    parser.add_argument("--drag", type=float, default=0.0, help="a spoofer's speed, m/s")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for before_s in GNSS_PERIODS_S:
        row = {
            "seconds with GNSS": before_s,
            **compare_offsets(args.flights, before_s, args.steady, args.drag, args.seed),
        }
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
