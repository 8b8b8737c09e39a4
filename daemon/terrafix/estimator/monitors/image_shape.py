"""Aspect ratio of the images: a pipeline that scales the two axes differently, as 16:9 into 4:3.

Level ground looks the same from two headings, but for its size: its matches in two images, levelled by the reported
attitude, are a similarity of each other. In images with two scales they are only where neither heading nor tilt has
changed. Each possible ratio is undone and tested: the one that leaves the smallest residual is the true one."""

import math
from dataclasses import replace

import numpy as np

from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.monitors.cusum import COMPARISONS_PER_HOUR, Cusum, threshold
from terrafix.estimator.monitors.levelling import MISFIT_MEMORY
from terrafix.estimator.monitors.visual_motion import ground_residual

# Scale of the image's x axis over that of its y axis: 4:3 and 16:9, 16:9 and 3:2, each taken for the other.
ASPECT_RATIOS = (3 / 4, 27 / 32, 32 / 27, 4 / 3)  # [spec: formats of sensors and encoders]
# RMS residual of the matches of level ground, in heights, that a wrong lens, relief and tilt leave.
RESIDUAL = 0.005  # [measured: docs/decisions/059-images-against-inertial-sensors.md]
# Share of the residual that a wrong ratio may undo. [measured: no alarm in 20 flights over relief without a map]
EXPLAINED = 0.5
COMPONENTS = 2  # of a residual by two scales: one shear, along two axes [spec: geometry]


class ShapeMonitor:
    """One CUSUM per ratio."""

    def __init__(self) -> None:
        limit = threshold(COMPARISONS_PER_HOUR, len(ASPECT_RATIOS))
        self._tests = {ratio: Cusum(limit) for ratio in ASPECT_RATIOS}
        self._misfits = dict.fromkeys(ASPECT_RATIOS, 0.0)  # squared residuals: select among active ratios
        self.by_map: float | None = None  # of the newest correlation with the map (anchor/verification/image_shape.py)

    @property
    def ratio(self) -> float | None:
        """The ratio with the smallest misfit among those whose alarm is active; that by the map; None: there is
        none."""
        active = [ratio for ratio, test in self._tests.items() if test.active]
        return min(active, key=self._misfits.__getitem__, default=self.by_map)

    def add(self, pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray) -> None:
        """``pairs`` (N, 4) of a keyframe and a frame, their attitudes, and R_b_c (3x3)."""
        if None in (before.roll_rad, before.pitch_rad, now.roll_rad, now.pitch_rad):
            return
        level = replace(before, yaw_rad=0.0), replace(now, yaw_rad=0.0)  # a turn is part of the similarity
        as_described = ground_residual(pairs, *level, r_b_c)
        for ratio, test in self._tests.items():
            # Both axes are changed: the focal length of the description may be that of either.
            undone = pairs * np.tile([1.0 / math.sqrt(ratio), math.sqrt(ratio)], 2)
            residual = ground_residual(undone, *level, r_b_c)
            if as_described is None or residual is None:
                continue
            # Relief and slopes leave large residuals, of which one ratio or another undoes a part by chance: evidence
            # is what it undoes beyond EXPLAINED, relative to what remains.
            variance = max(RESIDUAL, residual) ** 2
            test.add(0.5 * COMPONENTS * (as_described**2 - (residual / (1.0 - EXPLAINED)) ** 2) / variance)
            self._misfits[ratio] = MISFIT_MEMORY * self._misfits[ratio] + residual**2
