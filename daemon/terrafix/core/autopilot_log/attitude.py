"""The attitude of an autopilot by time, as its log has it.

Seconds on the clock of the log. Radians: yaw clockwise from true north, pitch up, roll right."""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view


@dataclass(frozen=True)
class AttitudeSeries:
    """Four arrays (N,). The attitude that the autopilot flies on."""

    t_s: np.ndarray
    roll_rad: np.ndarray
    pitch_rad: np.ndarray
    yaw_rad: np.ndarray


MAX_LOG_S = 86_400.0  # times further from the others are damaged [tuned]
MAX_SAMPLE_STEP_S = 10.0  # of one sample against its neighbours: beyond it its time is damaged [tuned]


def cleaned(attitude: AttitudeSeries) -> AttitudeSeries:
    """Without samples that are not finite, whose time is damaged, or that are not newer than all before them (a
    repeated packet, a clock that was set back)."""
    columns = (attitude.t_s, attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    finite = np.isfinite(np.sum(columns, axis=0))
    t_s = attitude.t_s[finite]
    if not t_s.size:
        return AttitudeSeries(*(column[finite] for column in columns))
    near = np.median(sliding_window_view(np.pad(t_s, 2, mode="edge"), 5), axis=1)
    keep = (np.abs(t_s - near) < MAX_SAMPLE_STEP_S) & (np.abs(t_s - np.median(t_s)) < MAX_LOG_S)
    before = np.maximum.accumulate(np.where(keep, t_s, -np.inf))
    keep[1:] &= t_s[1:] > before[:-1]
    return AttitudeSeries(*(column[finite][keep] for column in columns))
