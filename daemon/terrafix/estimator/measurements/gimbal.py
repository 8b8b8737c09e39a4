"""Reports of a gimbal by time: how the camera is held at a frame.

The camera counts as fixed to a platform in the way that [mount] says. With a fixed mount the platform is the vehicle;
on a gimbal it is what the gimbal holds, level with its front along the vehicle's while the camera looks as [mount]
says. The attitude of a frame is that of the platform, so estimator and monitors know one kind of mount.

By MAVLink roll and pitch of a report are against the horizon. Of a mount with servos (MNT1_TYPE 1) ArduPilot reports,
with the same flags, their angles: the opposite of the vehicle's lean. Such reports do not measure the camera."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import quat_from_rot
from terrafix.messages import Camera, Gimbal, GimbalAttitude

BUFFER_REPORTS = 300  # 30 s at 10 Hz; the time offset looks back by less [spec: GRID_S of offset_drift.py]
# 1-sigma of the time of a report against that of the frame: one interval of the requested rate.
LATENCY_S = 0.1  # [spec: STREAMS_HZ of link/mavlink/message_rates.py]
FROZEN_NS = 1_000_000_000  # reports without a change for so long are not measured [spec: MAX_GAP_NS of attitudes]
# Evidence, nats, for reports that are the opposite of the vehicle's lean. [spec: as for a pose, consensus_pose.py]
DECISIVE = 9.0
TILT_RAD = np.radians(2.0)  # 1-sigma of a reported tilt [spec: LEANS_RAD of telemetry_buffer.py]
# Least down component of the view that sees ground for a map match. [spec: MIN_DOWN_COMPONENT of vision/sources]
MIN_VIEW_DOWN = 0.2
# Camera axes in those of the gimbal. [spec: OpenCV; MAVLink gimbal frame]
LOOKING_ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Held:
    """``q`` (4,): the platform in north, east, down where ``from_north``, else in heading, right, down. ``age_ns``: to
    the nearest report; ``turns_rad``: 1-sigma by its turn within LATENCY_S."""

    q: np.ndarray
    from_north: bool
    age_ns: int
    turns_rad: float
    sees_ground: bool


class GimbalReports:
    """``gimbal``: of the camera's description, None: it is fixed to the vehicle. ``add`` in order of time."""

    def __init__(self) -> None:
        self.gimbal: Gimbal | None = None
        self._r_c_p = LOOKING_ALONG_X @ Mount().r_b_c().T
        self._reports: deque[GimbalAttitude] = deque(maxlen=BUFFER_REPORTS)
        self.changed_ns = 0  # time of the newest report that differs from the one before
        self._compared: tuple[int, float, float] | None = None  # time [ns], pitch of platform, vehicle [rad]
        self._opposite = self._held = 0.0  # nats for reports opposite to the vehicle's pitch, and for a level platform

    def describe(self, camera: Camera) -> None:
        """``camera``: as the flight describes it."""
        self.gimbal = camera.gimbal if isinstance(camera.gimbal, Gimbal) else None
        self._r_c_p = LOOKING_ALONG_X @ Mount.of(camera).r_b_c().T

    @property
    def used(self) -> bool:
        """The camera is on a gimbal."""
        return self.gimbal is not None and (self.gimbal.required or bool(self._reports))

    @property
    def stabilised(self) -> tuple[str, ...]:
        """The axes that the gimbal holds level."""
        return () if self.gimbal is None else self.gimbal.stabilised

    def add(self, report: GimbalAttitude, pitch_rad: float | None) -> None:
        """A report. Another device than the camera's does not count. ``pitch_rad``: of the vehicle, None: unknown."""
        wanted, newest = self.gimbal.device if self.gimbal else 0, self._reports[-1] if self._reports else None
        if report.device != (wanted or (newest.device if newest else report.device)):
            return
        if newest is not None and report.t_ns <= newest.t_ns:
            return
        if newest is None or newest.q != report.q:
            self.changed_ns = report.t_ns
        if newest is not None and newest.from_north is not report.from_north:
            self._reports.clear()
        self._reports.append(report)
        if pitch_rad is not None:
            self._compare(report, pitch_rad)

    def _compare(self, report: GimbalAttitude, pitch_rad: float) -> None:
        """Log likelihood ratio of the changes between reports at least FROZEN_NS apart, summed as a CUSUM test (Page
        1954): a servo at its limit does not move. Both sums are limited, so that a gimbal that changes is noticed."""
        if self._compared is not None and report.t_ns - self._compared[0] < FROZEN_NS:
            return
        held_rad = float(euler_of(_product(np.array([report.q]), np.array([quat_from_rot(self._r_c_p)])))[1, 0])
        if self._compared is not None:
            turned_rad, leant_rad = held_rad - self._compared[1], pitch_rad - self._compared[2]
            nats = float((turned_rad**2 - (turned_rad + leant_rad) ** 2) / (4.0 * TILT_RAD**2))
            self._opposite = min(max(self._opposite + nats, 0.0), 2.0 * DECISIVE)
            self._held = min(max(self._held - nats, 0.0), 2.0 * DECISIVE)
        self._compared = report.t_ns, held_rad, pitch_rad

    @property
    def opposes(self) -> bool:
        """Its reports are the opposite of the vehicle's lean."""
        return self._opposite >= DECISIVE

    @property
    def is_level(self) -> bool:
        """Its reports were seen not to follow the vehicle's lean."""
        return self._held >= DECISIVE

    @property
    def unchanged_since_ns(self) -> int | None:
        """Since when all reports are the same to the last bit; None: for less than FROZEN_NS. A gimbal holds its angle
        so only while nothing moves it: such reports repeat an old one, or the commanded angle."""
        if not self._reports or self._reports[-1].t_ns - self.changed_ns < FROZEN_NS:
            return None
        return self.changed_ns

    def at(self, t_ns: int) -> Held | None:
        """None: no report yet."""
        if not self._reports:
            return None
        newer = [report for report in self._reports if report.t_ns >= t_ns][:1] or [self._reports[-1]]
        older = [report for report in self._reports if report.t_ns <= t_ns][-1:] or newer
        both = (older[0], newer[0])
        if older == newer and len(self._reports) > 1:  # not between two: the turn is that of the two nearest ones
            nearest = self._reports.index(newer[0])
            both = (self._reports[max(nearest - 1, 0)], self._reports[max(nearest, 1)])
        times, q = np.array([report.t_ns for report in both]), np.array([report.q for report in both])
        away_rad = 2.0 * float(np.arccos(min(abs(float(q[0] @ q[1])), 1.0)))
        rate_radps = away_rad / max((times[1] - times[0]) * 1e-9, 1e-3)
        seen = slerp(np.array([t_ns]), times, q)
        age_ns = int(np.abs(times - t_ns).min()) if not times[0] <= t_ns <= times[1] else 0
        w, x, y, z = seen[0]
        ground = 2.0 * float(x * z - w * y) >= MIN_VIEW_DOWN  # down component of the gimbal's x axis
        platform = _product(seen, np.array([quat_from_rot(self._r_c_p)]))[0]
        return Held(platform, both[1].from_north, age_ns, rate_radps * LATENCY_S, ground)

    def angles_about(self, t_ns: np.ndarray, yaw_rad: np.ndarray) -> np.ndarray | None:
        """-> yaw, pitch and roll (3, ...) of the platform at times (...) [ns], where the vehicle has the headings
        ``yaw_rad`` (...); None where reports do not cover that."""
        times = np.array([report.t_ns for report in self._reports])
        if len(times) < 2 or times[0] > t_ns.min() or times[-1] < t_ns.max():
            return None
        q = slerp(t_ns.ravel(), times, np.array([report.q for report in self._reports]))
        angles = euler_of(_product(q, np.array([quat_from_rot(self._r_c_p)]))).reshape(3, *t_ns.shape)
        if not self._reports[-1].from_north:
            angles[0] += yaw_rad
        return angles


