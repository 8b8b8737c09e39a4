"""What stands against past positions: the parts of their claims that the graph does not know, for the refinement.

A part that depends on the frame alone (the time offset along its velocity, the alternative position) stays with it:
what comes later does not tell which of two positions it had. A doubt of the whole position (search, other ground,
wrong description) is a statement of all frames since a map match without such a doubt confirmed the graph. So frames
before the match are free of it, and those after it have the newest one, which has grown with the time since: a
description that is wrong by a heading or a scale moves the position in proportion. Without such a match it holds as it
is. Another graph (reset) neither confirms nor refutes the one before."""

import math
from array import array
from dataclasses import dataclass, field

import numpy as np

from terrafix.estimator.filter_state import FrameState

MIN_DOUBT_M2 = 1.0  # m^2: trace of a covariance below which it is no doubt [spec: the resolution of a claim]


@dataclass
class _Run:
    """Frames of one graph since its last confirmation at ``confirmed_s``; -inf: there was none."""

    first_node: int
    confirmed_s: float = -math.inf
    doubt_m2: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))  # of the newest frame
    frames: "array[int]" = field(default_factory=lambda: array("q"))
    times_s: "array[float]" = field(default_factory=lambda: array("d"))

    def confirm(self, fix_s: float) -> None:
        """A map match of the frame at ``fix_s`` confirms the frames up to it."""
        self.confirmed_s = fix_s
        after = next((i for i, t_s in enumerate(self.times_s) if t_s > fix_s), len(self.times_s))
        del self.frames[:after], self.times_s[:after]

    def doubts_m2(self) -> dict[int, np.ndarray]:
        """(2, 2) of each frame that is doubted."""
        if float(np.trace(self.doubt_m2)) < MIN_DOUBT_M2:
            return {}
        newest_s = self.times_s[-1]
        if math.isinf(self.confirmed_s):
            return dict.fromkeys(self.frames, self.doubt_m2)
        pairs = zip(self.frames, self.times_s, strict=True)
        whole_s = newest_s - self.confirmed_s
        return {frame: ((t_s - self.confirmed_s) / whole_s) ** 2 * self.doubt_m2 for frame, t_s in pairs}


class Doubts:
    """``record`` every claim, in order of time; ``of_frames`` after landing."""

    def __init__(self) -> None:
        self._own: dict[int, np.ndarray] = {}  # frame -> (2, 2) that stays with it
        self._past: dict[int, np.ndarray] = {}  # of graphs that have ended
        self._run: _Run | None = None

    @property
    def sigma_m(self) -> float:
        """1-sigma per axis of the newest doubt of the whole position; 0: there is none."""
        trace_m2 = 0.0 if self._run is None else float(np.trace(self._run.doubt_m2))
        return math.sqrt(0.5 * trace_m2) if trace_m2 >= MIN_DOUBT_M2 else 0.0

    def record(
        self, frame: FrameState, first_node: int, fix_s: float | None, own_m2: np.ndarray, doubt_m2: np.ndarray
    ) -> None:
        """Of the newest claim of the newest frame, in the graph that began with ``first_node``: ``own_m2`` (2, 2),
        which stays with it, ``doubt_m2`` (2, 2), of the whole position. ``fix_s``: time of the newest frame with an
        accepted map match; None: there is none."""
        frame_id = frame.frame_id
        if self._run is None or self._run.first_node != first_node:
            if self._run is not None:
                self._past |= {at: m2 for at, m2 in self._run.doubts_m2().items() if at != frame_id}
            self._run = _Run(first_node)
        if not self._run.frames or self._run.frames[-1] != frame_id:
            self._run.frames.append(frame_id)
            self._run.times_s.append(frame.t_s)
        if float(np.trace(own_m2)) >= MIN_DOUBT_M2:
            self._own[frame_id] = own_m2
        else:
            self._own.pop(frame_id, None)
        self._run.doubt_m2 = doubt_m2
        if fix_s is not None and float(np.trace(doubt_m2)) < MIN_DOUBT_M2:
            self._run.confirm(fix_s)

    def of_frames(self) -> dict[int, np.ndarray]:
        """(2, 2) to be added to the refined covariance of each frame."""
        added = dict(self._own)
        for frame, doubt_m2 in (self._past | (self._run.doubts_m2() if self._run else {})).items():
            added[frame] = added.get(frame, np.zeros((2, 2))) + doubt_m2
        return added
