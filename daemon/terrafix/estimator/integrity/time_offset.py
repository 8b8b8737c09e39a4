"""Time offset between camera and autopilot, from what both observe of the vehicle's rotation (the calibration state td
of OpenVINS; Qin and Shen 2018, "Online temporal calibration for monocular visual-inertial systems").

A frame with a time stamp that is late by ``offset_s`` shows the attitude of that much before. Levelled with the
attitude of the right time, images turn as the heading does, and their velocity changes as the accelerometers say;
levelled with another one, it jumps wherever the vehicle rolls or pitches. All offsets of a grid are compared.

The offset may drift: the buffer of a stream fills while its receiver is slower than its sender. So it is a hidden
Markov chain over offset and rate on a grid, a point mass filter (Bucy and Senne 1971): constant, at one of some rates,
or jumping. How often it begins to drift depends on the source."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from terrafix.core.agreement import P_REJECTED
from terrafix.core.gate import GATE, MIN_COMPONENT_WEIGHT
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.integrity.offset_drift import GRID_S, RATES, RESOLUTION_S2, Hazards, predicted, transitions
from terrafix.estimator.integrity.velocity_evidence import VelocityEvidence
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.monitors.levelling import ACCELERATION_SIGMA_MPS2
from terrafix.estimator.monitors.visual_motion import MIN_DOWN, MIN_PAIRS
from terrafix.messages import STAMP_SIGMA_S, CalibrationFault, Frame, Odometry, Verdict

FAR_S = 3.0 * STAMP_SIGMA_S  # s: a larger offset is not that of transfer alone [spec: three sigmas]
UNSTAMPED_SHARE = 0.01  # of cameras whose buffers or pipeline may delay by anything on the grid [tuned]
OUTSIDE_S = 5.0  # s, 1-sigma of an offset at the end of the grid, or beyond it [spec: the width of the grid]
# Hazard of a buffer that lies between exposure and stamp: one that begins to fill in an hour of flight, one that jumps
# in five; elsewhere a false alarm of the monitors. [spec: FALSE_ALARM_HOURS, monitors/cusum.py, at a stamp of exposure]
BUFFERED, STAMPED = Hazards(1.0 / 3600.0, 0.2 / 3600.0), Hazards(1.0 / 3.6e6, 1.0 / 3.6e6)
MAX_PAIRS = 24  # of an image, spread over it: more do not improve what the attitude's noise limits [measured: 40 pairs]
# ns between two frames that are compared: the error of an attitude grows slower than what the vehicle turns.
MIN_SPAN_NS = 400_000_000  # [measured: docs/decisions/058]
MIN_TURN_SIGMA_RAD, MIN_TILT_SIGMA_RAD = np.radians(0.1), np.radians(0.05)  # of changes between two frames [tuned]
# 1-sigma of the mount's tilt, by which a roll looks like a turn, or a jump [spec: twice that of turn_comparison.py]
MOUNT_SIGMA_RAD = np.radians(3.0)
INERTIAL_SIGMA_MPS2 = 0.2  # with them: a tilt that is wrong by a degree [spec: attitude_sigma_deg]
NOISE_MEMORY = 50.0  # comparisons: 20 s [spec: twice attitude_slow_s of the simulated sensors]
INDEPENDENT_SHARE = 0.5  # of the comparisons: two consecutive ones share a frame [tuned]
# Least share of the noise that the images have. Without a limit two of three healthy flights had a false offset.
MIN_NOISE_SHARE = 0.5  # [measured: docs/decisions/058]
# Variance of a position by images over that of its change in a span, which a third would be if attitudes were white.
CORRELATED = 4.0  # [measured: docs/decisions/058]
MAX_GAP_S = 2.0  # s between two velocities that are compared [spec: the slowest camera, a frame in two seconds]
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
    ``velocity_mps`` (2,) at ``agl_m`` above the ground."""

    t_ns: int
    off: Innovation
    velocity_mps: np.ndarray
    agl_m: float

    def back_m(self, agreed_s: float, telemetry: Telemetry) -> np.ndarray:
        """(2, L): from the place at each offset to that at the offset ``agreed_s``, with which the estimate agrees."""
        mps = np.full(len(GRID_S), complex(*self.velocity_mps))
        if (varied := telemetry.velocities(self.t_ns, GRID_S)) is not None:
            mps += varied - np.interp(agreed_s, GRID_S, varied)
        way_m = np.concatenate([[0.0], np.cumsum(0.5 * (mps[1:] + mps[:-1]) * np.diff(GRID_S))])
        way_m -= np.interp(agreed_s, GRID_S, way_m)
        return np.stack([way_m.real, way_m.imag])

    @property
    def _cov_m2(self) -> np.ndarray:
        return np.asarray(self.off.covariance + RESOLUTION_S2 * np.outer(self.velocity_mps, self.velocity_mps))

    def density(self, back_m: np.ndarray) -> np.ndarray:
        """(L,) likelihood [1/m^2] of each offset, ``back_m`` (2, L)."""
        off_m = self.off.residual[:, None] + back_m
        distance2 = np.sum(off_m * np.linalg.solve(self._cov_m2, off_m), axis=0)
        return np.asarray(np.exp(-0.5 * distance2) / (2.0 * np.pi * np.sqrt(np.linalg.det(self._cov_m2))))

    @property
    def density_across(self) -> float:
        """Likelihood [1/m] of a wrong motion along the velocity."""
        speed_mps = float(np.hypot(*self.velocity_mps))
        east, north = self.velocity_mps / speed_mps if speed_mps > 0.0 else np.array([1.0, 0.0])
        across = np.array([-north, east])
        variance_m2 = float(across @ self._cov_m2 @ across)
        return float(np.exp(-0.5 * (across @ self.off.residual) ** 2 / variance_m2) / np.sqrt(2 * np.pi * variance_m2))


