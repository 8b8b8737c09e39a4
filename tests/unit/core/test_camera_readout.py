"""Rolling shutter: normalised coordinates are those that a point would have in the middle row's exposure."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.core.camera import CameraCalibration, Readout
from terrafix.core.geodesy import rot_w_b
from terrafix_lab.sim.camera.mount import CameraMotion
from textured_ground import DOWN, LENS, PINHOLE

READOUT_S, AGL_M = 0.05, 80.0
RATE, VELOCITY = np.array([0.4, -0.3, 0.5]), np.array([9.0, 18.0, -2.0])
R_W_C = rot_w_b(0.7, 0.1, -0.2) @ DOWN


def readout(camera: CameraCalibration) -> Readout:
    rows = camera.height - 1
    return Readout(READOUT_S / rows, rows / 2, RATE, R_W_C.T @ VELOCITY / AGL_M, -R_W_C[2])


def exposed_px(camera: CameraCalibration, ground_m: np.ndarray) -> np.ndarray:
    """Where a camera that moves shows each point: exact, by the row that is exposed when the point is in it."""
    motion, at_s = CameraMotion(VELOCITY, RATE), np.zeros(len(ground_m))
    for _ in range(8):
        p_m, r_w_c = motion.pose(np.array([0.0, 0.0, AGL_M]), R_W_C, at_s)
        px = camera.project(np.einsum("nji,nj->ni", r_w_c, ground_m - p_m))
        at_s = (px[:, 1] / (camera.height - 1) - 0.5) * READOUT_S
    return px


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "with distortion"])
def test_points_are_where_each_row_sees_them(camera: CameraCalibration) -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-40, 40, 9), np.linspace(-30, 30, 9)))
    ground_m = np.column_stack([x, y, np.zeros(len(x))])
    in_c = (ground_m - (0.0, 0.0, AGL_M)) @ R_W_C
    exact, rolling = exposed_px(camera, ground_m), replace(camera, readout=readout(camera))
    assert np.abs(camera.project(in_c) - exact).max() > 5.0
    assert np.abs(rolling.project(in_c) - exact).max() < 0.3
    assert rolling.normalise(exact) == pytest.approx(in_c[:, :2] / in_c[:, 2:], abs=0.3 / camera.fx)


def test_without_motion_nothing_changes() -> None:
    px = np.array([[10.0, 20.0], [600.0, 300.0]])
    still = replace(readout(PINHOLE), rate_radps=np.zeros(3), speed_per_s=np.zeros(3))
    assert np.array_equal(replace(PINHOLE, readout=still).normalise(px), PINHOLE.normalise(px))
