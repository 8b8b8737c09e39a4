"""One frame over imagery of another date: how often does the anchor find the place, and is it ever sure of a wrong one?

python -m terrafix_tools.bench.two_dates FIRST.tif SECOND.tif [--places 100] [--elsewhere 250] [--json OUT]
    [--model xfeat] [--model own.onnx]

A camera looks down on the first image, the second one is the map. All that flies takes part: package, look, belief,
pose and their gates (``AnchorNode``). It is told a place, a heading and a height that are all off, and nothing came
before. The frames of ``--elsewhere`` are of ground far from where they are said to be: what is accepted is wrong; a
coarse fix, without a pose, goes no further than the estimator, which takes it only to continue a track. With
``--model`` the same frames are seen by each of these, too: the name of a fetched model, or a file of one's own."""

import argparse
import json
import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import typer
from pyproj import Transformer

from terrafix.anchor.matching.match_message import ground_cov_m2
from terrafix.anchor.node import AnchorNode
from terrafix.core.config import load
from terrafix.core.errors import MapError, TerrafixError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import local_crs, quat_from_rot, rot_from_quat
from terrafix.map.package import MapPackage
from terrafix.messages import Camera, MapMatch, Origin, Prediction, Verdict
from terrafix_engines.features import open_describer
from terrafix_engines.runtime import ModelFileError
from terrafix_tools.mapping.build import ensure_package
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.models.pair import same_grid
from terrafix_tools.replay import map_cache_dir

SIDE_PX = 400  # of the picture, which has the pixels of the map
FIELD_OF_VIEW_DEG = 60.0
FOCAL_PX = SIDE_PX / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG / 2))
SHIFT_PX, TURN_DEG, SCALE = 150.0, 5.0, 0.05  # what is not known, to either side, evenly spread
EVEN = 1 / math.sqrt(3.0)  # 1-sigma of such a spread
TILT_SIGMA_DEG = 1.0
ELSEWHERE_PX = 500.0  # from the right place: beyond three and a half sigmas of what is told
RIM = 0.55  # of a picture's side: it lies on the images in any case
EMPTY_SHARE = 0.02  # of its pixels without imagery, at most, and of those of the map under it
NEAR_PX, FAR_PX = 5.0, 20.0
INSIDE_95 = 5.991  # chi-square, two degrees of freedom
SEED = 5


@dataclass(frozen=True)
class Answer:
    """``error_px`` of the ground in the picture's middle: by the pose, or by the place that is believed most. ``sure``:
    accepted, with a pose. ``inside``: the 95 % ellipse that it claims, the map's own error counted in."""

    error_px: float
    verdict: str
    sure: bool
    inside: bool
    cpu_ms: float


