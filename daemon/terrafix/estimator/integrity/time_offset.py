"""Time offset between camera and autopilot, from what both observe of the vehicle's rotation (the calibration state td
of OpenVINS; Qin and Shen 2018, "Online temporal calibration for monocular visual-inertial systems").

A frame with a time stamp that is late by ``offset_s`` shows the rotation of that much before. Turbulence turns a
vehicle by some tenths of a degree in each frame, also in straight flight; the rotation between two frames, by the
points of the ground that both show, is compared with that of the gyroscopes at all offsets of a grid.

The offset may drift: the buffer of a stream fills while its receiver is slower than its sender. So it is a hidden
Markov chain over offset and rate on a grid, a point mass filter (Bucy and Senne 1971): constant, at one of some rates,
or jumping. How often it begins to drift depends on the source."""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.agreement import P_REJECTED
from terrafix.core.gate import GATE, MIN_COMPONENT_WEIGHT
from terrafix.core.inertial import integrated
from terrafix.core.pose import log_so3, small_turns
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.integrity.offset_drift import (
    DRIFT_GRID_S,
    RATES,
    RESOLUTION_S2,
    Hazards,
    held,
    predicted,
    transitions,
)
from terrafix.estimator.integrity.velocity_evidence import (
    DEGREES_OF_FREEDOM,
    FIRST_GUESS,
    NOISE_MEMORY,
    VelocityEvidence,
)
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.models.plane_motion import MIN_MOTION_PAIRS, Ground, relative_pose
from terrafix.messages import STAMP_SIGMA_S, CalibrationFault, Frame, Odometry, Verdict

FAR_S = 3.0 * STAMP_SIGMA_S  # s: a larger offset is not that of transfer alone [spec: three sigmas]
UNSTAMPED_SHARE = 0.01  # of cameras whose buffers or pipeline may delay by anything on the grid [tuned]
OUTSIDE_S = 5.0  # s, 1-sigma of an offset at the end of the grid, or beyond it [spec: the width of the grid]
# Hazard of a buffer that lies between exposure and stamp: one that begins to fill in 20 minutes of flight, one that
# jumps in five hours; elsewhere a false alarm of the monitors.
# [spec: MONITOR_FALSE_ALARM_HOURS, monitors/cusum.py, at a stamp of exposure; measured: docs/decisions/058]
BUFFERED, STAMPED = Hazards(3.0 / 3600.0, 0.2 / 3600.0), Hazards(1.0 / 3.6e6, 1.0 / 3.6e6)
# ns between two frames that are compared: as long as a gust turns a vehicle, longer than vibration and pixel noise.
MIN_SPAN_NS = 900_000_000  # [measured: docs/decisions/058]
# 1-sigma of a rotation between two frames, about each axis: first guess with gyroscopes, and by two attitudes; lower
# limit. [measured: docs/decisions/058; spec: root of two times the attitude of a cheap autopilot; tuned]
GYRO_SIGMA_RAD, ATTITUDE_SIGMA_RAD, MIN_OFFSET_TURN_SIGMA_RAD = np.radians(0.3), np.radians(1.5), np.radians(0.1)
# 1-sigma of the mount's tilt, by which a turn looks like a roll [spec: twice that of turn_comparison.py]
MOUNT_SIGMA_RAD = np.radians(3.0)
# The images alone determine the tilt between two frames: the attitude only selects one of two mirror solutions.
MIRROR_TILT_SIGMA_RAD = np.radians(10.0)  # [spec: beyond the lean of a vehicle within an offset of the grid]
HEIGHT_SHARE = 0.1  # 1-sigma of the height, share of it: rotations do not depend on it [tuned]
# Least share of the noise that the images have. Without a limit two of three healthy flights had a false offset.
MIN_NOISE_SHARE = 0.5  # [measured: docs/decisions/058]
# s between two velocities that are compared [spec: the slowest camera, a frame in two seconds]
MAX_VELOCITY_GAP_S = 2.0
MAX_NATS = 6.0  # of one comparison: twice MAX_STEP of the monitors [spec: monitors/cusum.py]
REPORT_WAIT_NS = 250_000_000  # ns beyond the grid until all attitudes have arrived: two periods at 8 Hz [tuned]
# Probability of a motion of images that is implausible, in a frame of a flight whose offset is constant.
P_IMPLAUSIBLE = 1e-3  # [measured: none in 2000 frames, docs/decisions/058]
KNOWN_S = 0.5  # s: an offset that is applied lies within this of the median, two of its largest 1-sigma [tuned]
MAX_SLEW = 0.2  # s/s: rate of change of the applied offset [tuned]
REPORT_EVERY_S = 0.5  # s: change of a reported offset that is reported again [spec: 10 m at 20 m/s]
QUANTITY = "camera time"


