"""Alignment before the first use of GPS: the checks of ArduPilot's filter, and its pre-arm checks."""

from collections.abc import Sequence

from terrafix.link.integrity.output_predictor import distance_m
from terrafix_lab.sim.autopilot.navigation.gps import NO_GPS, Fix, GpsInputDriver, GpsInstance
from terrafix_lab.sim.autopilot.navigation.switch import BLEND
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
ARM_AFTER_S = 1.0  # time from there until the pre-arm checks pass
MAX_GPS_DISTANCE_M = 50.0
ARM_ALL, ARM_GPS = 1, 8  # ARMING_CHECK


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


def prearm_failures(
    gps: Sequence[GpsInstance | None],
    alignment: Alignment,
    using_since_s: float | None,
    parameters: dict[str, float],
    kind: Kind,
    now_s: float,
) -> list[str]:
    """Returns the reasons not to arm, in ArduPilot's words without "PreArm: "; empty: arming is possible.

    ``using_since_s``: time since when the filter uses GPS.
    """
    checks = int(parameters["ARMING_CHECK"])
    failures = _gps_failures(gps, int(parameters["GPS_AUTO_SWITCH"]), now_s) if checks & (ARM_ALL | ARM_GPS) else []
    if kind is Kind.COPTER and any(isinstance(g, GpsInputDriver) and _configuring(g) for g in gps):
        return [*failures, "EKF attitude is bad"]
    if alignment.origin_s is None:
        return [*failures, "AHRS: waiting for home"]
    if using_since_s is None or now_s - using_since_s < ARM_AFTER_S:
        return [*failures, "Need Position Estimate"]
    return failures


def _configuring(gps: GpsInstance) -> bool:
    """Fix type 0 at boot keeps a copter's filter from starting: it waits for the receiver's configuration."""
    return gps.has_reported() and gps.fix_type == NO_GPS and not gps.timed_out


def _gps_failures(gps: Sequence[GpsInstance | None], switch: int, now_s: float) -> list[str]:
    present = [g for g in gps if g is not None]
    failures = []
    for g in present:
        if not g.has_fix():
            failures.append(f"GPS {g.instance + 1}: Bad fix")
        elif not g.healthy(now_s):
            failures.append(f"GPS {g.instance + 1}: not healthy")
    fixes = [g.fix for g in present if g.has_fix() and g.fix is not None]
    if len(fixes) == 2:
        distance_apart_m = distance_m(fixes[0].lat_deg, fixes[0].lon_deg, fixes[1].lat_deg, fixes[1].lon_deg)
        if distance_apart_m > MAX_GPS_DISTANCE_M:
            failures.append(f"GPS positions differ by {distance_apart_m:.0f}m")
    if switch == BLEND and len(present) == 2 and failures:
        failures.append("GPS blending unhealthy")
    return failures
