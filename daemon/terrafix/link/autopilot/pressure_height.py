"""Height above take-off from the barometer's own pressure, which nothing that we send can move.

GLOBAL_POSITION_INT.relative_alt is the height of the autopilot's filter. With ``EK3_SRC1_VELZ`` 3 that takes in our
vertical velocity, so an error of ours would come back as a height that bears it out. SCALED_PRESSURE is what the sensor
reads; the filter's height tells only where its zero is, on the ground."""

import math

ISA_HPA, ISA_M, ISA_EXPONENT = 1013.25, 44_330.77, 0.190263  # standard atmosphere below 11 km (ICAO Doc 7488)
LEAST_HPA, MOST_HPA = 200.0, 1100.0  # 11.8 km up, and below the shore of the Dead Sea
SMOOTHING = 0.1  # of the zero, a reading: noise of 0.2 m becomes 0.05 m
FRESH_NS = 1_000_000_000


def isa_height_m(pressure_hpa: float) -> float:
    return ISA_M * (1.0 - (pressure_hpa / ISA_HPA) ** ISA_EXPONENT)


class PressureHeight:
    """``read`` each pressure, ``align`` with each height above take-off by the filter; ``height_m`` when it is asked.

    In air that is not standard heights are off by 0.35 % for each degree, as those of the firmware are."""

    def __init__(self, zero_m: float | None = None) -> None:
        """``zero_m``: height in the standard atmosphere of where it took off; None: not known."""
        self.zero_m = zero_m
        self._read: tuple[int, float] | None = None  # arrival, height in the standard atmosphere

    def read(self, pressure_hpa: float, now_ns: int) -> None:
        """A pressure that cannot be, or is not finite, is left out."""
        if LEAST_HPA < pressure_hpa < MOST_HPA:
            self._read = (now_ns, isa_height_m(pressure_hpa))

    def align(self, filter_m: float, armed: bool | None, now_ns: int) -> None:
        """On the ground the zero follows the filter, which knows no other velocity there than none; in the air only
        where it is not known yet (a link that is started there)."""
        height_m = self._fresh_m(now_ns)
        if height_m is None or not math.isfinite(filter_m) or (armed is not False and self.zero_m is not None):
            return
        zero_m = height_m - filter_m
        self.zero_m = zero_m if self.zero_m is None else self.zero_m + SMOOTHING * (zero_m - self.zero_m)

    def height_m(self, now_ns: int) -> float | None:
        """Above take-off; None: no pressure is fresh, or the zero is not known."""
        height_m = self._fresh_m(now_ns)
        return None if height_m is None or self.zero_m is None else height_m - self.zero_m

    def _fresh_m(self, now_ns: int) -> float | None:
        return None if self._read is None or now_ns - self._read[0] > FRESH_NS else self._read[1]