@dataclass(frozen=True)
class Contradiction:
    """A frame at the uncorrected ``t_ns``, which images or map place ``off`` the estimate (2,), which moves with
    ``velocity_mps`` (2,) at ``agl_m`` above the ground. ``keyframe_id``: of the motion that images show; -1: none.
    ``agreed_sigma_s``: 1-sigma of the offset with which that agrees."""

    t_ns: int
    off: Innovation
    velocity_mps: np.ndarray
    agl_m: float
    keyframe_id: int = -1
    agreed_sigma_s: float = 0.0

    def back_m(self, agreed_s: float, telemetry: Telemetry) -> np.ndarray:
        """(2, L): from the place at each offset to that at the offset ``agreed_s``, with which the estimate agrees."""
        mps = np.full(len(DRIFT_GRID_S), complex(*self.velocity_mps))
        if (varied := telemetry.velocities(self.t_ns, DRIFT_GRID_S)) is not None:
            mps += varied - np.interp(agreed_s, DRIFT_GRID_S, varied)
        way_m = integrated(mps, DRIFT_GRID_S)
        way_m -= np.interp(agreed_s, DRIFT_GRID_S, way_m)
        return np.stack([way_m.real, way_m.imag])

    @property
    def _cov_m2(self) -> np.ndarray:
        along_s2 = RESOLUTION_S2 + self.agreed_sigma_s**2
        return np.asarray(self.off.covariance + along_s2 * np.outer(self.velocity_mps, self.velocity_mps))

    def density(self, back_m: np.ndarray) -> np.ndarray:
        """(L,) likelihood [1/m^2] of each offset, ``back_m`` (2, L)."""
        off_m = self.off.residual[:, None] + back_m
        distance2 = np.sum(off_m * np.linalg.solve(self._cov_m2, off_m), axis=0)
        return np.asarray(np.exp(-0.5 * distance2) / (2.0 * np.pi * np.sqrt(np.linalg.det(self._cov_m2))))

    @property
    def across_m(self) -> tuple[float, float]:
        """Distance from the way that was flown, and its variance [m^2]."""
        speed_mps = float(np.hypot(*self.velocity_mps))
        east, north = self.velocity_mps / speed_mps if speed_mps > 0.0 else np.array([1.0, 0.0])
        across = np.array([-north, east])
        return float(across @ self.off.residual), float(across @ self._cov_m2 @ across)

    @property
    def density_across(self) -> float:
        """Likelihood [1/m] of a wrong motion along the velocity."""
        across_m, variance_m2 = self.across_m
        return float(np.exp(-0.5 * across_m**2 / variance_m2) / np.sqrt(2 * np.pi * variance_m2))


@dataclass(frozen=True)
class _Registered:
    """A frame relative to some keyframe: horizontal displacement [m, east + j north], and rotation about east, north
    and up by the images (3,), and less that by the autopilot at each offset (L, 3) [rad]. ``by_gyro``: by its
    gyroscopes, not by its attitudes."""

    t_ns: int
    moved_m: complex
    turned_rad: np.ndarray
    apart_rad: np.ndarray
    by_gyro: bool = True

    def after(self, keyframe: "_Registered") -> "_Registered":
        """Relative to that of ``keyframe``."""
        return _Registered(
            self.t_ns,
            keyframe.moved_m + self.moved_m,
            keyframe.turned_rad + self.turned_rad,
            keyframe.apart_rad + self.apart_rad,
            keyframe.by_gyro and self.by_gyro,
        )


