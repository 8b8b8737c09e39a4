"""Single-frame matches on imagery of another date: recall, accuracy and false acceptances of the anchor.

python -m terrafix_tools.bench.two_dates FIRST.tif SECOND.tif [--places 100] [--elsewhere 250] [--json OUT]
    [--model xfeat] [--model own.onnx]

A camera looks straight down on the first image; the second one is the map. The whole anchor takes part: package,
correlation, belief, pose and gates (``AnchorNode``), without earlier frames. Its prediction has errors of position,
heading and height. The frames of ``--elsewhere`` show ground far from the predicted position: each acceptance is false.
A coarse match has no pose, and the estimator uses it only to continue a track. With ``--model`` the same frames are
also matched with each of these models: the name of a fetched model, or a file."""

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
from terrafix.core.gate import CHI2_95
from terrafix.core.geodesy import local_crs, quat_from_rot, rot_from_quat
from terrafix.core.pnp import solved
from terrafix.map.package import MapPackage
from terrafix.messages import Camera, MapMatch, Origin, Prediction, Verdict
from terrafix_engines.features import open_describer
from terrafix_engines.runtime import ModelFileError
from terrafix_tools.flight_map import map_cache_dir
from terrafix_tools.mapping.build import ensure_package
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.models.pair import same_grid

SIDE_PX = 400  # of the frame, whose pixels are as large as those of the map
FIELD_OF_VIEW_DEG = 60.0
FOCAL_PX = SIDE_PX / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG / 2))
SHIFT_PX, TURN_DEG, SCALE = 150.0, 5.0, 0.05  # largest errors of the prediction, uniformly distributed
UNIFORM_SIGMA = 1 / math.sqrt(3.0)  # 1-sigma of a uniform distribution on [-1, 1]
TILT_SIGMA_DEG = 1.0
ELSEWHERE_PX = 500.0  # least distance of the true from the predicted position: over 3.5 sigmas of the prediction
RIM = 0.55  # least distance of a frame's centre from the border, in frame sides: it is always inside the images
EMPTY_SHARE = 0.02  # largest share of pixels without imagery, in the frame and in the map below it
NEAR_PX, FAR_PX = 5.0, 20.0
SEED = 5


@dataclass(frozen=True)
class Answer:
    """Result of one frame. ``error_px``: error of the ground point in the image centre, by the pose, or else by the
    mode of the belief. ``sure``: accepted with a pose. ``inside``: the truth is in the claimed 95 % ellipse, which
    includes the map error."""

    error_px: float
    verdict: str
    sure: bool
    inside: bool
    cpu_ms: float


