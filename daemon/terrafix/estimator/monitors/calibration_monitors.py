"""All calibration monitors of one flight: messages in, CalibrationFault on every change and a covariance term out."""

import math
from dataclasses import dataclass

import numpy as np

from terrafix.core.agreement import Agreement
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.core.pose import exp_so3
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.monitors.image_orientation import ORIENTATIONS, Orientation
from terrafix.estimator.monitors.image_shape import ShapeMonitor
from terrafix.estimator.monitors.inertial import MOUNT_YAWS_DEG, InertialMonitor
from terrafix.estimator.monitors.levelling import LevellingMonitor
from terrafix.estimator.monitors.map_offsets import (
    HEIGHT_CHANGE_NOISE,
    HEIGHT_CHANGE_SIGMA,
    HEIGHT_NOISE,
    ChangeMonitor,
    OffsetMonitor,
    log_height_ratio,
)
from terrafix.estimator.monitors.registration import Registration
from terrafix.estimator.monitors.turns import TurnMonitor
from terrafix.estimator.monitors.visual_motion import visual_motion
from terrafix.messages import CalibrationFault, MapMatch, Odometry, Origin, Verdict

FAULT_SIGMA_M = 1000.0  # m: least 1-sigma per horizontal axis while the description is known to be wrong [tuned]
MIN_TURN_SPACING_S = 1.0  # s between turns that count: images of one keyframe share their errors [tuned]
# Constant errors, 1-sigma, beyond the configured ones: heading [rad] of a compass beside motors, and height as a share
# of it, of a barometer over uneven ground. [tuned]
MATCH_HEADING_SIGMA_RAD, HEIGHT_SIGMA_SHARE = math.radians(10.0), 0.05
YAW_NOISE_RAD = math.radians(3.0)  # 1-sigma of the heading of one pose against the reported one [tuned]
REPORT_CHANGE = 0.2  # relative change of a factor or an angle after which a fault is reported again [tuned]
FOCAL = "focal length"
# Faults that the claim contains: images that are refused from the frame on that shows them; the height by a lens that
# zooms, whose images move the position no more than the map and inertial readings allow.
CLAIMED = frozenset((FOCAL, *(orientation.quantity for orientation in ORIENTATIONS)))
# Verdicts on frames that were not correlated with the map.
NOT_CORRELATED = (
    Verdict.BAD_IMAGE,
    Verdict.NO_FEATURES,
    Verdict.NO_PREDICTION,
    Verdict.OUTSIDE_MAP,
    Verdict.TOO_LOW,
    Verdict.THROTTLED,
)


@dataclass(frozen=True)
class Finding:
    """``factor``: reported over true value; degrees for angles; None where no monitor measures it."""

    factor: float | None
    detail: str


