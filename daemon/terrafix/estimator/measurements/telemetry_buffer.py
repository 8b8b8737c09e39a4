"""Telemetry of the autopilot by time: attitude, height and inertial readings around a frame; what is missing is
None."""

import math
from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.core.inertial import GRAVITY_MPS2, covers, integrated, rotate_to_world
from terrafix.core.pose import log_so3, small_turns
from terrafix.estimator.measurements.gimbal import GimbalReports, euler_of
from terrafix.estimator.models.motion_model import WorldAcceleration
from terrafix.messages import GIMBAL_FAULTS, GimbalAttitude, Imu, VehicleState

TURN_UNSEEN_RAD = 0.3  # 1-sigma of the change of an unreported heading up to an unseen frame [tuned]
# 1-sigma of unreported roll and pitch: a copter in cruise tilts by 10 to 20 degrees, a plane banks as much in a turn
UNKNOWN_ATTITUDE_RAD = np.radians(8.0)  # [tuned]
BUFFER_STATES = 400  # 8 s at 50 Hz [tuned]
# Two minutes at 25 and 50 Hz, for which a camera may fail; 30 s at 200 Hz.
BUFFER_ATTITUDES, BUFFER_READINGS = 3000, 6000  # [tuned]
STANDS_BELOW_M = 10.0  # drift of a barometer before take-off [tuned]
MAX_STATE_GAP_NS = 1_000_000_000  # between a state and a frame [tuned]
BOX = np.linspace(-1.0, 1.0, 9)  # where reported angles are averaged about a time, in report intervals [tuned]
REORDER_NS = 200_000_000  # by which states may come out of order [tuned]
# Between readings, and from the last one to the frame: acceleration is interpolated linearly.
MAX_READING_GAP_NS = 120_000_000  # [tuned]
RATE_SPAN_NS = 40_000_000  # on each side: two intervals of the requested attitudes [spec: STREAMS_HZ]
# at 4 Hz, ArduPilot's default, a vehicle turns too far between two [spec: ATTITUDE rate]
MAX_ATTITUDE_GAP_NS = 260_000_000


NOT_REPORTED, REPEATED, OF_SERVOS = GIMBAL_FAULTS
Timed = tuple[np.ndarray, np.ndarray]  # times (N,) [ns], values (3, N)


@dataclass(frozen=True)
class Attitude:
    yaw_rad: float | None
    pitch_rad: float | None
    roll_rad: float | None
    agl_m: float | None
    armed: bool | None = None
    airspeed_mps: float | None = None
    righted_rad: float = 0.0  # 1-sigma of the tilt beyond the configured one (ahrs_correction.py)
    turned_rad: float = 0.0  # 1-sigma of the heading beyond the configured one (same)
    stale_s: float = 0.0  # from the nearest report to the frame, beyond half an interval of the slowest stream
    # That of the vehicle, where the angles above and their errors are those of a platform on a gimbal (gimbal.py)
    vehicle: "Attitude | None" = None
    sees_ground: bool = True  # the gimbal does not look away from it
    gimbal_refused: str = ""  # why the attitude of a camera on a gimbal is not a reported one

    @property
    def of_vehicle(self) -> "Attitude":
        """What inertial readings and airspeed refer to."""
        return self.vehicle or self

    @property
    def stale(self) -> float:
        """0 to 1: of the way from an attitude of the frame's time to one that is too far from it to be used."""
        return self.stale_s * 1e9 / MAX_STATE_GAP_NS

    @property
    def stands(self) -> bool:
        """On the ground, disarmed. With a reported height in the air it is not."""
        return self.armed is False and (self.agl_m is None or self.agl_m < STANDS_BELOW_M)


LEANS_RAD = np.radians(2.0)  # twice the 1-sigma of a reported tilt [spec: attitude_sigma_deg]
_ATTITUDE_ANGLES = ("yaw_rad", "pitch_rad", "roll_rad")
_FIELDS = (*_ATTITUDE_ANGLES, "agl_m", "armed", "airspeed_mps")


