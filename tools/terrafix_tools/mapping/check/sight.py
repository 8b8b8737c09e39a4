"""Where frames are placed alone: pieces of the map, disturbed, are localized by the code that flies.

A frame is drawn from the map at a random heading, with noise for what has changed, and localized with no frame before
it: from a start, a heading and a height that are wrong by what their 1-sigmas allow. On water and bare fields the noise
dominates; rows and periodic textures fit in many places.

Noise is of two levels: ground as on the map, and another season or years later. What a single image cannot show (new
houses, a harvest, snow) differs from place to place; how far the shares hold: docs/map-package.md."""

import math
from dataclasses import dataclass
from enum import IntEnum
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from terrafix.anchor.localizer import Localizer
from terrafix.anchor.matching.frame_matcher import FrameMatcher
from terrafix.anchor.matching.map_layers import MapLayers
from terrafix.core.camera import CameraCalibration
from terrafix.core.config import Map
from terrafix.core.geodesy import local_rotation_up, quat_from_rot
from terrafix.core.node import Image
from terrafix.map.format import Layer
from terrafix.map.package import LocalMap
from terrafix.messages import Camera, Origin, Prediction, Verdict
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.progress import Bar

START_SIGMA_M = 50.0  # of the position from which a frame is placed alone
YAW_SIGMA_RAD = math.radians(4.0)  # of a compass
HEIGHT_SIGMA = 0.02  # relative
TILT_SIGMA_RAD = math.radians(1.0)
NORTH_UP = np.diag([1.0, -1.0, -1.0])  # camera to world, looking straight down
# Standard deviations of the noise, grey levels; its correlation length is a cell of the matcher. Ground as on the map:
# bare fields ten minutes later. Changed: at 40 as many frames of five pairs of dates are placed as were in fact.
# [measured: docs/map-package.md]
AS_ON_THE_MAP, CHANGED = 16.0, 40.0
RIGHT = 0.1  # heights: largest error of a place that is right
MAX_FRAME_PX = 640  # longer side of a frame; the matcher's cells are larger than its pixels


class Sight(IntEnum):
    NO_MAP = 0  # the frame is not completely on the map
    BLIND = 1  # not placed
    WEAK = 2  # placed while the ground looks as on the map
    SEES = 3  # placed when it has changed


@dataclass(frozen=True)
class SightGrid:
    """Sight in square cells; row 0 is the northern one."""

    e_min_m: float
    n_max_m: float
    step_m: float
    sight: np.ndarray  # (rows, columns) uint8 of Sight

    def share(self, what: Sight) -> float:
        """Fraction of the cells with map; 0 when there are none."""
        known = int((self.sight != Sight.NO_MAP).sum())
        return float((self.sight == what).sum()) / known if known else 0.0


class _OneLayer:
    """A layer as a package of its own and as its bound map, over flat ground: frames are drawn without relief."""

    def __init__(self, local: LocalMap, layer: Layer) -> None:
        self.manifest = SimpleNamespace(layers=(layer,))
        self._local = local

    def bind(self, *_: object) -> "_OneLayer":
        return self

    def elevation(self, *_: object) -> None:
        return None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._local, name)