class TimeOffset:
    """``applied_s``: the offset to subtract from the time stamps of frames; 0 until it is significant.

    ``r_b_c`` (3, 3): mount of the camera."""

    def __init__(self, r_b_c: np.ndarray) -> None:
        self.applied_s = 0.0
        self.buffered = False
        self._r_b_c = r_b_c
        self._stamps_ns: dict[int, int] = {}  # frame -> stamp, of frames that may be the keyframe of a later one
        # Odometry, and height above ground [m], until attitudes have arrived that are as late as the grid reaches.
        self._pending: deque[tuple[Odometry, int, float]] = deque()
        # Frames that may be the keyframe of a later one, since the same keyframe, and the newest that was compared.
        self._chain: dict[int, _Registered] = {}
        self._before: _Registered | None = None
        self._rate = VelocityEvidence()
        self._prior_sigma_s = STAMP_SIGMA_S
        self._mass = _prior(STAMP_SIGMA_S)  # at ``_at_ns``
        self._at_ns: int | None = None  # stamp of the newest frame that was compared ...
        self._newest_ns = 0  # ... and of the newest one
        # Variance of a rotation about east, north and up [rad^2], by gyroscopes or not.
        self._noise = {True: np.full(3, GYRO_SIGMA_RAD**2), False: np.full(3, ATTITUDE_SIGMA_RAD**2)}
        self._gyro_bias = np.zeros(3)  # [rad/s], about the same axes
        self._compared = FIRST_GUESS  # comparisons that both rest on
        self._density: np.ndarray | None = None  # of the newest frame
        self._reported_s: float | None = None
        # Offset with which position and images agreed at last, where they do not now; what has contradicted since.
        self._agreed: tuple[float, float] | None = None  # its mean and 1-sigma
        self._new_ns, self._repeated_ns = 0, 0  # stamp of the newest frame with a new view, and of a repeat since
        self._contradicted: set[str] = set()
        self._before_jump: tuple[int, np.ndarray] | None = None  # stamp of images that have jumped, mass without that
        self._held = False  # repeats came before the newest new view, and the map has not agreed since
        self._jumps = False  # what has contradicted is known, and not subtracted yet

    def stamped(self, frame: Frame) -> None:
        """How its source stamps ``frame``: the prior, until a first image is compared or exposures are reported, and
        how often an offset begins to drift or jumps."""
        exposed, self.buffered = self.buffered and not frame.buffered, frame.buffered
        if (self._at_ns is None or exposed) and frame.stamp_sigma_s != self._prior_sigma_s:
            self._prior_sigma_s, self._mass = frame.stamp_sigma_s, _prior(frame.stamp_sigma_s)

    def forget_images(self) -> None:
        """The newest images contradict their description: those that wait for attitudes tell nothing of the time."""
        self._pending.clear()
        self._chain, self._before = {}, None

    def add(self, odometry: Odometry, telemetry: Telemetry, agl_m: float) -> None:
        """A frame, at its uncorrected time stamp."""
        self._stamps_ns = {frame: t for frame, t in self._stamps_ns.items() if frame >= odometry.keyframe_id}
        self._stamps_ns[odometry.frame_id] = self._newest_ns = odometry.t_ns
        self._density = None
        keyframe_ns = self._stamps_ns.get(odometry.keyframe_id)
        seen = odometry.verdict is Verdict.ACCEPTED and len(odometry.two_view) >= MIN_MOTION_PAIRS
        if seen and keyframe_ns is not None and keyframe_ns < odometry.t_ns:
            self._pending.append((odometry, keyframe_ns, max(agl_m, 1.0)))
        reach_ns = round(-DRIFT_GRID_S[0] * 1e9) + REPORT_WAIT_NS
        while self._pending and self._pending[0][0].t_ns + reach_ns <= telemetry.newest_turn_ns:
            self._compare(*self._pending.popleft(), telemetry)
        while self._pending and self._pending[0][0].t_ns + 2 * reach_ns < odometry.t_ns:  # no attitude is reported
            self._pending.popleft()

    def agree(self) -> None:
        """The map has confirmed the position, or moved it to where the images are."""
        self._jumps, self._held = self._jumps and self._held, False  # a match of the frame that jumped, at its old time
        self._agreed, self._contradicted, self._before_jump = None, set(), None

    def contradict(self, seen: Contradiction, telemetry: Telemetry, *, by_map: bool) -> None:
        """An offset that jumps moves the image along the way that was flown. A wrong motion of images lies along it,
        too, or anywhere, as a wrong pose on the map does (``by_map``). The first of each counts: those that follow
        repeat it, or show that the images are others."""
        kind, rate = ("map", P_REJECTED) if by_map else ("images", P_IMPLAUSIBLE)
        under_way = self._agreed is None and abs(self.estimate[0] - self.applied_s) > FAR_S
        if kind in self._contradicted:
            self._refute_jump(seen)
        if kind in self._contradicted or under_way:  # a correction that is under way moves the frames as well
            return
        self._contradicted.add(kind)
        if not by_map:
            self._before_jump = seen.t_ns, self._mass
        agreed_s, sigma_s = self._agreed = self._agreed or self._agreement
        seen = replace(seen, agreed_sigma_s=sigma_s)
        self.forget_images()
        since_s = 0.0 if self._at_ns is None else (seen.t_ns - self._at_ns) * 1e-9
        mass = predicted(self._mass, since_s, self._hazards)
        jumped = seen.density(seen.back_m(agreed_s, telemetry))
        anywhere = 1.0 / (2.0 * seen.agl_m) ** 2  # in what the camera sees
        if not by_map:
            anywhere = 0.5 * (anywhere + seen.density_across / (2.0 * seen.agl_m))
        mass *= jumped + rate * anywhere
        self._jumps = True
        self._mass, self._at_ns, self._density = mass / mass.sum(), max(seen.t_ns, self._at_ns or seen.t_ns), None

    def _refute_jump(self, seen: Contradiction) -> None:
        """Images that only come at another time move along the way that was flown from the first of them on."""
        if self._before_jump is None or "map" in self._contradicted:
            return
        (jumped_ns, mass), (across_m, variance_m2) = self._before_jump, seen.across_m
        if across_m**2 > GATE[1] * variance_m2 and self._stamps_ns.get(seen.keyframe_id, -1) >= jumped_ns:
            self.forget_images()
            self._mass, self._density, self._jumps = mass, None, False

    def view(self, t_ns: int, *, repeated: bool) -> None:
        """A frame shows a new view of the ground, or one of before. Repeats may have gone into a buffer: the next new
        view decides (``contradict``)."""
        if repeated:
            self._repeated_ns = t_ns
            return
        held_s, self._new_ns = (self._repeated_ns - self._new_ns) * 1e-9, t_ns
        if 0.0 < held_s <= DRIFT_GRID_S[-1] and self.buffered:
            self._agreed, self._contradicted, self._held = self._agreed or self._agreement, set(), True
            self._mass, self._density = held(self._mass, held_s), None

    @property
    def _agreement(self) -> tuple[float, float]:
        """Offset with which the estimate agrees, and its 1-sigma."""
        mean_s = self.estimate[0]
        return mean_s, self._claim_about(mean_s)

    @property
    def is_held(self) -> bool:
        """Repeats may be in a buffer: how the newest view lies tells whether they are."""
        return self._agreed is not None and not self._contradicted

    @property
    def density(self) -> np.ndarray:
        """Probabilities over ``DRIFT_GRID_S`` at the newest frame."""
        if self._density is None:
            since_s = 0.0 if self._at_ns is None else (self._newest_ns - self._at_ns) * 1e-9
            self._density = predicted(self._mass, since_s, self._hazards).sum(axis=0)
        return self._density

    @property
    def estimate(self) -> tuple[float, float]:
        """Mean and 1-sigma of the density [s]."""
        mean_s = float(self.density @ DRIFT_GRID_S)
        return mean_s, self._sigma_about(mean_s)

    @property
    def sigma_s(self) -> float:
        """1-sigma of the offset that remains after correction.

        The prior's sigma limits it until the probability of an offset that transfer does not explain reaches
        MIN_COMPONENT_WEIGHT, where it affects a 95 % ellipse."""
        remaining_s = self._claim_about(self.applied_s)
        if float(self.density[-2:].sum() + self.density[:2].sum()) >= MIN_COMPONENT_WEIGHT:
            return max(remaining_s, OUTSIDE_S)
        return remaining_s

    def _claim_about(self, from_s: float) -> float:
        sigma_s = self._sigma_about(from_s)
        return sigma_s if self._far(from_s) >= MIN_COMPONENT_WEIGHT else min(sigma_s, self._prior_sigma_s)

    def step(self, dt_s: float) -> bool:
        """Moves ``applied_s`` towards the estimate where that is known and not 0, towards 0 where it is 0; elsewhere it
        stays. An offset that has jumped is subtracted at once: on the way there images would show more motion than the
        time between them. ``dt_s``: since the last frame. -> whether that is so."""
        far, target_s = self._far(0.0), self.applied_s
        median_s = DRIFT_GRID_S[np.searchsorted(np.cumsum(self.density), 0.5)]
        near = np.where(np.abs(DRIFT_GRID_S - median_s) <= KNOWN_S, self.density, 0.0)
        if min(far, float(near.sum())) >= 1.0 - MIN_COMPONENT_WEIGHT:
            target_s = float(near @ DRIFT_GRID_S / near.sum())
        elif far <= 0.5:
            target_s = 0.0
        off_s = target_s - self.applied_s
        max_step_s = MAX_SLEW * max(dt_s, 0.0)
        if jumps := self._jumps and abs(off_s) > FAR_S:
            self._jumps, max_step_s = False, abs(off_s)
        self.applied_s += float(np.clip(off_s, -max_step_s, max_step_s))
        return jumps

    @property
    def is_wrong(self) -> bool:
        """An offset is known that is not corrected yet."""
        return self._reported_s is not None

    def take_changes(self, t_ns: int) -> list[CalibrationFault]:
        """The fault of an offset that is not corrected, where it has begun, changed or ended since the last call."""
        mean_s, before_s = self.estimate[0], self._reported_s
        active = self._far(self.applied_s) >= 0.5 and abs(mean_s - self.applied_s) > FAR_S
        if before_s is None and not active:
            return []
        if before_s is not None and active and abs(mean_s - before_s) < REPORT_EVERY_S:
            return []
        if active and abs(mean_s) <= FAR_S:
            return []  # what was subtracted is on its way back
        if before_s is not None and not active and self._far(self.applied_s) >= MIN_COMPONENT_WEIGHT:
            return []  # not sure yet
        self._reported_s = mean_s if active else None
        now_s = mean_s if active else self.applied_s if abs(self.applied_s) > FAR_S else 0.0
        detail = "images show roll, pitch and turns at another time than the autopilot reports them"
        if not active:
            detail = "it is subtracted from the time stamps" if now_s else "images and attitude agree in time"
        return [CalibrationFault(t_ns=t_ns, quantity=QUANTITY, factor=now_s, detail=detail, active=active)]

    # --- comparison ----------------------------------------------------------------------------------------------

    @property
    def _hazards(self) -> Hazards:
        return BUFFERED if self.buffered else STAMPED

    def _far(self, from_s: float) -> float:
        """Probability of an offset that is not within FAR_S of ``from_s``."""
        return float(self.density[np.abs(DRIFT_GRID_S - from_s) > FAR_S].sum())

    def _sigma_about(self, from_s: float) -> float:
        return float(np.sqrt(self.density @ (DRIFT_GRID_S - from_s) ** 2 + RESOLUTION_S2))

    def _compare(self, odometry: Odometry, keyframe_ns: int, agl_m: float, telemetry: Telemetry) -> None:
        now = self._registered(odometry, keyframe_ns, agl_m, telemetry)
        if now is None:
            self._chain, self._before = {}, None
            return
        if self._before is None or odometry.keyframe_id not in self._chain:  # another fragment
            self._rate.forget()
            self._before = _Registered(keyframe_ns, 0j, np.zeros(3), np.zeros((len(DRIFT_GRID_S), 3)))
            self._chain = {odometry.keyframe_id: self._before}
        before, now = self._before, now.after(self._chain[odometry.keyframe_id])
        self._chain = {frame: one for frame, one in self._chain.items() if frame >= odometry.keyframe_id}
        self._chain[odometry.frame_id] = now
        if now.t_ns - before.t_ns < MIN_SPAN_NS:
            return
        self._before = now
        since_s = 0.0 if self._at_ns is None else (now.t_ns - self._at_ns) * 1e-9
        log = self._rotation_log_likelihood(before, now)
        rate = self._rate_log_likelihood(before, now, since_s, agl_m, telemetry)
        mass = predicted(self._mass, since_s, self._hazards)
        for part in (log, rate[:, None]):
            mass *= np.exp(np.maximum(part - part.max(), -MAX_NATS))
        self._mass, self._at_ns = mass / mass.sum(), now.t_ns

    def _registered(
        self, odometry: Odometry, keyframe_ns: int, agl_m: float, telemetry: Telemetry
    ) -> _Registered | None:
        """The frame relative to its keyframe. None where attitudes do not cover the grid, or the images do not
        determine the rotation."""
        shift_ns = np.round(DRIFT_GRID_S * 1e9).astype(np.int64)
        ends = (telemetry.attitudes_about(t_ns - shift_ns) for t_ns in (keyframe_ns, odometry.t_ns))
        bodies = [r_w_b for r_w_b in ends if r_w_b is not None]
        if len(bodies) < 2:
            return None
        at = int(np.argmax(self._mass.sum(axis=0)))
        cameras = [r_w_b[at] @ self._r_b_c for r_w_b in bodies]
        ground, pairs = Ground(agl_m, HEIGHT_SHARE * agl_m), np.array(odometry.two_view)
        motion = relative_pose(pairs, odometry.sigma_norm, cameras[0], cameras[1], MIRROR_TILT_SIGMA_RAD, ground)
        if motion is None:
            return None
        turned_rad, moved_m = cameras[0] @ log_so3(motion.r), cameras[0] @ motion.p_m
        by_gyro = telemetry.turns_by_gyro(keyframe_ns, odometry.t_ns, DRIFT_GRID_S)
        reported_rad = small_turns(bodies[0], bodies[1]) if by_gyro is None else by_gyro
        apart_rad = turned_rad - reported_rad
        return _Registered(odometry.t_ns, complex(*moved_m[:2]), turned_rad, apart_rad, by_gyro is not None)

    def _rotation_log_likelihood(self, before: _Registered, now: _Registered) -> np.ndarray:
        """(L,) of the rotation between two frames at each offset.

        The autopilot's rotation is noisy itself. Where it varies over the grid no more than its noise does, it tells
        nothing: the residual shrinks towards its mean over the grid (regression dilution)."""
        span_s, turned_rad = (now.t_ns - before.t_ns) * 1e-9, now.turned_rad - before.turned_rad
        residual = now.apart_rad - before.apart_rad - self._gyro_bias * span_s  # (L, 3)
        mount2 = MOUNT_SIGMA_RAD**2 * (turned_rad @ turned_rad - turned_rad**2)  # about the other two axes
        learnt, density, mean = self._noise[now.by_gyro], self._mass.sum(axis=0), residual.mean(0)
        noise = np.maximum(learnt, MIN_OFFSET_TURN_SIGMA_RAD**2)
        gain = np.maximum(0.0, 1.0 - noise / np.maximum(np.mean((residual - mean) ** 2, axis=0), 1e-12))
        variance = np.maximum(gain, MIN_NOISE_SHARE) * noise + mount2
        likely2 = density @ np.clip(residual**2 - mount2, 0.0, GATE[2] * learnt)
        self._compared = min(self._compared + 1.0, NOISE_MEMORY)
        learnt += (likely2 - learnt) / self._compared
        self._gyro_bias += density @ residual / span_s / self._compared
        # Relief between the two frames may look like a rotation that the gyroscopes do not have at any offset.
        shrunk2 = np.minimum((mean + gain * (residual - mean)) ** 2, GATE[1] * variance)
        nu = DEGREES_OF_FREEDOM
        return np.asarray(-0.5 * (nu + 1.0) * np.log1p(shrunk2 / (nu * variance)).sum(axis=1))

    def _rate_log_likelihood(
        self, before: _Registered, now: _Registered, since_s: float, agl_m: float, telemetry: Telemetry
    ) -> np.ndarray:
        """(R,) of the displacement that images show. Zero where nothing measures how the vehicle's velocity
        changed."""
        span_s, changes = (now.t_ns - before.t_ns) * 1e-9, None
        if since_s < MAX_VELOCITY_GAP_S:
            changes = telemetry.velocity_changes(before.t_ns, now.t_ns, DRIFT_GRID_S)
        if changes is None:
            self._rate.forget()
            return np.zeros(len(RATES))
        density = self._mass.sum(axis=0)
        change_mps = complex(density @ changes)
        spread_m2ps2 = 0.5 * float(density @ np.abs(changes - change_mps) ** 2)  # by the offset that is not known
        joint = self._mass.sum(axis=1)[:, None] * transitions(since_s, self._hazards)
        return self._rate.update(joint, now.moved_m - before.moved_m, span_s, (change_mps, spread_m2ps2), agl_m)


def _prior(sigma_s: float) -> np.ndarray:
    """(R, L) mass of a constant offset with ``sigma_s`` about 0, and of some share anywhere."""
    mass = np.zeros((len(RATES), len(DRIFT_GRID_S)))
    stamped = np.exp(-0.5 * (DRIFT_GRID_S / sigma_s) ** 2)
    mass[0] = (1.0 - UNSTAMPED_SHARE) * stamped / stamped.sum() + UNSTAMPED_SHARE / len(DRIFT_GRID_S)
    return mass