@dataclass(frozen=True)
class _View:
    """Ray pairs (N, 4) of a keyframe and a frame, and the time stamps of both."""

    frame_id: int
    keyframe_id: int
    keyframe_ns: int
    t_ns: int
    pairs: np.ndarray
    agl_m: float


@dataclass(frozen=True)
class _Levelled:
    """Levelled at each offset: ``moved`` (L,) complex, displacement since some keyframe [heights, east + j north];
    ``turned_rad`` (L,) by which the turn since then differs from the reported one; ``tilt`` (L,): sines of roll and
    pitch, as complex numbers."""

    t_ns: int
    moved: np.ndarray
    turned_rad: np.ndarray
    tilt: np.ndarray


@dataclass(frozen=True)
class _Velocity:
    """(L,) complex [heights/s, east + j north] over ``span_s`` about ``middle_ns``, and the part (L,) of its variance
    that an error of the mount explains."""

    middle_ns: int
    span_s: float
    mean: np.ndarray
    mount2: np.ndarray


class TimeOffset:
    """``applied_s``: the offset to subtract from the time stamps of frames; 0 until it is significant.

    ``r_b_c`` (3, 3): mount of the camera."""

    def __init__(self, r_b_c: np.ndarray) -> None:
        self.applied_s = 0.0
        self.buffered = False
        self._r_b_c = r_b_c
        self._stamps_ns: dict[int, int] = {}  # frame -> stamp, of frames that may be the keyframe of a later one
        self._pending: deque[_View] = deque()  # until attitudes have arrived that are as late as the grid reaches
        # Frames that may be the keyframe of a later one, since the same keyframe, and the newest that was compared.
        self._chain: dict[int, _Levelled] = {}
        self._before: _Levelled | None = None
        self._velocity: _Velocity | None = None
        self._rate = VelocityEvidence()
        self._prior_sigma_s = STAMP_SIGMA_S
        self._mass = _prior(STAMP_SIGMA_S)  # at ``_at_ns``
        self._at_ns: int | None = None  # stamp of the newest frame that was compared ...
        self._newest_ns = 0  # ... and of the newest one
        # Variances of turns [rad^2] and of changes of velocity [heights^2/s^2, each axis]: first guess, then learnt.
        self._noise = [np.radians(0.5) ** 2, 0.02**2]
        self._density: np.ndarray | None = None  # of the newest frame
        self._reported_s: float | None = None
        # Offset with which position and images agreed at last, where they do not now; what has contradicted since.
        self._agreed_s: float | None = None
        self._contradicted: set[str] = set()
        self._jumps = False  # what has contradicted is known, and not subtracted yet

    def stamped(self, frame: Frame) -> None:
        """How its source stamps ``frame``: the prior until a first image is compared, and how often an offset begins to
        drift or jumps."""
        self.buffered = frame.buffered
        if self._at_ns is None and frame.stamp_sigma_s != self._prior_sigma_s:
            self._prior_sigma_s, self._mass = frame.stamp_sigma_s, _prior(frame.stamp_sigma_s)

    def forget_images(self) -> None:
        """The newest images contradict their description: those that wait for attitudes tell nothing of the time."""
        self._pending.clear()
        self._chain, self._before, self._velocity = {}, None, None

    def add(self, odometry: Odometry, telemetry: Telemetry, agl_m: float) -> None:
        """A frame, at its uncorrected time stamp."""
        self._stamps_ns = {frame: t for frame, t in self._stamps_ns.items() if frame >= odometry.keyframe_id}
        self._stamps_ns[odometry.frame_id] = self._newest_ns = odometry.t_ns
        self._density = None
        keyframe_ns = self._stamps_ns.get(odometry.keyframe_id)
        seen = odometry.verdict is Verdict.ACCEPTED and len(odometry.two_view) >= MIN_PAIRS
        if seen and keyframe_ns is not None and keyframe_ns < odometry.t_ns:
            pairs = np.array(odometry.two_view[:: max(1, len(odometry.two_view) // MAX_PAIRS)])
            frames = odometry.frame_id, odometry.keyframe_id, keyframe_ns, odometry.t_ns
            self._pending.append(_View(*frames, pairs, max(agl_m, 1.0)))
        reach_ns = round(-GRID_S[0] * 1e9) + REPORT_WAIT_NS
        while self._pending and self._pending[0].t_ns + reach_ns <= telemetry.newest_turn_ns:
            self._compare(self._pending.popleft(), telemetry)
        while self._pending and self._pending[0].t_ns + 2 * reach_ns < odometry.t_ns:  # no attitude is reported
            self._pending.popleft()

    def agree(self) -> None:
        """The map has confirmed the position, or moved it to where the images are."""
        self._agreed_s, self._contradicted, self._jumps = None, set(), False

    def contradict(self, seen: Contradiction, telemetry: Telemetry, *, by_map: bool) -> None:
        """An offset that jumps moves the image along the way that was flown. A wrong motion of images lies along it,
        too, or anywhere, as a wrong pose on the map does (``by_map``). The first of each counts: those that follow
        repeat it."""
        kind, rate = ("map", P_REJECTED) if by_map else ("images", P_IMPLAUSIBLE)
        if kind in self._contradicted or (abs(self.estimate[0] - self.applied_s) > FAR_S and not self._contradicted):
            return  # a correction that is under way moves the frames as well
        self._contradicted.add(kind)
        if self._agreed_s is None:
            self._agreed_s = self.estimate[0]
        self.forget_images()
        since_s = 0.0 if self._at_ns is None else (seen.t_ns - self._at_ns) * 1e-9
        mass = predicted(self._mass, since_s, self._hazards)
        jumped = seen.density(seen.back_m(self._agreed_s, telemetry))
        anywhere = 1.0 / (2.0 * seen.agl_m) ** 2  # in what the camera sees
        if not by_map:
            anywhere = 0.5 * (anywhere + seen.density_across / (2.0 * seen.agl_m))
        mass *= jumped + rate * anywhere
        self._jumps = True
        self._mass, self._at_ns, self._density = mass / mass.sum(), max(seen.t_ns, self._at_ns or seen.t_ns), None

    @property
    def density(self) -> np.ndarray:
        """Probabilities over ``GRID_S`` at the newest frame."""
        if self._density is None:
            since_s = 0.0 if self._at_ns is None else (self._newest_ns - self._at_ns) * 1e-9
            self._density = predicted(self._mass, since_s, self._hazards).sum(axis=0)
        return self._density

    @property
    def estimate(self) -> tuple[float, float]:
        """Mean and 1-sigma of the density [s]."""
        mean_s = float(self.density @ GRID_S)
        return mean_s, self._sigma_about(mean_s)

    @property
    def sigma_s(self) -> float:
        """1-sigma of the offset that remains after correction.

        The prior's sigma limits it until the probability of an offset that transfer does not explain reaches
        MIN_COMPONENT_WEIGHT, where it affects a 95 % ellipse."""
        remaining_s = self._sigma_about(self.applied_s)
        if float(self.density[-2:].sum() + self.density[:2].sum()) >= MIN_COMPONENT_WEIGHT:
            return max(remaining_s, OUTSIDE_S)
        return (
            remaining_s if self._far(self.applied_s) >= MIN_COMPONENT_WEIGHT else min(remaining_s, self._prior_sigma_s)
        )

    def step(self, dt_s: float) -> bool:
        """Moves ``applied_s`` towards the estimate where that is known and not 0, towards 0 where it is 0; elsewhere it
        stays. An offset that has jumped is subtracted at once: on the way there images would show more motion than the
        time between them. ``dt_s``: since the last frame. -> whether that is so."""
        far, target_s = self._far(0.0), self.applied_s
        median_s = GRID_S[np.searchsorted(np.cumsum(self.density), 0.5)]
        near = np.where(np.abs(GRID_S - median_s) <= KNOWN_S, self.density, 0.0)
        if min(far, float(near.sum())) >= 1.0 - MIN_COMPONENT_WEIGHT:
            target_s = float(near @ GRID_S / near.sum())
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
        return float(self.density[np.abs(GRID_S - from_s) > FAR_S].sum())

    def _sigma_about(self, from_s: float) -> float:
        return float(np.sqrt(self.density @ (GRID_S - from_s) ** 2 + RESOLUTION_S2))

    def _compare(self, view: _View, telemetry: Telemetry) -> None:
        now = self._levelled(view, telemetry)
        if now is None or view.keyframe_id not in self._chain:  # another fragment
            self._chain, self._before, self._velocity = {}, None, None
        if now is None:
            return
        if (keyframe := self._chain.get(view.keyframe_id)) is not None:
            now = _Levelled(now.t_ns, keyframe.moved + now.moved, keyframe.turned_rad + now.turned_rad, now.tilt)
        self._chain = {frame: one for frame, one in self._chain.items() if frame >= view.keyframe_id}
        self._chain[view.frame_id] = now
        before = self._before = self._before or now
        if now.t_ns - before.t_ns < MIN_SPAN_NS:
            return
        self._before, slower, span_s = now, self._velocity, (now.t_ns - before.t_ns) * 1e-9
        mount2 = MOUNT_SIGMA_RAD**2 * np.abs(now.tilt - before.tilt) ** 2
        moved, middle_ns = (now.moved - before.moved) / span_s, (now.t_ns + before.t_ns) // 2
        faster = self._velocity = _Velocity(middle_ns, span_s, moved, mount2 / span_s**2)
        turned_rad = (now.turned_rad - before.turned_rad + np.pi) % (2.0 * np.pi) - np.pi
        log = self._log_likelihood(0, turned_rad, mount2, MIN_TURN_SIGMA_RAD**2, 1)
        if slower is not None:
            jump, floor = _jump(slower, faster, view.agl_m, telemetry)
            log = log + self._log_likelihood(1, jump, 0.5 * (faster.mount2 + slower.mount2), floor, 2)
        since_s = 0.0 if self._at_ns is None else (view.t_ns - self._at_ns) * 1e-9
        rate = self._rate_log_likelihood(slower, faster, since_s, view.agl_m, telemetry)
        mass = predicted(self._mass, since_s, self._hazards)
        for part in (log, rate[:, None]):
            mass *= np.exp(np.maximum(part - part.max(), -MAX_NATS))
        self._mass, self._at_ns = mass / mass.sum(), view.t_ns

    def _rate_log_likelihood(
        self, before: _Velocity | None, now: _Velocity, since_s: float, agl_m: float, telemetry: Telemetry
    ) -> np.ndarray:
        """(R,) of the velocity that images show at the most probable offset. Zero where nothing measures how the
        vehicle's changed."""
        change_mps = None
        if before is not None and since_s < MAX_GAP_S:
            change_mps = telemetry.velocity_changes(before.middle_ns, now.middle_ns, GRID_S)
        if change_mps is None:
            self._rate.forget()
            change_mps = np.zeros(len(GRID_S))
        at, rates = int(np.argmax(self._mass.sum(axis=0))), self._mass.sum(axis=1)
        moved_m, change = complex(now.mean[at]) * now.span_s * agl_m, complex(change_mps[at])
        noise_m2 = (CORRELATED * self._noise[1] + now.mount2[at]) * (now.span_s * agl_m) ** 2
        joint = rates[:, None] * transitions(since_s, self._hazards)
        return self._rate.update(joint, moved_m, now.span_s, noise_m2, change)

    def _levelled(self, view: _View, telemetry: Telemetry) -> _Levelled | None:
        """None where attitudes do not cover the grid."""
        shift_ns = np.round(GRID_S * 1e9).astype(np.int64)
        points, tilt = [], np.zeros(0)
        for t_ns, xy in ((view.keyframe_ns, view.pairs[:, :2]), (view.t_ns, view.pairs[:, 2:])):
            attitudes = telemetry.attitudes_about(t_ns - shift_ns)
            if attitudes is None:
                return None
            r_w_b, tilt = attitudes
            rays = r_w_b @ self._r_b_c @ np.column_stack([xy, np.ones(len(xy))]).T  # (L, 3, N)
            points.append((rays[:, 0] + 1j * rays[:, 1]) / np.maximum(-rays[:, 2], MIN_DOWN))
        keyframe, frame = points
        from_mean, to_mean = frame - frame.mean(1, keepdims=True), keyframe - keyframe.mean(1, keepdims=True)
        ratio = (from_mean.conj() * to_mean).sum(1) / np.maximum((np.abs(from_mean) ** 2).sum(1), 1e-12)
        return _Levelled(view.t_ns, keyframe.mean(1) - ratio * frame.mean(1), np.angle(ratio), tilt)

    def _log_likelihood(
        self, kind: int, residual: np.ndarray, mount2: np.ndarray, floor: float, axes: int
    ) -> np.ndarray:
        """(L,) of the ``residual`` (L,) at each offset. ``mount2`` (L,): variance by the mount; ``floor``: least
        variance of the noise.

        The attitude is noisy itself. Where it varies over the grid no more than its noise does, it tells nothing: the
        residual shrinks towards its mean over the grid (regression dilution)."""
        noise, density = max(self._noise[kind], floor), self._mass.sum(axis=0)
        mean = residual.mean()
        gain = max(0.0, 1.0 - noise / max(float(np.mean(np.abs(residual - mean) ** 2)), 1e-12))
        variance = max(gain, MIN_NOISE_SHARE) * noise + mount2
        likely2 = float(density @ np.clip(np.abs(residual) ** 2 - mount2, 0.0, GATE[2] * self._noise[kind]))
        self._noise[kind] += (likely2 - self._noise[kind]) / NOISE_MEMORY
        shrunk2 = np.abs(mean + gain * (residual - mean)) ** 2
        return np.asarray(-0.5 * INDEPENDENT_SHARE * axes * (shrunk2 / variance + np.log(variance)))


def _prior(sigma_s: float) -> np.ndarray:
    """(R, L) mass of a constant offset with ``sigma_s`` about 0, and of some share anywhere."""
    mass = np.zeros((len(RATES), len(GRID_S)))
    stamped = np.exp(-0.5 * (GRID_S / sigma_s) ** 2)
    mass[0] = (1.0 - UNSTAMPED_SHARE) * stamped / stamped.sum() + UNSTAMPED_SHARE / len(GRID_S)
    return mass


def _jump(before: _Velocity, now: _Velocity, agl_m: float, telemetry: Telemetry) -> tuple[np.ndarray, float]:
    """-> (L,) complex, change of velocity that inertial readings do not explain [heights/s], over the root of two, and
    its least variance on each axis."""
    between_s = (now.middle_ns - before.middle_ns) * 1e-9
    change_mps = telemetry.velocity_changes(before.middle_ns, now.middle_ns, GRID_S)
    accel_mps2 = ACCELERATION_SIGMA_MPS2 if change_mps is None else INERTIAL_SIGMA_MPS2
    inertial = 0.0 if change_mps is None else change_mps / agl_m
    tilt = MIN_TILT_SIGMA_RAD * float(np.hypot(1.0 / now.span_s, 1.0 / before.span_s))
    return (now.mean - before.mean - inertial) / np.sqrt(2.0), tilt**2 + (accel_mps2 * between_s / agl_m) ** 2
