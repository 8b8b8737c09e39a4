"""Height above take-off from the measured barometric pressure, which is independent of what we send.

GLOBAL_POSITION_INT.relative_alt is the height of the autopilot's EKF. With ``EK3_SRC1_VELZ`` 3 the EKF fuses our
vertical velocity, so an error of ours would return as a height that confirms it. SCALED_PRESSURE is the reading of the
sensor; the EKF's height only sets the zero, on the ground."""

import math

# Standard atmosphere below 11 km. [spec: ICAO Doc 7488]
ISA_HPA, ISA_M, ISA_EXPONENT = 1013.25, 44_330.77, 0.190263
MIN_PRESSURE_HPA, MAX_PRESSURE_HPA = 200.0, 1100.0  # at 11.8 km, and below the shore of the Dead Sea [tuned]
ZERO_SMOOTHING = 0.1  # weight of one reading in the zero; reduces noise of 0.2 m to 0.05 m [tuned]
PRESSURE_TIMEOUT_NS = 1_000_000_000  # an older pressure is not used [tuned]


def isa_height_m(pressure_hpa: float) -> float:
    """-> pressure altitude in the standard atmosphere."""
    return ISA_M * (1.0 - (pressure_hpa / ISA_HPA) ** ISA_EXPONENT)


class PressureHeight:
    """Height above take-off: pressure altitude minus that of the take-off point, ``zero_m``.

    If the air temperature differs from the standard atmosphere, the scale error is 0.35 % per degree, as in the
    firmware."""

    def __init__(self, zero_m: float | None = None) -> None:
        """``zero_m``: pressure altitude of the take-off point; None: unknown."""
        self.zero_m = zero_m
        self._latest: tuple[int, float] | None = None  # (time received, pressure altitude [m])

    def on_pressure(self, pressure_hpa: float, now_ns: int) -> None:
        """Stores a pressure; one that is implausible or not finite is ignored."""
        if MIN_PRESSURE_HPA < pressure_hpa < MAX_PRESSURE_HPA:
            self._latest = (now_ns, isa_height_m(pressure_hpa))

    def align_zero(self, ekf_height_m: float, armed: bool | None, now_ns: int) -> None:
        """Aligns the zero with ``ekf_height_m``, the EKF's height above take-off.

        On the ground the zero follows the EKF, whose velocity is zero there. In the air it is set once, if it is
        unknown (a link that was started in the air)."""
        height_m = self._isa_height_m(now_ns)
        if height_m is None or not math.isfinite(ekf_height_m) or (armed is not False and self.zero_m is not None):
            return
        zero_m = height_m - ekf_height_m
        self.zero_m = zero_m if self.zero_m is None else self.zero_m + ZERO_SMOOTHING * (zero_m - self.zero_m)

    def height_m(self, now_ns: int) -> float | None:
        """-> height above take-off; None without a recent pressure or without a zero."""
        height_m = self._isa_height_m(now_ns)
        return None if height_m is None or self.zero_m is None else height_m - self.zero_m

    def _isa_height_m(self, now_ns: int) -> float | None:
        return None if self._latest is None or now_ns - self._latest[0] > PRESSURE_TIMEOUT_NS else self._latest[1]
