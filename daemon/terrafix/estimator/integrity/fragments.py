"""Which frames odometry connects, and whether the flight is one of them.

Frames that odometry registers to each other are a fragment (as a map of ORB-SLAM3's atlas, Campos et al. 2021). After
tracking was lost the next fragment may show another flight: pictures of another camera, a buffer of yesterday. They
agree with each other as true ones do. So odometry of a new fragment is not fused until something outside of it says
that it is this flight: a camera pose on the map, or motion that velocity and inertial readings predict."""

import math
from collections.abc import Container
from dataclasses import dataclass, field

import numpy as np

FOREIGN_SPEED_MPS = 30.0  # a picture sequence of another flight moves by up to this, in any direction
JOIN_LLR = 3.0  # nats of one frame: by chance one foreign motion in twenty is as near to the prediction
AGREES_D2 = 1.39  # chi-square, 2 degrees of freedom, 50 %
LOOKS_REMEMBERED = 10.0  # over so many looks the share of those that find a pose is learnt
MOST_SHARE = 0.9  # that is believed of this share: the ground changes
JOIN_FRAMES = 2  # frames that say so
# A fragment that lasts so long is taken for the flight's own in the end, with the position as wide as dead reckoning
# has made it: over ground that no map knows nothing else would ever join it.
LASTING_S, LASTING_FRAMES = 30.0, 20


@dataclass
class Fragment:
    """``joined``: its odometry is fused. ``began_m`` (2,), ``began_cov_m2`` (2, 2): where dead reckoning had its first
    frame. ``moved_m`` (2,): from there to its newest frame, by odometry."""

    began_s: float
    began_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    began_cov_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    moved_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    joined: bool = False
    map_llr: float = 0.0  # nats, "of this flight against any other", of looks at the map that found nothing
    frames: int = 1
    agreeing: int = 0  # frames in a row whose motion was as predicted

    def weigh(self, t_s: float, evidence: "MotionEvidence") -> None:
        """``evidence``: of the frame at ``t_s``, by its motion."""
        self.frames += 1
        self.agreeing = self.agreeing + 1 if evidence.speaks_for_own(self.map_llr) else 0
        lasting = t_s - self.began_s >= LASTING_S and self.frames >= LASTING_FRAMES
        self.joined = self.joined or self.agreeing >= JOIN_FRAMES or lasting


class MapHits:
    """The share of looks at the map that find a pose, where the flight goes."""

    def __init__(self) -> None:
        self._share = 0.0

    def looked(self, fragment: Fragment, *, found: bool) -> None:
        """A look at a frame of ``fragment``. A pose joins it; none where poses are usual speaks against it."""
        if found:
            fragment.joined = True
        elif not fragment.joined:
            fragment.map_llr += math.log(1.0 - min(self._share, MOST_SHARE))
        if fragment.joined:
            self._share += (float(found) - self._share) / LOOKS_REMEMBERED


class Fragments:
    """The fragment of each node in the estimator's window, and where in it the node is."""

    def __init__(self) -> None:
        self._of: dict[int, tuple[Fragment, np.ndarray]] = {}

    def of(self, node: int) -> Fragment:
        return self._of[node][0]

    def at_m(self, node: int) -> np.ndarray:
        """(2,): from the first frame of the fragment, by odometry."""
        return self._of[node][1]

    def add(self, node: int, fragment: Fragment) -> None:
        """The newest frame of the fragment."""
        self._of[node] = (fragment, fragment.moved_m)

    def keep(self, held: Container[int]) -> None:
        """Forgets all other nodes."""
        self._of = {node: entry for node, entry in self._of.items() if node in held}


@dataclass(frozen=True)
class MotionEvidence:
    """``off_m`` (2,): a level motion less the predicted one, the difference known to ``cov_m2`` (2, 2). ``over_s``: how
    long the motion took. ``turns_agree``: the pictures turn as the reported heading does."""

    off_m: np.ndarray
    cov_m2: np.ndarray
    over_s: float
    turns_agree: bool = True

    def speaks_for_own(self, other_llr: float) -> bool:
        """Whether it says that this is our flight, beside ``other_llr`` from other sources. Where velocity is so little
        known that no motion could say it, all that agree do: foreign pictures are rare."""
        needed = min(JOIN_LLR, self.most_llr - 0.5 * AGREES_D2)
        return self.turns_agree and self.llr + other_llr >= needed

    @property
    def llr(self) -> float:
        """Log likelihood ratio, "predicted by velocity against that of any other flight" [nats]."""
        return self.most_llr - 0.5 * float(self.off_m @ np.linalg.solve(self.cov_m2, self.off_m))

    @property
    def most_llr(self) -> float:
        """Of a motion that is exactly as predicted. Another flight's is spread evenly over what FOREIGN_SPEED_MPS
        reaches."""
        log_own = -math.log(2.0 * math.pi) - 0.5 * float(np.linalg.slogdet(self.cov_m2)[1])
        return log_own + math.log(math.pi) + 2.0 * math.log(FOREIGN_SPEED_MPS * self.over_s)
