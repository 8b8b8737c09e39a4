"""The autopilot's clock, with its own start time and oscillator drift."""

import random
from dataclasses import dataclass

BOOT_OFFSET_S = (20.0, 300.0)
DRIFT = 30e-6  # 1-sigma of an oscillator over its temperature range (20 to 50 ppm in data sheets)


@dataclass(frozen=True)
class Clock:
    """Reads ``offset_s`` at the flight's zero and runs faster than ours by ``drift``."""

    offset_s: float
    drift: float

    @classmethod
    def of(cls, seed: int) -> "Clock":
        """Draws a plausible clock from a seed."""
        rng = random.Random(f"{seed} clock")
        return cls(rng.uniform(*BOOT_OFFSET_S), rng.gauss(0.0, DRIFT))

    def boot_ns(self, t_s: float) -> int:
        """Clock reading at ``t_s`` of the flight: nanoseconds since its start."""
        return round((self.offset_s + t_s * (1.0 + self.drift)) * 1e9)
