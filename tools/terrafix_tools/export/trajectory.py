"""Trajectories of the camera in the formats of benchmarks: TUM and KITTI.

World: east and north [m] of the origin of the flight, height above mean sea level. Camera: right, down, along the
view."""

from pathlib import Path

import numpy as np

from terrafix.core.geodesy import quat_from_rot
from terrafix_tools.export.track import Track


def write_tum(track: Track, out: Path, _photos: Path | None) -> None:
    """One line a pose: t tx ty tz qx qy qz qw. t: UNIX time [s] where the record has the wall clock, else seconds from
    the zero of the flight."""
    lines = []
    for pose in track.oriented():
        assert pose.r_w_c is not None
        w, x, y, z = quat_from_rot(pose.r_w_c)
        t_s = pose.row.t_s if pose.unix_s is None else pose.unix_s
        position = " ".join(f"{value:.4f}" for value in track.position_m(pose))
        lines.append(f"{t_s:.3f} {position} {x:.8f} {y:.8f} {z:.8f} {w:.8f}\n")
    out.write_text("".join(lines), encoding="ascii")


def write_kitti(track: Track, out: Path, _photos: Path | None) -> None:
    """One line a pose: the rows of its 3x4 matrix. There are no times: a line for each frame that has a pose."""
    lines = []
    for pose in track.oriented():
        assert pose.r_w_c is not None
        matrix = np.column_stack([pose.r_w_c, track.position_m(pose)])
        lines.append(" ".join(f"{value:.8f}" for value in matrix.ravel()) + "\n")
    out.write_text("".join(lines), encoding="ascii")
