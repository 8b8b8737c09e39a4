"""The autopilot's clock: another start and another crystal than ours."""

import random
from dataclasses import dataclass

BOOTED_BEFORE_S = (20.0, 300.0)
DRIFT = 30e-6  # 1-sigma of a crystal between its extremes of temperature (20 to 50 ppm in data sheets)


@dataclass(frozen=True)
class Clock:
    """Reads ``offset_s`` at the flight's zero and runs by ``drift`` faster than ours."""

    offset_s: float
    drift: float

    @classmethod
    def of(cls, seed: int) -> "Clock":
        """A plausible one."""
        draw = random.Random(f"{seed} clock")
        return cls(draw.uniform(*BOOTED_BEFORE_S), draw.gauss(0.0, DRIFT))

    def boot_ns(self, t_s: float) -> int:
        """What it shows at ``t_s`` of the flight: nanoseconds since it started."""
        return round((self.offset_s + t_s * (1.0 + self.drift)) * 1e9)
