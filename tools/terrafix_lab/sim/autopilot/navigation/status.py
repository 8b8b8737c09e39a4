"""Status of the simulated autopilot derived from its filter: flags, glitches, fail-safe, DCM fallback, and texts.

Times and texts as measured on ArduPilot 4.6.3.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix_lab.sim.autopilot.navigation.ekf import Ekf
from terrafix_lab.sim.autopilot.navigation.gps import Fix
from terrafix_lab.sim.autopilot.parameters import Kind

CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY
GLITCH_AFTER_S = 1.2  # time of rejected positions
DCM_AFTER_S = 4.0  # time of rejected positions, after which a fixed wing falls back to DCM, which uses the raw GPS
FAILSAFE_AFTER_S = 0.8  # time without a position, in a copter
CLEARED_AFTER_S = 1.0  # time with a position again
SPEED_BAD_MPS, SPEED_GOOD_MPS = 1.5, 1.0  # filtered speed accuracy: a glitch above the first, cleared below the second
SPEED_FILTER_S = 5.0  # not measured; of the order of the other hold times
EXTERNAL_AFTER_S = 1.0  # an external position is accepted when GPS has not been fused for this time
ALWAYS = mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_VERT | mavlink.EKF_POS_VERT_ABS
RELATIVE = mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_PRED_POS_HORIZ_REL
ABSOLUTE = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_PRED_POS_HORIZ_ABS
GLITCHING = 32768  # EKF_GPS_GLITCHING of ardupilotmega.xml
StatusMessage = tuple[int, str]  # severity, text


@dataclass(frozen=True)
class Sources:
    """Use of GPS by the active source set."""

    position: bool
    velocity: bool


class Status:
    """Call ``update`` at every step; it yields texts on changes."""

    def __init__(self, kind: Kind, *, has_position: bool) -> None:
        """``has_position``: starts with a known position."""
        self._kind = kind
        self.absolute = has_position  # EKF_POS_HORIZ_ABS: absolute position available
        self.aiding = has_position  # aiding that bounds the velocity
        self.glitching = False
        self.on_dcm = False
        self.in_failsafe = False
        self.failsafes = 0
        self._speed_m = 0.0
        self._speed_s = 0.0
        self._speed_bad = False
        self._rejected = False
        self._without_s: float | None = None
        self._with_s: float | None = None

    def flags(self, *, running: bool) -> int:
        """EKF_STATUS_REPORT.flags; ``running``: the filter has started."""
        if not running:
            return int(mavlink.EKF_UNINITIALIZED)
        flags = ALWAYS | (RELATIVE if self.aiding else mavlink.EKF_CONST_POS_MODE)
        return int(flags | (ABSOLUTE if self.absolute else 0) | (GLITCHING if self.glitching else 0))

    def update_speed_accuracy(self, fix: Fix, now_s: float) -> None:
        """Filters the reported speed accuracy of every fix in use, which can indicate a glitch."""
        share = min(1.0, max(0.0, now_s - self._speed_s) / SPEED_FILTER_S)
        self._speed_m, self._speed_s = self._speed_m + share * ((fix.speed_mps or 0.0) - self._speed_m), now_s
        self._speed_bad = self._speed_m > (SPEED_GOOD_MPS if self._speed_bad else SPEED_BAD_MPS)

    def update(
        self, ekf: Ekf | None, sources: Sources, now_s: float, *, flying: bool, gps_3d: bool, dcm: bool
    ) -> Iterator[StatusMessage]:
        """``dcm``: AHRS_OPTIONS permits the fallback."""
        if ekf is None:
            return
        airborne_plane = self._kind is Kind.PLANE and flying
        last_pass_s = ekf.last_pass_s
        previously_aiding = self.aiding
        recent = last_pass_s is not None and now_s - last_pass_s <= ekf.position_timeout_s()
        self.absolute = recent and (sources.position or flying)
        self.aiding = airborne_plane or (recent and (sources.position or sources.velocity))
        if self.aiding != previously_aiding:
            yield NOTICE, "EKF3 IMU0 is using GPS" if self.aiding else "EKF3 IMU0 stopped aiding"
        yield from self._update_glitch(ekf, now_s, gps_3d=gps_3d, dcm=dcm and airborne_plane)
        if self._kind is Kind.COPTER and flying:
            yield from self._update_failsafe(now_s)

    def _update_glitch(self, ekf: Ekf, now_s: float, *, gps_3d: bool, dcm: bool) -> Iterator[StatusMessage]:
        since_s = ekf.rejecting_since_s
        rejected = since_s is not None and now_s - since_s >= GLITCH_AFTER_S
        if rejected and not self._rejected:
            yield CRITICAL, "GPS Glitch or Compass error"
        if self._rejected and not rejected:
            yield NOTICE, "Glitch cleared"
        self._rejected = rejected
        self.glitching = rejected or self._speed_bad
        on_dcm = dcm and gps_3d and since_s is not None and now_s - since_s >= DCM_AFTER_S
        if on_dcm != self.on_dcm:
            yield WARNING, "AHRS: DCM active" if on_dcm else "AHRS: EKF3 active"
        self.on_dcm = on_dcm

    def _update_failsafe(self, now_s: float) -> Iterator[StatusMessage]:
        if self.absolute:
            self._without_s = None
            self._with_s = now_s if self._with_s is None else self._with_s
        else:
            self._with_s = None
            self._without_s = now_s if self._without_s is None else self._without_s
        lost = self._without_s is not None and now_s - self._without_s >= FAILSAFE_AFTER_S
        if lost and not self.in_failsafe:
            self.in_failsafe, self.failsafes = True, self.failsafes + 1
            yield CRITICAL, "EKF variance"
            yield CRITICAL, "EKF Failsafe: changed to LAND Mode"
        elif self.in_failsafe and self._with_s is not None and now_s - self._with_s >= CLEARED_AFTER_S:
            self.in_failsafe = False
            yield WARNING, "EKF Failsafe Cleared"