def slerp(t_ns: np.ndarray, times_ns: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Unit quaternions (M, 4) at ``t_ns`` (M,), between ``q`` (N, 4) at ``times_ns`` (N,), N > 1, increasing; outside
    of them the first or the last. Shoemake 1985."""
    after = np.clip(np.searchsorted(times_ns, t_ns), 1, len(times_ns) - 1)
    q0, q1, t0, t1 = q[after - 1], q[after], times_ns[after - 1], times_ns[after]
    share = np.clip((t_ns - t0) / np.maximum(t1 - t0, 1), 0.0, 1.0)[:, None]
    cos = np.sum(q0 * q1, axis=1, keepdims=True)
    q1, angle = np.where(cos < 0.0, -q1, q1), np.arccos(np.clip(np.abs(cos), 0.0, 1.0))
    sin = np.sin(angle)
    small, whole = sin < 1e-9, np.where(sin < 1e-9, 1.0, sin)
    w0 = np.where(small, 1.0 - share, np.sin((1.0 - share) * angle) / whole)
    w1 = np.where(small, share, np.sin(share * angle) / whole)
    return np.asarray(w0 * q0 + w1 * q1)


def euler_of(q: np.ndarray) -> np.ndarray:
    """(N, 4) -> (3, N): yaw, pitch and roll (Z-Y-X) [rad] of unit quaternions into north, east, down."""
    w, x, y, z = q.T
    return np.array(
        [
            np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
            np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0)),
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        ]
    )


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 4): of quaternions (N, 4) and (1, 4): first ``b``, then ``a``."""
    w, v, s, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return np.hstack([w * s - np.sum(v * u, axis=1, keepdims=True), w * u + s * v + np.cross(v, u)])
