"""Alignment before the first use of GPS: the checks of ArduPilot's filter."""

from terrafix_lab.sim.autopilot.navigation.gps import Fix
from terrafix_lab.sim.autopilot.parameters import Kind

CHECK_SATS, CHECK_HDOP, CHECK_SPEED, CHECK_POSITION = 1, 2, 4, 8  # EK3_GPS_CHECK; 16, yaw, is not simulated
MIN_SATELLITES, MAX_HDOP = 6, 2.5
SPEED_MPS, HORIZONTAL_M, VERTICAL_M = 1.0, 5.0, 7.5  # at EK3_CHECK_SCALE 100
ALIGN_S = 10.0  # the checks must pass this long; then they are good, and the first time the origin is set
# AP_NavEKF3_VehicleStatus.cpp, calcGpsGoodToAlign: good checks have wider limits, and are bad after this time without a
# sample that passes, silence included, when the next one fails
HYSTERESIS, BAD_AFTER_S = 1.3, 5.0
STOPPED_AFTER_S = 15.0  # without any aid; then a filter needs good checks (AP_NavEKF3_Control.cpp, setAidingMode)
USE_AFTER_S = {Kind.PLANE: 1.4, Kind.COPTER: 10.6}  # from the origin to "is using GPS"


def passes_checks(fix: Fix, check: int, scale: float) -> bool:
    """Applies EK3_GPS_CHECK to one fix; ``scale``: EK3_CHECK_SCALE in per cent."""
    s = scale / 100.0
    return not (
        (check & CHECK_SATS and fix.satellites < MIN_SATELLITES)
        or (check & CHECK_HDOP and fix.hdop > MAX_HDOP)
        or (check & CHECK_SPEED and (fix.speed_mps or 0.0) > SPEED_MPS * s)
        or (check & CHECK_POSITION and (fix.horizontal_m or 0.0) > HORIZONTAL_M * s)
        or (check & CHECK_POSITION and (fix.vertical_m or 0.0) > VERTICAL_M * s)
    )


class Alignment:
    """Alignment state of the filter. Call ``check`` with every fix of the GPS in use, then ``ready``."""

    def __init__(self, kind: Kind, *, good: bool) -> None:
        """``good``: the checks have passed before."""
        self._kind = kind
        self.good = good
        self._fail_s: float | None = None
        self._pass_s: float | None = None
        self.origin_s: float | None = None  # time at which the origin was set

    def check(self, fix: Fix, now_s: float, check: int, scale: float) -> None:
        if passes_checks(fix, check, scale * (HYSTERESIS if self.good else 1.0)):
            self._pass_s = now_s
            self._fail_s = now_s if self._fail_s is None else self._fail_s
        else:
            self._fail_s = now_s
        if not self.good:
            self.good = now_s - self._fail_s >= ALIGN_S
        elif self._pass_s is not None and now_s - self._pass_s > BAD_AFTER_S:
            self.good = False
        if self.good and self.origin_s is None:
            self.origin_s = now_s

    def ready(self, now_s: float) -> bool:
        """Returns True when the filter can start to use GPS."""
        return self.origin_s is not None and now_s - self.origin_s >= USE_AFTER_S[self._kind]

    def restart(self) -> None:
        """No 3D fix: restarts checks that have not passed yet."""
        if not self.good:
            self._fail_s = None
