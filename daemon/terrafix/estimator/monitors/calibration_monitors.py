"""All monitors of one flight: messages in, CalibrationFault on every change out, and what to add to the covariance."""

import math
from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_from_quat, yaw_of
from terrafix.core.pose import exp_so3
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.monitors.inertial import MOUNT_YAWS_DEG, InertialMonitor
from terrafix.estimator.monitors.levelling import LevellingMonitor
from terrafix.estimator.monitors.map_offsets import SCATTER, OffsetMonitor, told_over_seen
from terrafix.estimator.monitors.registration import Registration
from terrafix.estimator.monitors.sighting import sighting
from terrafix.estimator.monitors.turns import TurnMonitor
from terrafix.messages import CalibrationFault, MapMatch, Odometry, Origin, Verdict

UNKNOWN_M = 1000.0  # 1-sigma per horizontal axis while a description is known to be wrong
SPACING_S = 1.0  # between turns that count: pictures of one keyframe share their errors
# Constant errors, 1-sigma, beyond the described ones: a compass beside motors, a barometer over uneven ground.
HEADING_RAD, HEIGHT_SHARE = math.radians(10.0), 0.05
YAW_SCATTER_RAD = math.radians(3.0)
ANOTHER = 0.2  # of a factor, by which it changes to be said again
NOT_LOOKED = (Verdict.BAD_IMAGE, Verdict.NO_FEATURES, Verdict.NO_PREDICTION, Verdict.OUTSIDE_MAP, Verdict.TOO_LOW)


@dataclass(frozen=True)
class Finding:
    """``factor``: told over true; for angles degrees; None where nothing tells."""

    factor: float | None
    detail: str


