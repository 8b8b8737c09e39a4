"""Fragments of odometry, and the test whether a fragment belongs to this flight.

Frames that odometry registers to each other form a fragment (a map of ORB-SLAM3's atlas, Campos et al. 2021). The
fragment that begins after a loss of tracking may show another flight: images of another camera, or an old buffer.
Its frames are consistent with each other, as those of a true one are. So odometry of a new fragment is not fused until
independent evidence confirms that it belongs to this flight.

A confirmed fragment may still be disconnected: only dead reckoning says where it lies relative to the fragments before.
It is joined by a camera pose on the map, by a relocalisation in a joined fragment, or by motion as predicted where
inertial readings have measured all of the motion since the fragment before."""

import math
from collections.abc import Container
from dataclasses import dataclass, field

import numpy as np

FOREIGN_SPEED_MPS = 30.0  # m/s: images of another flight move with up to this, in any direction [tuned]
CONFIRM_LLR = 3.0  # nats per frame: 1 in 20 foreign motions is as close to the prediction by chance [tuned]
CONSISTENT_D2 = 1.39  # squared Mahalanobis distance [spec: chi-square, 2 degrees of freedom, 50 %]
HIT_RATE_MEMORY = 10.0  # correlations over which the hit rate is averaged [tuned]
MAX_HIT_RATE = 0.9  # upper limit of the hit rate that is used: the ground changes along the flight [tuned]
CONFIRM_FRAMES = 2  # consecutive frames with sufficient evidence [tuned]
# A fragment of this duration [s] and length [frames] is confirmed without evidence, with the position covariance of
# dead reckoning. Over ground that the map does not match, nothing else would confirm it. [tuned]
CONFIRM_AFTER_S, CONFIRM_AFTER_FRAMES = 30.0, 20
STEP_SHARE = 0.04  # of a step: error of odometry over real ground, where nothing corrects it [tuned]


@dataclass
class Fragment:
    """Frames that odometry registers to each other, from ``start_s`` on.

    ``fragment_id``: by vision; -1: the frame is registered to none. ``start_m`` (2,), ``start_cov_m2`` (2, 2): position
    of its first frame by dead reckoning, east and north. ``displacement_m`` (2,): from there to its newest frame by
    odometry. ``confirmed``: it belongs to this flight, and its odometry is fused. ``joined``: a measurement ties it to
    the flight; a joined fragment is confirmed."""

    start_s: float
    fragment_id: int = -1
    start_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    start_cov_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    displacement_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    confirmed: bool = False
    joined: bool = False
    map_llr: float = 0.0  # nats, "this flight against any other", of correlations that found no pose
    frames: int = 1
    consistent_frames: int = 0  # consecutive frames whose motion was as predicted

    @classmethod
    def joined_at(cls, t_s: float, fragment_id: int = -1) -> "Fragment":
        """A fragment that is joined to the flight from its first frame on."""
        return cls(t_s, fragment_id, confirmed=True, joined=True)

    def join(self) -> None:
        """A measurement has tied the fragment to the flight."""
        self.confirmed = self.joined = True

    def add_frame(self, t_s: float, evidence: "MotionEvidence | None", *, by_duration: bool = True) -> None:
        """``evidence``: of the motion of the frame at ``t_s``; None: it says nothing of the flight. ``by_duration``:
        False if images have contradicted inertial readings, which ends not because it lasts."""
        self.frames += 1
        supports = evidence is not None and evidence.supports_same_flight(self.map_llr)
        self.consistent_frames = self.consistent_frames + 1 if supports else 0
        moves_as_predicted = self.consistent_frames >= CONFIRM_FRAMES
        timed_out = by_duration and t_s - self.start_s >= CONFIRM_AFTER_S and self.frames >= CONFIRM_AFTER_FRAMES
        self.confirmed = self.confirmed or moves_as_predicted or timed_out
        if moves_as_predicted and evidence is not None and evidence.inertial:
            self.join()


class MapHitRate:
    """Share of the correlations with the map that find a pose, in confirmed fragments."""

    def __init__(self) -> None:
        self._rate = 0.0

    @property
    def p_nothing(self) -> float:
        """Probability that a correlation finds no pose over ground like that before."""
        return 1.0 - min(self._rate, MAX_HIT_RATE)

    def update(self, fragment: Fragment, *, found: bool) -> None:
        """One correlation of a frame of ``fragment``. No pose is evidence against it, the more so the higher the hit
        rate is."""
        if not found and not fragment.confirmed:
            fragment.map_llr += math.log(self.p_nothing)
        if fragment.confirmed:
            self._rate += (float(found) - self._rate) / HIT_RATE_MEMORY


class Fragments:
    """The fragment of each node in the window, and the displacement of the node in it."""

    def __init__(self) -> None:
        self._of: dict[int, tuple[Fragment, np.ndarray]] = {}

    def of(self, node: int) -> Fragment:
        return self._of[node][0]

    def displacement_m(self, node: int) -> np.ndarray:
        """(2,): from the first frame of the fragment to the node, by odometry."""
        return self._of[node][1]

    def add(self, node: int, fragment: Fragment) -> None:
        """``node``: of the newest frame of ``fragment``."""
        self._of[node] = (fragment, fragment.displacement_m)

    def retain(self, nodes: Container[int]) -> None:
        """Removes all other nodes."""
        self._of = {node: entry for node, entry in self._of.items() if node in nodes}


@dataclass(frozen=True)
class MotionEvidence:
    """Residual of one motion, as evidence that it belongs to this flight.

    ``residual_m`` (2,): horizontal motion by odometry less the predicted one, with covariance ``cov_m2`` (2, 2).
    ``dt_s``: duration of the motion. ``turns_agree``: the images turn as the reported heading does. ``inertial``: by
    inertial readings, without a break since the last frame with fused odometry. ``contradicted``: images have been
    wrong before."""

    residual_m: np.ndarray
    cov_m2: np.ndarray
    dt_s: float
    turns_agree: bool = True
    inertial: bool = False
    contradicted: bool = False

    def supports_same_flight(self, other_llr: float) -> bool:
        """Whether the evidence is sufficient, together with ``other_llr`` [nats] of other sources.

        Where velocity is so uncertain that no motion reaches CONFIRM_LLR, motion within the 50 % ellipse is sufficient:
        foreign images are rare. Not so if they have been wrong; but what other sources have said since then, they have
        said of those."""
        if self.contradicted:
            return self.turns_agree and self.llr >= CONFIRM_LLR
        return self.turns_agree and self.llr + other_llr >= min(CONFIRM_LLR, self.max_llr - 0.5 * CONSISTENT_D2)

    @property
    def llr(self) -> float:
        """Log likelihood ratio of the predicted motion against the motion of any other flight [nats]."""
        return self.max_llr - 0.5 * float(self.residual_m @ np.linalg.solve(self.cov_m2, self.residual_m))

    @property
    def max_llr(self) -> float:
        """``llr`` of a motion exactly as predicted [nats]. The density of another flight's motion is uniform over the
        disc that FOREIGN_SPEED_MPS reaches in ``dt_s``."""
        log_own = -math.log(2.0 * math.pi) - 0.5 * float(np.linalg.slogdet(self.cov_m2)[1])
        return log_own + math.log(math.pi) + 2.0 * math.log(FOREIGN_SPEED_MPS * self.dt_s)
