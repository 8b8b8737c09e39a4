"""Intrinsics from images of a board, with the uncertainty of each, and what a set of images lacks.

OpenCV estimates (Zhang 2000; cv2.fisheye for Kannala and Brandt). Its standard deviations assume that errors of
corners are independent; those of one view are not (blur, light, a board that is not flat). So the covariance is that of
a jackknife over views, to first order: what each view alone changes (MacKinnon and White 1985, HC3 with a cluster for
each view)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.core.errors import SourceError
from terrafix.messages import Camera
from terrafix.vision.sources.fisheye import FisheyeCamera
from terrafix_tools.camera.board import Board

MIN_CORNERS = 8  # of a view: 16 numbers for its 6 of pose, and some for the lens
MIN_VIEWS = 10  # [spec: OpenCV's calibration tutorial, at least ten]
MIN_TILT_DEG = 15.0  # in both directions; a board that faces the camera leaves focal length and distance undetermined
MAX_RMS_PX = 2.0  # more is another board than stated, or images that are not sharp
MAX_FOCAL_SIGMA = 0.01  # [spec: vision/sources/description.py, CALIBRATED_FOCAL_SIGMA]
CELLS = ("upper left", "top", "upper right", "left", "middle", "right", "lower left", "bottom", "lower right")
EDGES = (1, 3, 4, 5, 7)  # cells that the circle of a fisheye reaches
PINHOLE_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class BoardView:
    """One image: its ``name``, numbers (N,) and pixels (N, 2) of the corners that were found."""

    name: str
    ids: np.ndarray
    px: np.ndarray


@dataclass(frozen=True)
class LensFit:
    """``values``, ``sigmas`` (P,) by ``names``; of each view residuals (N, 2) [px], tilt (2,) [deg, about x, y]."""

    model: str
    size: tuple[int, int]
    names: tuple[str, ...]
    values: np.ndarray
    sigmas: np.ndarray
    residuals: list[np.ndarray]
    tilts_deg: np.ndarray

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(np.square(np.vstack(self.residuals)).sum(axis=1))))

    def camera(self) -> Camera:
        kind = FisheyeCamera if self.model == "fisheye" else Camera
        fx, fy, cx, cy, *distortion = (float(v) for v in self.values)
        sigma = float(max(self.sigmas[0] / fx, self.sigmas[1] / fy))
        width, height = self.size
        return kind(
            width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion), focal_sigma=sigma
        )


def calibrate(views: Sequence[BoardView], size: tuple[int, int], board: Board, model: str) -> LensFit:
    """``size``: width, height; ``model``: "pinhole" (k1 k2 p1 p2 k3), "rational" (and k4 k5 k6) or "fisheye".

    Raises SourceError: what the set lacks, all of it in one line."""
    used = [view for view in views if len(view.ids) >= MIN_CORNERS]
    lacks = _uncovered(used, size, model)
    if len(used) < MIN_VIEWS:
        found = len(used) or "none; is it the one of --board, all of its squares counted?"
        lacks.insert(0, f"{MIN_VIEWS - len(used)} more images with the board (it was found in {found})")
    if len(used) < 4:
        raise _refused(lacks)
    try:
        fit = _fit(used, size, board, model)
    except (cv2.error, np.linalg.LinAlgError):
        raise _refused([*lacks, "boards that are tilted, at several distances (no lens fits these)"]) from None
    for axis, ways in ((0, "up and down"), (1, "left and right")):
        if np.ptp(fit.tilts_deg[:, axis]) < 2 * MIN_TILT_DEG:
            lacks.append(f"a board tilted {ways} by {MIN_TILT_DEG:.0f} degrees and more")
    if lacks:
        raise _refused(lacks)
    if fit.rms_px > MAX_RMS_PX:
        raise SourceError(
            f"calibration: corners lie {fit.rms_px:.1f} px (RMS) from where the lens would image them; is it the board "
            "that --board says, flat, with sharp images, and the right --model?"
        )
    focal_sigma = float(np.max(fit.sigmas[:2] / fit.values[:2]))
    if not focal_sigma <= MAX_FOCAL_SIGMA:
        raise SourceError(
            f"calibration: the focal length is known to {100 * focal_sigma:.1f} % only (1-sigma), 1 % is needed; take "
            "more images, with the board nearer and tilted more"
        )
    return fit


def _refused(lacks: list[str]) -> SourceError:
    return SourceError(f"calibration: the images do not determine the lens; missing: {'; '.join(lacks)}")


def _uncovered(views: Sequence[BoardView], size: tuple[int, int], model: str) -> list[str]:
    """What of the image no board has covered, in words."""
    if not views:
        return []
    cell = np.floor(3 * np.vstack([view.px for view in views]) / size).clip(0, 2).astype(int)
    seen = set(np.unique(cell[:, 1] * 3 + cell[:, 0]).tolist())
    wanted = EDGES if model == "fisheye" else range(9)
    missing = [CELLS[i] for i in wanted if i not in seen]
    return [f"the board in these parts of the image: {', '.join(missing)}"] if missing else []


def _fit(views: Sequence[BoardView], size: tuple[int, int], board: Board, model: str) -> LensFit:
    """Raises cv2.error."""
    points = [board.corners_mm[view.ids] for view in views]
    seen = [view.px for view in views]
    if model == "fisheye":
        named = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # OpenCV 5, and 4
        flags = named.CALIB_RECOMPUTE_EXTRINSIC | named.CALIB_FIX_SKEW
        _, matrix, distortion, turns, shifts = cv2.fisheye.calibrate(
            [p[None] for p in points], [p[None] for p in seen], size, np.eye(3), np.zeros((4, 1)), flags=flags
        )
        names: tuple[str, ...] = FISHEYE_NAMES
    else:
        rational = model == "rational"
        _, matrix, distortion, turns, shifts = cv2.calibrateCamera(
            [p.astype(np.float32) for p in points],
            [p.astype(np.float32) for p in seen],
            size,
            None,
            None,
            flags=cv2.CALIB_RATIONAL_MODEL if rational else 0,
        )
        names = PINHOLE_NAMES[: 12 if rational else 9]
    count = len(names) - 4
    distortion = np.asarray(distortion).reshape(-1)[:count]
    values = np.concatenate([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], distortion])
    residuals, jacobians = [], []
    for at, px, turn, shift in zip(points, seen, turns, shifts, strict=True):
        projected, by_lens, by_pose = _projected(at, np.asarray(turn), np.asarray(shift), matrix, distortion, model)
        residuals.append(px - projected)
        jacobians.append((by_lens, by_pose))
    return LensFit(model, size, names, values, _sigmas(residuals, jacobians), residuals, _tilts_deg(turns))


def _projected(
    points: np.ndarray, turn: np.ndarray, shift: np.ndarray, matrix: np.ndarray, distortion: np.ndarray, model: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> pixels (N, 2), and their derivatives (2N, P) by the lens (fx fy cx cy k...) and (2N, 6) by the pose."""
    if model == "fisheye":  # columns: f, c, k, turn, shift, skew
        px, jacobian = cv2.fisheye.projectPoints(points[:, None], turn, shift, matrix, distortion)
        return np.asarray(px).reshape(-1, 2), jacobian[:, :8], jacobian[:, 8:14]
    px, jacobian = cv2.projectPoints(points, turn, shift, matrix, distortion)  # columns: turn, shift, f, c, k
    return np.asarray(px).reshape(-1, 2), jacobian[:, 6 : 10 + len(distortion)], jacobian[:, :6]