class Monitors:
    def __init__(self, origin: Origin) -> None:
        self._origin = origin
        self._r_b_c = Mount.of(origin.camera).r_b_c()
        turns = [exp_so3(np.array([0.0, 0.0, math.radians(deg)])) for deg in MOUNT_YAWS_DEG[1:]]  # the first is none
        self._other_mounts = [turn @ self._r_b_c for turn in turns]
        self._inertial = InertialMonitor()
        self._turns = TurnMonitor(math.radians(origin.yaw_sigma_deg))
        self._levelling = LevellingMonitor()
        self._registration = Registration()
        heading = math.hypot(HEADING_RAD, math.radians(origin.yaw_sigma_deg))
        self._heading = OffsetMonitor(heading, YAW_SCATTER_RAD)
        self._height: OffsetMonitor | None = None  # until a height was told
        self._times_ns: dict[int, int] = {}  # frame -> time, of keyframes that may be referred to
        self._turned_s = -math.inf
        self._textured: int | None = None  # the newest frame whose motion was seen
        self._said: dict[str, Finding] = {}

    @property
    def sigma_m(self) -> float:
        """1-sigma per horizontal axis, to be added to what is claimed."""
        return UNKNOWN_M if self._said else min(UNKNOWN_M, self._registration.sigma_m)

    def odometry(self, odometry: Odometry, telemetry: Telemetry, way_m: float, height_m: float) -> None:
        """A frame, with its way since the frame before and its height above the ground, both as the graph has them."""
        self._times_ns[odometry.frame_id] = odometry.t_ns
        self._registration.flew(way_m, height_m)
        began_ns = self._times_ns.get(odometry.keyframe_id)
        self._times_ns = {f: t for f, t in self._times_ns.items() if f >= odometry.keyframe_id}
        if odometry.verdict is not Verdict.ACCEPTED or began_ns is None or began_ns >= odometry.t_ns:
            return
        self._textured = odometry.frame_id
        before, now = telemetry.at(began_ns), telemetry.at(odometry.t_ns)
        pairs = np.array(odometry.pairs)
        seen = sighting(pairs, before, now, self._r_b_c)
        if seen is None:
            return
        if odometry.t_ns * 1e-9 - self._turned_s >= SPACING_S:
            self._turned_s = odometry.t_ns * 1e-9
            self._turns.add(seen.said_rad, seen.turned_rad)
            span_s = began_ns * 1e-9, odometry.t_ns * 1e-9
            self._levelling.add(pairs, before, now, self._r_b_c, span_s)
        if now.agl_m is None:
            return
        mounted = (seen, *(sighting(pairs, before, now, r_b_c) for r_b_c in self._other_mounts))
        moved = [complex(*one.moved) for one in mounted if one is not None]
        if len(moved) == len(mounted):
            velocities = np.array(moved) * now.agl_m / ((odometry.t_ns - began_ns) * 1e-9)
            self._velocity(velocities, (began_ns + odometry.t_ns) // 2, telemetry)

    def _velocity(self, seen_mps: np.ndarray, t_ns: int, telemetry: Telemetry) -> None:
        t_s = t_ns * 1e-9
        began_s = self._inertial.window(t_s)
        felt = None if began_s is None else telemetry.felt(round(began_s * 1e9), t_ns)
        if felt is not None:
            change_mps = np.trapezoid(felt.accel_w_mps2[:, :2], felt.s_s, axis=0)
            self._inertial.compare(t_s, seen_mps, complex(*change_mps))
        self._inertial.add(t_s, seen_mps)

    def matched(self, match: MapMatch, telemetry: Telemetry, *, accepted: bool) -> None:
        """What the map said of a frame. ``accepted``: it has entered the graph; one whose height is off seldom does."""
        pose = match.verdict is Verdict.ACCEPTED and not match.coarse
        found = accepted and pose
        # A coarse fix in the graph is no look that finds nothing: 15 % of the looks of true flights give one, and 3 of
        # 900 with a mount, heading, focal length or map that is wrong. Too rare there to be measured, it counts for
        # nothing.
        nothing = not accepted and match.frame_id == self._textured and match.verdict not in NOT_LOOKED
        if found or nothing:
            self._registration.looked(found=found)
        if not pose or match.p_c_in_w_m is None or match.q_w_c is None:
            return
        told = telemetry.at(match.t_ns)
        if told.yaw_rad is not None:
            seen_rad = yaw_of(rot_from_quat(match.q_w_c) @ self._r_b_c.T)
            self._heading.add(math.remainder(told.yaw_rad - seen_rad, math.tau))
        if told.agl_m is not None and match.ground is not None and self._origin.ground_amsl_m is not None:
            told_m = self._origin.ground_amsl_m + told.agl_m - match.ground[0]
            seen_m = match.p_c_in_w_m[2] - match.ground[0]
            if self._height is None:
                sigma = math.hypot(self._origin.camera.focal_sigma, HEIGHT_SHARE, self._origin.agl_sigma_m / seen_m)
                self._height = OffsetMonitor(sigma, SCATTER)
            self._height.add(told_over_seen(told_m, seen_m))

    def changes(self, t_ns: int) -> list[CalibrationFault]:
        """What has begun or ended since the last call."""
        now = self._found()
        said = [self._fault(t_ns, name, self._said[name], active=False) for name in self._said if name not in now]
        said += [
            self._fault(t_ns, name, finding, active=True)
            for name, finding in now.items()
            if name not in self._said or _differs(finding.factor, self._said[name].factor)
        ]
        for name, finding in now.items():  # what was said stays the measure of what is another finding
            if name in self._said and not _differs(finding.factor, self._said[name].factor):
                now[name] = self._said[name]
        self._said = now
        return said

    def _found(self) -> dict[str, Finding]:
        found: dict[str, Finding] = {}
        if (hypothesis := self._inertial.fault) is not None:
            found[hypothesis.quantity] = Finding(
                hypothesis.factor, "velocity changes of pictures against accelerometers"
            )
        if self._turns.mirrored:
            found["mirrored picture"] = Finding(None, "pictures turn the other way than the attitude")
        if self._levelling.fault:
            found["attitude"] = Finding(None, f"{self._levelling.fault}: pictures that it levels jump")
        if self._height is not None and self._height.active:
            found["scale"] = Finding(math.exp(self._height.mean), "told heights against poses on the map")
        if self._heading.active:
            found["heading"] = Finding(math.degrees(self._heading.mean), "told headings against poses on the map")
        if self._registration.active:
            found["registration"] = Finding(None, "the map is found nowhere, over textured ground")
        return found

    @staticmethod
    def _fault(t_ns: int, quantity: str, finding: Finding, *, active: bool) -> CalibrationFault:
        return CalibrationFault(
            t_ns=t_ns, quantity=quantity, factor=finding.factor, detail=finding.detail, active=active
        )


def _differs(now: float | None, before: float | None) -> bool:
    """Factors or degrees that are two findings, not one that is known better by now."""
    return now is not None and before is not None and abs(now - before) > ANOTHER * max(abs(now), abs(before))
