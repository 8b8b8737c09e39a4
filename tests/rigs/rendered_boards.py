"""Images of a calibration board through a lens, with blur and noise: the ray of each pixel meets the board."""

import math

import cv2
import numpy as np

from terrafix_lab.sim.camera.lens import Lens
from terrafix_tools.camera.board import SQUARE_PX, Board

EDGE_PX = 20  # white paper around the board
BLUR_PX, NOISE = 0.7, 3.0  # 1-sigma of the blur of a lens in focus; of the grey values of a small sensor


def poses(
    board: Board, lens: Lens, count: int, random: np.random.Generator, tilt_deg: float = 35.0
) -> list[tuple[np.ndarray, np.ndarray]]:
    """R_c_board (3, 3) and the board's middle in the camera (3,) [mm]: all over the image, of half to nine tenths of
    its width, tilted up to ``tilt_deg``."""
    beside = lens.project(np.array([[0.0, 0.0, 1.0], [0.01, 0.0, 1.0]]))
    focal_px = (beside[1, 0] - beside[0, 0]) / 0.01
    found = []
    for i in range(count):
        across, down = (i * 0.618034) % 1.0, (i * 0.754878) % 1.0  # evenly over the image
        ray = lens.rays(np.array([[(0.12 + 0.76 * across) * lens.width, (0.15 + 0.7 * down) * lens.height]]))[0]
        about_x, about_y = np.radians(random.uniform(-tilt_deg, tilt_deg, 2))
        turn = cv2.Rodrigues(np.array([about_x, about_y, math.radians(random.uniform(-20.0, 20.0))]))[0]
        away_mm = board.squares[0] * board.square_mm * focal_px / lens.width / random.uniform(0.5, 0.9)
        found.append((turn, ray * away_mm))
    return found


class Booth:
    """Renders one board through one lens."""

    def __init__(self, board: Board, lens: Lens) -> None:
        self.board, self.lens = board, lens
        y, x = np.mgrid[0 : lens.height, 0 : lens.width].astype(float)
        self._rays = lens.rays(np.column_stack([x.ravel(), y.ravel()]))
        by = SQUARE_PX / 56  # about as fine as the images, whose pixels are not sampled more than once
        small = cv2.resize(board.picture(), None, fx=1 / by, fy=1 / by, interpolation=cv2.INTER_AREA)
        self._picture, self._px_per_mm = (
            cv2.copyMakeBorder(small, *(4 * [EDGE_PX]), cv2.BORDER_CONSTANT, value=255),
            SQUARE_PX / by / board.square_mm,
        )

    def image(self, pose: tuple[np.ndarray, np.ndarray], random: np.random.Generator) -> np.ndarray:
        """(H, W) uint8."""
        (turn, middle_mm), lens = pose, self.lens
        rays = self._rays @ turn  # in axes of the board
        from_mm = -middle_mm @ turn
        far = -from_mm[2] / np.where(np.abs(rays[:, 2]) < 1e-9, 1e-9, rays[:, 2])
        on_mm = from_mm[:2] + far[:, None] * rays[:, :2] + np.array(self.board.squares) * self.board.square_mm / 2
        at_px = on_mm * self._px_per_mm - 0.5 + EDGE_PX
        at_px[far <= 0] = -1e6
        grid = at_px.astype(np.float32).reshape(lens.height, lens.width, 2)
        image = cv2.remap(self._picture, grid, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=150)
        noise = random.standard_normal(image.shape, dtype=np.float32) * NOISE
        return np.clip(cv2.GaussianBlur(40.0 + 0.7 * image.astype(np.float32), None, BLUR_PX) + noise, 0, 255).astype(
            np.uint8
        )