class Monitors:
    """All monitors of the flight that ``origin`` describes. ``agreement``: of its positions with the map."""

    def __init__(self, origin: Origin) -> None:
        self._origin = origin
        self._r_b_c = Mount.of(origin.camera).r_b_c()
        turns = [exp_so3(np.array([0.0, 0.0, math.radians(deg)])) for deg in MOUNT_YAWS_DEG[1:]]  # [0]: as configured
        self._other_mounts = [turn @ self._r_b_c for turn in turns]
        self._inertial = InertialMonitor()
        self._turns = TurnMonitor(math.radians(origin.yaw_sigma_deg))
        self._levelling = LevellingMonitor()
        self._shape = ShapeMonitor()
        self.agreement = Agreement()
        self._registration = Registration(self.agreement)
        heading = math.hypot(MATCH_HEADING_SIGMA_RAD, math.radians(origin.yaw_sigma_deg))
        self._heading = OffsetMonitor(heading, YAW_NOISE_RAD)
        self._height: OffsetMonitor | None = None  # None until a height is reported
        self._focal = ChangeMonitor(HEIGHT_CHANGE_SIGMA, HEIGHT_CHANGE_NOISE)
        self._times_ns: dict[int, int] = {}  # frame -> time, of frames that may be the keyframe of a later one
        self._turned_s = -math.inf  # time of the last turn that counted
        self._textured: int | None = None  # the newest frame with accepted odometry
        self._orientation: Orientation | None = None
        self._reported: dict[str, Finding] = {}
        self._rise_m = 0.0  # of the ground below over that at the start, by the DEM

    @property
    def sigma_m(self) -> float:
        """1-sigma per horizontal axis, to be added to the published covariance."""
        if any(quantity not in CLAIMED for quantity in self._reported):
            return max(FAULT_SIGMA_M, self._registration.path_error_m)
        return 0.0

    @property
    def focal_changed(self) -> bool:
        """Images show the ground larger or smaller than before."""
        return self._focal.active

    @property
    def path_error_m(self) -> float:
        """Position error by a wrong description that no monitor has named (``Cause.DESCRIPTION``)."""
        return self._registration.path_error_m

    def on_odometry(
        self,
        odometry: Odometry,
        telemetry: Telemetry,
        path_m: float,
        agl_m: float,
        orientation: Orientation | None = None,
    ) -> None:
        """A frame. ``path_m`` since the frame before and ``agl_m``: by the graph's estimate. ``orientation``: of its
        image, where that is not the described one."""
        self._orientation = orientation
        self._times_ns[odometry.frame_id] = odometry.t_ns
        self._registration.add_path(path_m, agl_m)
        keyframe_ns = self._times_ns.get(odometry.keyframe_id)
        self._times_ns = {f: t for f, t in self._times_ns.items() if f >= odometry.keyframe_id}
        if odometry.verdict is not Verdict.ACCEPTED or keyframe_ns is None or keyframe_ns >= odometry.t_ns:
            return
        if orientation is not None:  # the fault is known: the others would explain it, too
            return
        self._textured = odometry.frame_id
        before, now = telemetry.at(keyframe_ns), telemetry.at(odometry.t_ns)
        pairs = np.array(odometry.two_view)
        motion = visual_motion(pairs, before, now, self._r_b_c)
        if motion is None:
            return
        if odometry.t_ns * 1e-9 - self._turned_s >= MIN_TURN_SPACING_S:
            self._turned_s = odometry.t_ns * 1e-9
            self._turns.add(motion.reported_rad, motion.turned_rad)
            span_s = keyframe_ns * 1e-9, odometry.t_ns * 1e-9
            self._levelling.add(pairs, before, now, self._r_b_c, span_s)
            self._shape.add(pairs, before, now, self._r_b_c)
        if now.agl_m is None:
            return
        mounted = (motion, *(visual_motion(pairs, before, now, r_b_c) for r_b_c in self._other_mounts))
        displacements = [complex(*one.displacement) for one in mounted if one is not None]
        if len(displacements) == len(mounted):
            velocities = np.array(displacements) * (now.agl_m - self._rise_m) / ((odometry.t_ns - keyframe_ns) * 1e-9)
            self._add_velocity(velocities, (keyframe_ns + odometry.t_ns) // 2, telemetry)

    def _add_velocity(self, visual_mps: np.ndarray, t_ns: int, telemetry: Telemetry) -> None:
        """``visual_mps`` (4,) complex, for each of MOUNT_YAWS_DEG."""
        t_s = t_ns * 1e-9
        start_s = self._inertial.window_start_s(t_s)
        acceleration = None if start_s is None else telemetry.world_acceleration(round(start_s * 1e9), t_ns)
        if acceleration is not None:
            change_mps = np.trapezoid(acceleration.accel_w_mps2[:, :2], acceleration.s_s, axis=0)
            self._inertial.compare(t_s, visual_mps, complex(*change_mps))
        self._inertial.add(t_s, visual_mps)

    def on_map_match(self, match: MapMatch, telemetry: Telemetry, *, accepted: bool) -> None:
        """``accepted``: the match has entered the graph. Rejected poses are used as well, because one whose height is
        off is rarely accepted."""
        self._shape.by_map = None if match.aspect_ratio == 1.0 else match.aspect_ratio
        if match.ground is not None and self._origin.ground_amsl_m is not None:
            self._rise_m = match.ground.amsl_m - self._origin.ground_amsl_m
        pose = match.verdict is Verdict.ACCEPTED and not match.position_only
        found = accepted and pose
        if found and match.aspect_ratio == 1.0 and self._shape.ratio is not None:  # the map outweighs odometry
            self._shape = ShapeMonitor()
        # A coarse fix in the graph counts neither as found nor as nothing found. 15 % of the correlations of correct
        # flights give one, and 3 of 900 with a wrong mount, heading, focal length or map: too rare to be measured.
        nothing = not accepted and match.frame_id == self._textured and match.verdict not in NOT_CORRELATED
        if match.on_drawn:  # it gives no pose at all
            nothing = False
        if found or nothing:
            self._registration.add_attempt(found=found)
        if not pose or match.pose is None or not match.inliers:  # a place without inliers has neither (decision 072)
            return
        reported = telemetry.at(match.t_ns)
        if reported.yaw_rad is not None:
            observed_rad = yaw_of(rot_from_quat(match.pose.q_w_c) @ self._r_b_c.T)
            self._heading.add(math.remainder(reported.yaw_rad - observed_rad, math.tau))
        if reported.agl_m is not None and match.ground is not None and self._origin.ground_amsl_m is not None:
            reported_m = self._origin.ground_amsl_m + reported.agl_m - match.ground.amsl_m
            observed_m = match.pose.p_c_in_w_m[2] - match.ground.amsl_m
            if self._height is None:
                sigma = math.hypot(
                    self._origin.camera.focal_sigma, HEIGHT_SIGMA_SHARE, self._origin.agl_sigma_m / observed_m
                )
                self._height = OffsetMonitor(sigma, HEIGHT_NOISE)
            self._height.add(log_height_ratio(reported_m, observed_m))
            self._focal.add(log_height_ratio(reported_m, observed_m))

    def on_images_agree(self) -> None:
        """Images that had contradicted inertial readings show the way between two places of the map again."""
        self._shape = ShapeMonitor()

    def take_changes(self, t_ns: int) -> list[CalibrationFault]:
        """Faults that have begun, changed or ended since the last call."""
        now = self._active_findings()
        changes = [
            self._fault(t_ns, name, self._reported[name], active=False) for name in self._reported if name not in now
        ]
        changes += [
            self._fault(t_ns, name, finding, active=True)
            for name, finding in now.items()
            if name not in self._reported or _differs(finding.factor, self._reported[name].factor)
        ]
        for name, finding in now.items():  # the reported value remains the reference for the next change
            if name in self._reported and not _differs(finding.factor, self._reported[name].factor):
                now[name] = self._reported[name]
        self._reported = now
        return changes

    def _active_findings(self) -> dict[str, Finding]:
        found: dict[str, Finding] = {}
        if (hypothesis := self._inertial.fault) is not None:
            found[hypothesis.quantity] = Finding(
                hypothesis.factor, "velocity changes by the images differ from those by the accelerometers"
            )
        if self._turns.mirrored:
            found["mirrored picture"] = Finding(None, "the images rotate opposite to the reported attitude")
        if (orientation := self._orientation) is not None:
            factor = float(orientation.turned_deg) if orientation.quantity == "picture turned" else None
            found[orientation.quantity] = Finding(factor, orientation.detail)
        if (ratio := self._shape.ratio) is not None:
            detail = "the ground has the shape that it has in images whose two axes have different scales"
            found["aspect ratio"] = Finding(ratio, f"{detail}: crop the images instead of scaling them, or set fx")
        if self._levelling.fault:
            found["attitude"] = Finding(None, f"{self._levelling.fault}: images that are levelled by it do not agree")
        if self._height is not None and self._height.active:
            found["scale"] = Finding(
                math.exp(self._height.mean), "reported heights differ from the heights of map matches"
            )
        elif self._focal.active:
            detail = "heights of map matches have changed, and reported ones have not: a lens that zooms, or high trees"
            found[FOCAL] = Finding(math.exp(self._focal.mean), detail)
        if self._heading.active:
            found["heading"] = Finding(
                math.degrees(self._heading.mean), "reported headings differ from the headings of map matches"
            )
        if self._registration.active:
            found["registration"] = Finding(None, "no map match is accepted, over textured ground")
        return found

    @staticmethod
    def _fault(t_ns: int, quantity: str, finding: Finding, *, active: bool) -> CalibrationFault:
        return CalibrationFault(
            t_ns=t_ns, quantity=quantity, factor=finding.factor, detail=finding.detail, active=active
        )


def _differs(now: float | None, before: float | None) -> bool:
    """Whether a factor or an angle differs so much that it is reported again, and is no mere refinement."""
    return now is not None and before is not None and abs(now - before) > REPORT_CHANGE * max(abs(now), abs(before))