class Places:
    """Pictures of known places, and what the anchor is told of them."""

    def __init__(self, first: Path, second: Path) -> None:
        """Raises MapError."""
        self._camera, self._map = same_grid(first, second)
        height, width = self._camera.shape[:2]
        with ImagerySource(second) as source:
            self._crs_from_px, crs = source.transform, source.crs
        x, y = self._crs_from_px @ (width / 2, height / 2)
        self._lon_deg, self._lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform(x, y)
        self._to_local = Transformer.from_crs(crs, local_crs(self._lat_deg, self._lon_deg), always_xy=True)
        self._rng = np.random.default_rng(SEED)

    def draw(self, elsewhere: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A picture, the pixel of the map in its middle, and the pixel where the anchor is told to look."""
        height, width = self._camera.shape[:2]
        low, high = np.full(2, RIM * SIDE_PX), np.array([width, height]) - RIM * SIDE_PX
        for _ in range(100_000):
            true_px, shift_px = self._rng.uniform(low, high), self._rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
            told_px = self._rng.uniform(low, high) if elsewhere else true_px + shift_px
            if elsewhere and float(np.hypot(*(told_px - true_px))) < ELSEWHERE_PX:
                continue
            turn_deg, scale = self._rng.uniform(-TURN_DEG, TURN_DEG), 1.0 + self._rng.uniform(-SCALE, SCALE)
            matrix = cv2.getRotationMatrix2D((0.0, 0.0), turn_deg, scale)
            matrix[:, 2] = (SIDE_PX - 1) / 2 - matrix[:, :2] @ true_px
            picture = cv2.warpAffine(self._camera, matrix, (SIDE_PX, SIDE_PX), flags=cv2.INTER_AREA)
            on_map = self._on_map(told_px if elsewhere else true_px)
            if max(_empty(picture), _empty(on_map)) <= EMPTY_SHARE:
                return picture, true_px, told_px
        raise MapError("the two images have too little ground in common; choose larger ones")

    def _on_map(self, px: np.ndarray) -> np.ndarray:
        """As much of the map around a pixel as a picture shows: what is not on the map cannot be found there, and where
        nothing is on it nothing wrong can be found."""
        column, row = (round(float(v)) - SIDE_PX // 2 for v in px)
        return self._map[row : row + SIDE_PX, column : column + SIDE_PX]

    def local_m(self, px: np.ndarray) -> np.ndarray:
        """(2,) east, north of a pixel of the map; whole numbers are the middles."""
        return np.array(self._to_local.transform(*(self._crs_from_px @ (px[0] + 0.5, px[1] + 0.5))))

    def pixel_m(self, px: np.ndarray) -> np.ndarray:
        """(2,) the way to the next pixel on the right."""
        return self.local_m(px + np.array([1.0, 0.0])) - self.local_m(px)

    def told(self, px: np.ndarray) -> tuple[Origin, Prediction]:
        """A camera above a pixel, the upper edge of its picture along the rows of the map."""
        right_m = self.pixel_m(px)
        gsd_m = float(np.hypot(*right_m))
        x, z = np.array([*(right_m / gsd_m), 0.0]), np.array([0.0, 0.0, -1.0])
        e_m, n_m = (float(v) for v in self.local_m(px))
        agl_m, middle = FOCAL_PX * gsd_m, (SIDE_PX - 1) / 2
        sigma_m, agl_sigma_m, yaw_sigma_deg = SHIFT_PX * EVEN * gsd_m, SCALE * EVEN * agl_m, TURN_DEG * EVEN
        tilt_rad, yaw_rad = math.radians(TILT_SIGMA_DEG), math.radians(yaw_sigma_deg)
        cov = np.diag([sigma_m, sigma_m, agl_sigma_m, tilt_rad, tilt_rad, yaw_rad]) ** 2
        origin = Origin(
            t_ns=0,
            camera=Camera(width=SIDE_PX, height=SIDE_PX, fx=FOCAL_PX, fy=FOCAL_PX, cx=middle, cy=middle),
            lat_deg=self._lat_deg,
            lon_deg=self._lon_deg,
            ground_amsl_m=0.0,
            start_sigma_m=0.0,  # the prediction says how well the place is known
            yaw_sigma_deg=yaw_sigma_deg,
            agl_sigma_m=agl_sigma_m,
            attitude_sigma_deg=TILT_SIGMA_DEG,
        )
        prediction = Prediction(
            t_ns=0,
            frame_id=0,
            p_c_in_w_m=(e_m, n_m, agl_m),
            q_w_c=quat_from_rot(np.column_stack([x, np.cross(z, x), z])),
            cov=tuple(float(v) for v in cov.ravel()),
            agl_m=agl_m,
            agl_sigma_m=agl_sigma_m,
            step_m=(0.0, 0.0),
            step_cov_m2=(0.0, 0.0, 0.0, 0.0),
        )
        return origin, prediction


def _empty(picture: np.ndarray) -> float:
    """Share of its pixels without imagery."""
    return float(np.mean(picture.max(axis=2) == 0))


def measure(
    first: Path, second: Path, places: int, elsewhere: int, model: str = ""
) -> tuple[list[Answer], list[Answer]]:
    """Answers to frames of about the place that was told, and to frames from elsewhere. ``model``: as [models] xfeat
    has it; empty: without weights. Raises MapError, ModelFileError."""
    drawn, frames = Places(first, second), MemoryFrameStore(1)
    describer = open_describer(model)
    package = MapPackage.open(ensure_package(second, map_cache_dir()))
    ce90_m = load([]).map.ce90_m

    def answer(from_elsewhere: bool) -> Answer:
        picture, true_px, told_px = drawn.draw(from_elsewhere)
        origin, prediction = drawn.told(told_px)
        frames.put(prediction.frame_id, picture)
        anchor = AnchorNode(frames, package, describer, ce90_m)
        list(anchor.on(origin))
        began_s = time.process_time()
        match = next(m for m in anchor.on(prediction) if isinstance(m, MapMatch))
        cpu_ms = (time.process_time() - began_s) * 1e3
        place_m, cov_m2 = middle_of(match)
        off_m = place_m - drawn.local_m(true_px)
        return Answer(
            error_px=float(np.hypot(*off_m)) / float(np.hypot(*drawn.pixel_m(true_px))),
            verdict=match.verdict.value,
            sure=match.verdict is Verdict.ACCEPTED and not match.coarse,  # a coarse fix finds no place, it keeps one
            inside=float(off_m @ np.linalg.solve(cov_m2, off_m)) <= INSIDE_95,
            cpu_ms=cpu_ms,
        )

    return [answer(False) for _ in range(places)], [answer(True) for _ in range(elsewhere)]


def middle_of(match: MapMatch) -> tuple[np.ndarray, np.ndarray]:
    """(2,) east, north of the ground at height zero in the middle of a picture taken from straight above, and its
    covariance (2, 2). Without a pose the most believed place, and the covariance of the belief."""
    map_m2 = match.map_sigma_m**2 * np.eye(2)
    if match.coarse or match.p_c_in_w_m is None or match.q_w_c is None or match.cov is None:
        believed = np.array([match.mode_e_m, match.mode_n_m]), np.reshape(match.belief_cov_m2, (2, 2))
        return believed[0], believed[1] + map_m2 + 1e-6 * np.eye(2)
    p, axis = np.array(match.p_c_in_w_m), rot_from_quat(match.q_w_c)[:, 2]
    return (p - axis * (p[2] / axis[2]))[:2], ground_cov_m2(match.cov, p[2]) + map_m2


def row(name: str, places: list[Answer], elsewhere: list[Answer]) -> str:
    sure = [a for a in places if a.sure]
    wrong = [a for a in elsewhere if a.verdict == Verdict.ACCEPTED.value and a.error_px > FAR_PX]
    coarse = sum(not a.sure for a in wrong)
    near, far = (100 * np.mean([a.error_px <= limit for a in places]) for limit in (NEAR_PX, FAR_PX))
    inside = f"{100 * np.mean([a.inside for a in sure]):.0f} %" if sure else "-"
    cpu_ms = np.median([a.cpu_ms for a in places])
    return (
        f"{name:40} {len(places):6} {near:6.0f} % {far:6.0f} % {len(sure):6} {sum(a.error_px > FAR_PX for a in sure):6}"
        f" {inside:>7} {len(elsewhere):10} {len(wrong) - coarse:6} {coarse:7} {cpu_ms:7.0f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("first", type=Path, metavar="FIRST", help="what the camera sees")
    parser.add_argument("second", type=Path, metavar="SECOND", help="the map, in the same coordinate system")
    parser.add_argument("--places", type=int, default=100)
    parser.add_argument("--elsewhere", type=int, default=250)
    parser.add_argument("--json", type=Path, help="writes every answer")
    parser.add_argument("--model", action="append", default=[], metavar="NAME or FILE", help="beside none; repeatable")
    given = parser.parse_args()
    typer.echo(
        f"{'camera on map':40} places {f'<= {NEAR_PX:g}px':>8} {f'<= {FAR_PX:g}px':>8}   sure  wrong  inside  elsewhere"
        "  wrong  coarse      CPU"
    )
    written = {}
    for model in ["", *given.model]:
        try:
            answers = measure(given.first, given.second, given.places, given.elsewhere, model)
        except (TerrafixError, ModelFileError) as error:
            sys.exit(f"{error}")
        by = Path(model).stem if model else "no weights"
        typer.echo(row(f"{given.first.stem} on {given.second.stem}, {by}", *answers))
        kinds = zip(("places", "elsewhere"), answers, strict=True)
        written[by] = {name: [asdict(a) for a in one] for name, one in kinds}
    if given.json is not None:
        given.json.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