class MatchabilityProbe:
    """Localizes single frames. ``lens``: taken for a pinhole; ``agl_m``: height above ground; ``start_sigma_m``: of the
    position from which a frame is placed."""

    def __init__(
        self, local: LocalMap, layer: Layer, lens: CameraCalibration, agl_m: float, start_sigma_m: float = START_SIGMA_M
    ) -> None:
        self._local, self._agl_m, self._start_sigma_m = local, agl_m, start_sigma_m
        seen = self._camera = lens.scaled(min(MAX_FRAME_PX / max(lens.width, lens.height), 1.0))
        cell_m = FrameMatcher(seen, local, GradientDescriber()).correlation_cell_m(agl_m)
        self._noise_sigma_px = cell_m * seen.fx / agl_m
        package: Any = _OneLayer(local, layer)
        self._localizer = Localizer(GradientDescriber(), lambda a, b, c: MapLayers(package, a, b, c, Map().ce90_m))
        self._localizer.begin_flight(
            Origin(
                t_ns=0,
                camera=Camera(width=seen.width, height=seen.height, fx=seen.fx, fy=seen.fy, cx=seen.cx, cy=seen.cy),
                lat_deg=0.0,
                lon_deg=0.0,
                ground_amsl_m=0.0,
                start_sigma_m=start_sigma_m,
                yaw_sigma_deg=math.degrees(YAW_SIGMA_RAD),
                agl_sigma_m=HEIGHT_SIGMA * agl_m,
                attitude_sigma_deg=math.degrees(TILT_SIGMA_RAD),
            )
        )

    def at(self, e_m: float, n_m: float) -> Sight:
        """Sight of a frame with its centre at the position."""
        rng = np.random.default_rng((round(e_m) & 0xFFFFFFFF, round(n_m) & 0xFFFFFFFF))
        yaw_rad = rng.uniform(-math.pi, math.pi)
        frame = self._frame(e_m, n_m, yaw_rad, self._agl_m * (1.0 + rng.normal(0.0, HEIGHT_SIGMA)))
        if frame is None:
            return Sight.NO_MAP
        prediction = self.prediction((e_m, n_m), yaw_rad, rng)
        noise = cv2.GaussianBlur(rng.normal(size=frame.shape[:2]).astype(np.float32), (0, 0), self._noise_sigma_px)
        noise = noise / noise.std()
        for sight, grey in ((Sight.SEES, CHANGED), (Sight.WEAK, AS_ON_THE_MAP)):
            changed = np.clip(frame + grey * noise[:, :, None], 0, 255).astype(np.uint8)
            if self.is_placed(changed, prediction, (e_m, n_m)):
                return sight
        return Sight.BLIND

    def is_placed(self, frame: Image, prediction: Prediction, place_m: tuple[float, float]) -> bool:
        """Whether a frame, of ``lens`` at no more than MAX_FRAME_PX, has a match at its place (east, north)."""
        self._localizer.reset()
        self._localizer.predict(prediction)
        match = self._localizer.localize(prediction, frame)
        if match.verdict is not Verdict.ACCEPTED or match.place is None:
            return False
        return math.dist((match.place.e_m, match.place.n_m), place_m) <= RIGHT * self._agl_m

    def prediction(self, place_m: tuple[float, float], yaw_rad: float, rng: np.random.Generator) -> Prediction:
        """Of a frame at the place with a heading (counter-clockwise), with errors of start and compass."""
        at_m = place_m + rng.normal(0.0, self._start_sigma_m, 2)
        r_w_c = local_rotation_up(yaw_rad + rng.normal(0.0, YAW_SIGMA_RAD)) @ NORTH_UP
        agl_sigma_m = HEIGHT_SIGMA * self._agl_m
        sigmas = [self._start_sigma_m, self._start_sigma_m, agl_sigma_m, TILT_SIGMA_RAD, TILT_SIGMA_RAD, YAW_SIGMA_RAD]
        return Prediction(
            t_ns=0,
            frame_id=0,
            p_c_in_w_m=(float(at_m[0]), float(at_m[1]), self._agl_m),
            q_w_c=quat_from_rot(r_w_c),
            cov=tuple(float(v) for v in np.diag(np.square(sigmas)).ravel()),
            agl_m=self._agl_m,
            agl_sigma_m=agl_sigma_m,
            step_m=(0.0, 0.0),
            step_cov_m2=(0.0, 0.0, 0.0, 0.0),
        )

    def _frame(self, e_m: float, n_m: float, yaw_rad: float, agl_m: float) -> np.ndarray | None:
        """What a camera over the position sees (h, w, 3) float32, ``yaw_rad`` counter-clockwise; None: not all of it is
        on the map."""
        camera = self._camera
        gsd_m = agl_m / camera.fx
        side = 2 * math.ceil(math.hypot(camera.width, camera.height) / 2) + 4
        half_m = side / 2 * gsd_m
        image, valid = self._local.window(e_m - half_m, n_m + half_m, side, side, gsd_m)
        right_down = (local_rotation_up(yaw_rad) @ NORTH_UP)[:2, :2] * (1.0, camera.fx / camera.fy)
        matrix = np.empty((2, 3))
        matrix[:, :2] = right_down * ((1.0,), (-1.0,))  # pixels of the window: rows count southwards
        matrix[:, 2] = (side - 1) / 2 - matrix[:, :2] @ (camera.cx, camera.cy)
        size = camera.width, camera.height
        if not cv2.warpAffine(
            valid.astype(np.uint8), matrix, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        ).all():
            return None
        frame = cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return np.asarray(frame, np.float32)


def sight_grid(local: LocalMap, probe: MatchabilityProbe, step_m: float, bar: Bar) -> SightGrid:
    """Sight over the whole map in cells of ``step_m``."""
    e_min, n_min, e_max, n_max = local.bounds_m
    rows, columns = max(1, int(np.ceil((n_max - n_min) / step_m))), max(1, int(np.ceil((e_max - e_min) / step_m)))
    sight = np.zeros((rows, columns), np.uint8)
    step = bar("sight", rows)
    for row in range(rows):
        step()
        for column in range(columns):
            sight[row, column] = probe.at(e_min + (column + 0.5) * step_m, n_max - (row + 0.5) * step_m)
    return SightGrid(e_min, n_max, step_m, sight)