class Telemetry:
    def __init__(self) -> None:
        self._states: deque[VehicleState] = deque(maxlen=BUFFER_STATES)
        self._turns = _Series(BUFFER_ATTITUDES)  # yaw, pitch, roll
        self._forces = _Series(BUFFER_READINGS)  # forward, right, down
        self._rates = _Series(BUFFER_READINGS)  # about the same axes
        self.gimbal = GimbalReports()

    def add(self, state: VehicleState) -> None:
        self._states.append(state)
        if state.yaw_rad is None or state.pitch_rad is None or state.roll_rad is None:
            return
        self._turns.add(state.t_ns, state.yaw_rad, state.pitch_rad, state.roll_rad)

    def add_imu(self, imu: Imu) -> None:
        for before_ns, forward, right, down, *rates in imu.samples:
            self._forces.add(imu.t_ns - before_ns, forward, right, down)
            self._rates.add(imu.t_ns - before_ns, *rates)

    def add_gimbal(self, report: GimbalAttitude) -> None:
        turns = self._turns.around(report.t_ns - MAX_ATTITUDE_GAP_NS, report.t_ns)
        known = turns is not None and np.abs(turns[0] - report.t_ns).min() <= MAX_ATTITUDE_GAP_NS
        self.gimbal.add(report, float(np.interp(report.t_ns, turns[0], turns[1][1])) if turns and known else None)

    def at(self, t_ns: int) -> Attitude:
        """What the camera is fixed to at ``t_ns``: the vehicle, or what its gimbal holds (gimbal.py)."""
        vehicle = self._vehicle_at(t_ns)
        return self._platform_at(t_ns, vehicle) if self.gimbal.used else vehicle

    def _platform_at(self, t_ns: int, vehicle: Attitude) -> Attitude:
        """A gimbal that reports nothing, nothing new while the vehicle leans, or the opposite of that lean, holds the
        stabilised axes level to UNKNOWN_ATTITUDE_RAD; the others lean as the vehicle does. A report may be off by that
        lean until it was seen to be level."""
        held = None if self.gimbal.opposes else self.gimbal.at(t_ns)
        yaw_rad, pitch_rad, roll_rad = vehicle.yaw_rad, vehicle.pitch_rad, vehicle.roll_rad
        platform = replace(vehicle, vehicle=vehicle, sees_ground=held is None or held.sees_ground)
        angles = np.zeros(3) if held is None else euler_of(held.q[None])[:, 0]
        if held is not None and held.from_north:
            yaw_rad = float(angles[0])
        elif yaw_rad is not None:
            yaw_rad += float(angles[0])
        refused = OF_SERVOS if self.gimbal.opposes else ""
        if not refused and (held is None or held.age_ns > MAX_STATE_GAP_NS):
            refused = NOT_REPORTED
        if held is None or refused or self._repeats():
            platform = replace(platform, gimbal_refused=refused or REPEATED)
            turned_rad = self._turned_since(self.gimbal.changed_ns, vehicle) if held and held.from_north else 0.0
            yaw_rad = yaw_rad if yaw_rad is None else yaw_rad + turned_rad
            unseen_rad = float(np.hypot(TURN_UNSEEN_RAD, turned_rad))
            lost = replace(platform, yaw_rad=yaw_rad, turned_rad=unseen_rad, righted_rad=UNKNOWN_ATTITUDE_RAD)
            pitches, rolls = (axis not in self.gimbal.stabilised for axis in ("pitch", "roll"))
            if not (pitches or rolls):
                return replace(lost, pitch_rad=None, roll_rad=None)
            return replace(lost, pitch_rad=pitch_rad if pitches else 0.0, roll_rad=roll_rad if rolls else 0.0)
        leans_rad = 0.0 if self.gimbal.is_level else float(np.hypot(vehicle.pitch_rad or 0.0, vehicle.roll_rad or 0.0))
        return replace(
            platform,
            yaw_rad=yaw_rad,
            pitch_rad=float(angles[1]),
            roll_rad=float(angles[2]),
            stale_s=max(vehicle.stale_s, max(0, held.age_ns - MAX_ATTITUDE_GAP_NS // 2) * 1e-9),
            righted_rad=float(np.hypot(held.turns_rad, leans_rad)),
            turned_rad=float(np.hypot(held.turns_rad, leans_rad)),
        )

    def _turned_since(self, t_ns: int, vehicle: Attitude) -> float:
        """How the vehicle has turned since ``t_ns``, and a gimbal with it, if it does not hold its heading."""
        turns = self._turns.around(t_ns - 1, t_ns)
        if turns is None or vehicle.yaw_rad is None:
            return 0.0
        return math.remainder(vehicle.yaw_rad - float(turns[1][0, -1]), math.tau)

    def _repeats(self) -> bool:
        """The gimbal reports no change while the vehicle leans."""
        since_ns = self.gimbal.unchanged_since_ns
        turns = None if since_ns is None else self._turns.around(since_ns, self._turns.newest_ns)
        return turns is not None and bool(np.ptp(turns[1][1:], axis=1).max() > LEANS_RAD)

    def _vehicle_at(self, t_ns: int) -> Attitude:
        """Each field as measured nearest to ``t_ns``; None where there is no value within a second."""
        best: dict[str, tuple[int, float | bool]] = {}
        unsettled = list(_FIELDS)
        for state in reversed(self._states):
            away_ns = abs(state.t_ns - t_ns)
            if away_ns > MAX_STATE_GAP_NS:
                if state.t_ns < t_ns - 2 * MAX_STATE_GAP_NS:
                    break  # they come in order of time, but for REORDER_NS
                continue
            for name in unsettled.copy():
                value = getattr(state, name)
                if value is not None and (name not in best or away_ns <= best[name][0]):
                    best[name] = (away_ns, value)
                elif name in best and state.t_ns + REORDER_NS < t_ns - best[name][0]:
                    unsettled.remove(name)  # whatever is left is farther away
            if not unsettled:
                break
        nearest = {name: value for name, (_, value) in best.items()}
        away_ns = max((best[name][0] for name in _ATTITUDE_ANGLES if name in best), default=0)
        stale_s = max(0, away_ns - MAX_ATTITUDE_GAP_NS // 2) * 1e-9
        return replace(Attitude(*(nearest.get(name) for name in _FIELDS)), stale_s=stale_s)  # type: ignore[arg-type]

    def world_acceleration(self, t0_ns: int, t1_ns: int, turned: np.ndarray | None = None) -> WorldAcceleration | None:
        """Acceleration in the world from ``t0_ns`` to ``t1_ns``; None when readings or attitudes do not cover that.
        ``turned`` (3, 2): attitude errors about east, north and up at both ends [rad], which are removed."""
        known = self._with_attitudes(self._forces, t0_ns, t1_ns)
        if known is None:
            return None
        (t_f, f), (t_a, angles) = known
        inside = t_f[(t_f > t0_ns) & (t_f < t1_ns)]
        t = np.concatenate([[t0_ns], inside, [t1_ns]])
        f_b = [np.interp(t, t_f, axis) for axis in f]
        yaw, pitch, roll = (np.interp(t, t_a, angle) for angle in _unwrapped(angles))
        accel = rotate_to_world(f_b, yaw, pitch, roll)
        if turned is not None:
            away = np.column_stack([np.interp(t, [t0_ns, t1_ns], axis) for axis in turned])
            first = np.cross(away, accel)
            accel = accel - first + 0.5 * np.cross(away, first)  # turned back, to the second order
            yaw = yaw + away[:, 2]  # clockwise
        accel[:, 2] -= GRAVITY_MPS2
        # The scatter from reading to reading is vibration, whatever its frequency.
        spacing_s = (t_f[-1] - t_f[0]) * 1e-9 / (len(t_f) - 1)
        scatter = float(np.mean(np.square(np.diff(f, 2)))) / 6.0 if f.shape[1] > 3 else 0.0
        uncovered_s = max(0.0, (t1_ns - int(t_f[-1])) * 1e-9)
        return WorldAcceleration((t - t0_ns) * 1e-9, accel, yaw, float(np.sqrt(scatter * spacing_s)), uncovered_s)

    @property
    def newest_turn_ns(self) -> int:
        """Time of the newest complete attitude; -1: there was none."""
        return self._turns.newest_ns

    def turned_about(self, t_ns: np.ndarray) -> np.ndarray | None:
        """Reported yaw, pitch and roll (3, N) about times (N,) [ns], unwrapped: means over two report intervals, whose
        noise is the same at a report and between two. None where attitudes do not cover that."""
        turns = self._turns.around(int(t_ns.min()) - MAX_STATE_GAP_NS, int(t_ns.max()) + MAX_STATE_GAP_NS)
        if turns is None:
            return None
        about_ns = np.median(np.diff(turns[0])) * BOX
        if turns[0][0] > t_ns.min() + about_ns[0] or turns[0][-1] < t_ns.max() + about_ns[-1]:
            return None
        at_ns = t_ns[:, None] + about_ns
        return np.stack([np.interp(at_ns, turns[0], angle).mean(axis=1) for angle in _unwrapped(turns[1])])

    def vehicle_rate_radps(self, t_ns: int) -> np.ndarray | None:
        """(3,) of the vehicle about its axes forward, right and down at ``t_ns``, by the gyroscopes; by the attitudes
        where there are none. None where neither covers that."""
        rates = self._rates.around(t_ns - RATE_SPAN_NS, t_ns + RATE_SPAN_NS)
        if rates is not None and np.abs(rates[0] - t_ns).min() <= MAX_READING_GAP_NS:
            near = np.abs(rates[0] - t_ns) <= max(RATE_SPAN_NS, int(np.abs(rates[0] - t_ns).min()))
            return np.asarray(rates[1][:, near].mean(axis=1))
        turns = self._turns.around(t_ns - RATE_SPAN_NS, t_ns + RATE_SPAN_NS)
        if turns is None or np.abs(turns[0] - t_ns).min() > MAX_ATTITUDE_GAP_NS:
            return None
        first, last = (rot_w_b(*turns[1][:, at]) for at in (0, -1))
        return np.asarray(log_so3(first.T @ last)) / ((turns[0][-1] - turns[0][0]) * 1e-9)

    def attitudes_about(self, t_ns: np.ndarray) -> np.ndarray | None:
        """-> R_w_b (N, 3, 3) about times (N,) [ns], as ``turned_about``, of what the camera is fixed to."""
        angles = self.turned_about(t_ns)
        if angles is not None and self.gimbal.used:
            angles = self.gimbal.angles_about(t_ns, angles[0])
        if angles is None:
            return None
        return np.stack([rotate_to_world([*axis], *angles) for axis in np.eye(3)], axis=2)

    def velocity_changes(self, t0_ns: int, t1_ns: int, offset_s: np.ndarray) -> np.ndarray | None:
        """(N,) complex, east + j north [m/s]: change of velocity from ``t0_ns`` to ``t1_ns``, both less each of
        ``offset_s`` (N,). None when readings or attitudes do not cover that."""
        first_ns, last_ns = t0_ns - round(offset_s.max() * 1e9), t1_ns - round(offset_s.min() * 1e9)
        known = self._velocities(first_ns, last_ns)
        if known is None:
            return None
        before, after = (np.interp((t_ns - first_ns) * 1e-9 - offset_s, *known) for t_ns in (t0_ns, t1_ns))
        return np.asarray(after - before)

    def velocities(self, t_ns: int, offset_s: np.ndarray) -> np.ndarray | None:
        """(N,) complex, east + j north [m/s]: velocity at ``t_ns`` less each of ``offset_s`` (N,), but for a constant;
        the newest one for times that come later. None when readings or attitudes do not cover that."""
        first_ns, last_ns = t_ns - round(offset_s.max() * 1e9), t_ns - round(offset_s.min() * 1e9)
        known = self._velocities(first_ns, min(last_ns, self._forces.newest_ns, self._turns.newest_ns))
        return None if known is None else np.interp((t_ns - first_ns) * 1e-9 - offset_s, *known)

    def _velocities(self, t0_ns: int, t1_ns: int) -> tuple[np.ndarray, np.ndarray] | None:
        """-> seconds since ``t0_ns`` (M,), and by how much the velocity has changed since then (M,), complex."""
        world = self.world_acceleration(t0_ns, t1_ns)
        if world is None:
            return None
        accel_mps2 = world.accel_w_mps2[:, 0] + 1j * world.accel_w_mps2[:, 1]
        return world.s_s, integrated(accel_mps2, world.s_s)

    def turns_by_gyro(self, t0_ns: int, t1_ns: int, offset_s: np.ndarray) -> np.ndarray | None:
        """(N, 3): rotation of the vehicle about east, north and up [rad] from ``t0_ns`` to ``t1_ns``, both less each of
        ``offset_s`` (N,), by the gyroscopes. None when readings or attitudes do not cover that, or when a gimbal holds
        the camera."""
        first_ns, last_ns = t0_ns - round(offset_s.max() * 1e9), t1_ns - round(offset_s.min() * 1e9)
        known = None if self.gimbal.used else self._with_attitudes(self._rates, first_ns, last_ns)
        if known is None:
            return None
        (t_g, rates), (t_a, angles) = known
        rates_w = rotate_to_world([*rates], *(np.interp(t_g, t_a, angle) for angle in _unwrapped(angles)))
        s_s = (t_g - t_g[0]) * 1e-9
        turned = integrated(rates_w, s_s)
        at_s = [(t_ns - t_g[0]) * 1e-9 - offset_s for t_ns in (t0_ns, t1_ns)]
        return np.column_stack([np.interp(at_s[1], s_s, axis) - np.interp(at_s[0], s_s, axis) for axis in turned.T])

    def turn_without_gyro(self, t0_ns: int, t1_ns: int) -> tuple[np.ndarray, float] | None:
        """-> rotation (3,) about east, north and up [rad] by which the attitude turned from ``t0_ns`` to ``t1_ns`` and
        the gyroscopes did not, and the angle by which these turned. None when readings or attitudes do not cover
        that."""
        known = self._with_attitudes(self._rates, t0_ns, t1_ns)
        if known is None:
            return None
        (t_g, w), (t_a, angles) = known
        inside = t_a[(t_a > t0_ns) & (t_a < t1_ns)]
        t = np.concatenate([[t0_ns], inside, [t1_ns]])
        yaw, pitch, roll = (np.interp(t, t_a, angle) for angle in _unwrapped(angles))
        r_w_b = np.stack([rotate_to_world([*axis], yaw, pitch, roll) for axis in np.eye(3)], axis=2)
        turned = small_turns(r_w_b[:-1], r_w_b[1:])
        # The integral of the rates, from one attitude to the next, in the world by the attitude between them.
        summed = [np.concatenate([[0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * np.diff(t_g) * 1e-9)]) for a in w]
        by_gyro = [np.diff(np.interp(t, t_g, axis)) for axis in summed]
        between = (0.5 * (angle[1:] + angle[:-1]) for angle in (yaw, pitch, roll))
        apart = turned.sum(axis=0) - rotate_to_world(by_gyro, *between).sum(axis=0)
        return apart, float(np.linalg.norm(by_gyro, axis=0).sum())

    def _with_attitudes(self, readings: "_Series", t0_ns: int, t1_ns: int) -> tuple[Timed, Timed] | None:
        """Readings and attitudes around a span; None when they do not cover it."""
        read, turns = readings.around(t0_ns, t1_ns), self._turns.around(t0_ns, t1_ns)
        if t1_ns <= t0_ns or read is None or turns is None:
            return None
        covered = covers(read[0], t0_ns, t1_ns, MAX_READING_GAP_NS)
        return (read, turns) if covered and covers(turns[0], t0_ns, t1_ns, MAX_ATTITUDE_GAP_NS) else None


class _Series:
    """The newest ``size`` readings of three axes, in order of time; one older than the newest is dropped."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._t_ns = array("q")
        self._axes = (array("d"), array("d"), array("d"))

    def add(self, t_ns: int, x: float, y: float, z: float) -> None:
        if self._t_ns and t_ns <= self._t_ns[-1]:
            return
        self._t_ns.append(t_ns)
        for axis, value in zip(self._axes, (x, y, z), strict=True):
            axis.append(value)
        if len(self._t_ns) > 2 * self._size:
            for column in (self._t_ns, *self._axes):
                del column[: -self._size]

    @property
    def newest_ns(self) -> int:
        return self._t_ns[-1] if self._t_ns else -1

    def around(self, t0_ns: int, t1_ns: int) -> Timed | None:
        """Times (N,) and values (3, N) from the last one before ``t0_ns`` to the first one after ``t1_ns``."""
        first = max(0, bisect_right(self._t_ns, t0_ns) - 1)
        last = min(len(self._t_ns), bisect_left(self._t_ns, t1_ns) + 1)
        if last - first < 2:
            return None
        return np.array(self._t_ns[first:last]), np.array([axis[first:last] for axis in self._axes])


def _unwrapped(angles: np.ndarray) -> np.ndarray:
    """(3, N). np.unwrap is slow, also where nothing wraps."""
    return np.unwrap(angles, axis=1) if np.abs(np.diff(angles, axis=1)).max() >= np.pi else angles