def _sigmas(residuals: list[np.ndarray], jacobians: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """1-sigma of the parameters of the lens, from the change that leaving out each view makes to first order."""
    informations, scores = [], []
    for residual, (by_lens, by_pose) in zip(residuals, jacobians, strict=True):
        r = residual.reshape(-1)
        # the pose of a view is its own: what is left of the lens after it
        lens = by_lens - by_pose @ np.linalg.lstsq(by_pose, by_lens, rcond=None)[0]
        informations.append(lens.T @ lens)
        scores.append(lens.T @ r)
    whole, n = np.sum(informations, axis=0), len(residuals)
    scale = np.sqrt(np.diag(whole))  # pixels and coefficients differ by orders of magnitude
    changes = [
        np.linalg.solve((whole - own) / np.outer(scale, scale), score / scale) / scale
        for own, score in zip(informations, scores, strict=True)
    ]
    return np.asarray(np.sqrt((n - 1) / n * np.square(changes).sum(axis=0)))


def _tilts_deg(turns: Sequence[np.ndarray]) -> np.ndarray:
    """Tilt of the boards' normals about the camera's x and y (V, 2)."""
    normals = np.array([cv2.Rodrigues(np.asarray(turn))[0][:, 2] for turn in turns])
    normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)
    return np.degrees(np.arctan2(normals[:, [1, 0]], normals[:, 2:]))