class Places:
    """Random frames with known positions, and the predictions for them."""

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
        """-> a frame, the map pixel at its centre, and the map pixel of the predicted position."""
        height, width = self._camera.shape[:2]
        low, high = np.full(2, RIM * SIDE_PX), np.array([width, height]) - RIM * SIDE_PX
        for _ in range(100_000):
            true_px, shift_px = self._rng.uniform(low, high), self._rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
            predicted_px = self._rng.uniform(low, high) if elsewhere else true_px + shift_px
            if elsewhere and float(np.hypot(*(predicted_px - true_px))) < ELSEWHERE_PX:
                continue
            turn_deg, scale = self._rng.uniform(-TURN_DEG, TURN_DEG), 1.0 + self._rng.uniform(-SCALE, SCALE)
            matrix = cv2.getRotationMatrix2D((0.0, 0.0), turn_deg, scale)
            matrix[:, 2] = (SIDE_PX - 1) / 2 - matrix[:, :2] @ true_px
            frame = cv2.warpAffine(self._camera, matrix, (SIDE_PX, SIDE_PX), flags=cv2.INTER_AREA)
            on_map = self._on_map(predicted_px if elsewhere else true_px)
            if max(_empty(frame), _empty(on_map)) <= EMPTY_SHARE:
                return frame, true_px, predicted_px
        raise MapError("the two images have too little ground in common; choose larger ones")

    def _on_map(self, px: np.ndarray) -> np.ndarray:
        """-> the part of the map that a frame around a pixel shows. Without imagery there the position can neither be
        found nor be confused."""
        column, row = (round(float(v)) - SIDE_PX // 2 for v in px)
        return self._map[row : row + SIDE_PX, column : column + SIDE_PX]

    def local_m(self, px: np.ndarray) -> np.ndarray:
        """-> (2,) east, north [m] of a pixel of the map; integers are pixel centres."""
        return np.array(self._to_local.transform(*(self._crs_from_px @ (px[0] + 0.5, px[1] + 0.5))))

    def pixel_m(self, px: np.ndarray) -> np.ndarray:
        """-> (2,) east, north [m] from a pixel to its right neighbour."""
        return self.local_m(px + np.array([1.0, 0.0])) - self.local_m(px)

    def prior(self, px: np.ndarray) -> tuple[Origin, Prediction]:
        """-> Origin and Prediction of a camera above a pixel; the rows of its image are parallel to those of the
        map."""
        right_m = self.pixel_m(px)
        gsd_m = float(np.hypot(*right_m))
        x, z = np.array([*(right_m / gsd_m), 0.0]), np.array([0.0, 0.0, -1.0])
        e_m, n_m = (float(v) for v in self.local_m(px))
        agl_m, centre_px = FOCAL_PX * gsd_m, (SIDE_PX - 1) / 2
        sigma_m, agl_sigma_m, yaw_sigma_deg = (
            SHIFT_PX * UNIFORM_SIGMA * gsd_m,
            SCALE * UNIFORM_SIGMA * agl_m,
            TURN_DEG * UNIFORM_SIGMA,
        )
        tilt_rad, yaw_rad = math.radians(TILT_SIGMA_DEG), math.radians(yaw_sigma_deg)
        cov = np.diag([sigma_m, sigma_m, agl_sigma_m, tilt_rad, tilt_rad, yaw_rad]) ** 2
        origin = Origin(
            t_ns=0,
            camera=Camera(width=SIDE_PX, height=SIDE_PX, fx=FOCAL_PX, fy=FOCAL_PX, cx=centre_px, cy=centre_px),
            lat_deg=self._lat_deg,
            lon_deg=self._lon_deg,
            ground_amsl_m=0.0,
            start_sigma_m=0.0,  # unused: the prediction has its own covariance
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


def _empty(frame: np.ndarray) -> float:
    """-> share of pixels without imagery."""
    return float(np.mean(frame.max(axis=2) == 0))


def measure(
    first: Path, second: Path, places: int, elsewhere: int, model: str = ""
) -> tuple[list[Answer], list[Answer]]:
    """-> results of ``places`` frames near the predicted position, and of ``elsewhere`` frames far from it. ``model``:
    value of [models] xfeat; empty: without weights. Raises MapError, ModelFileError."""
    sampler, frames = Places(first, second), MemoryFrameStore(1)
    describer = open_describer(model)
    package = MapPackage.open(ensure_package(second, map_cache_dir()))
    ce90_m = load([]).map.ce90_m

    def answer(from_elsewhere: bool) -> Answer:
        frame, true_px, predicted_px = sampler.draw(from_elsewhere)
        origin, prediction = sampler.prior(predicted_px)
        frames.put(prediction.frame_id, frame)
        anchor = AnchorNode(frames, package, describer, ce90_m)
        list(anchor.on(origin))
        began_s = time.process_time()
        match = next(m for m in anchor.on(prediction) if isinstance(m, MapMatch))
        cpu_ms = (time.process_time() - began_s) * 1e3
        place_m, cov_m2 = centre_point_of(match)
        off_m = place_m - sampler.local_m(true_px)
        return Answer(
            error_px=float(np.hypot(*off_m)) / float(np.hypot(*sampler.pixel_m(true_px))),
            verdict=match.verdict.value,
            sure=match.verdict is Verdict.ACCEPTED and not match.position_only,  # a coarse match only continues a track
            inside=float(off_m @ np.linalg.solve(cov_m2, off_m)) <= CHI2_95,
            cpu_ms=cpu_ms,
        )

    return [answer(False) for _ in range(places)], [answer(True) for _ in range(elsewhere)]


def centre_point_of(match: MapMatch) -> tuple[np.ndarray, np.ndarray]:
    """-> (2,) east, north [m] of the ground point at height zero in the image centre of a nadir image, and its
    covariance (2, 2). Without a pose: mode and covariance of the belief."""
    map_m2 = match.map_sigma_m**2 * np.eye(2)
    match = solved(match)
    if match.pose is None or match.pose.position_only:
        mode_m = np.zeros(2) if match.place is None else np.array([match.place.e_m, match.place.n_m])
        cov_m2 = np.zeros((2, 2)) if match.belief is None else np.reshape(match.belief.cov_m2, (2, 2))
        return mode_m, cov_m2 + map_m2 + 1e-6 * np.eye(2)
    p, axis = np.array(match.pose.p_c_in_w_m), rot_from_quat(match.pose.q_w_c)[:, 2]
    return (p - axis * (p[2] / axis[2]))[:2], ground_cov_m2(match.pose.cov, p[2]) + map_m2


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
    parser.add_argument("first", type=Path, metavar="FIRST", help="imagery that the camera sees")
    parser.add_argument("second", type=Path, metavar="SECOND", help="the map, in the same coordinate system")
    parser.add_argument("--places", type=int, default=100)
    parser.add_argument("--elsewhere", type=int, default=250)
    parser.add_argument("--json", type=Path, help="writes every answer")
    parser.add_argument(
        "--model", action="append", default=[], metavar="NAME or FILE", help="in addition to none; repeatable"
    )
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
