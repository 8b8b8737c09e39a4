"""Peers of the map matcher on the frames of a flight: python -m terrafix_lab.bench.peers FLIGHT MAP OUT [MODELS].

Methods of points, as others use them. Each gets the frame, orthorectified with the prediction that our matcher gets,
and the map around the predicted position; points of both are matched, and a homography is fitted by RANSAC. The
position is the nadir point, transformed by the homography. The prediction is the estimator's, which has used all
earlier frames: a system of this method alone would have a worse one.

SIFT with ratio test (Lowe 2004), XFeat (CVPR 2024) with mutual nearest neighbours and with LighterGlue; the models are
those of the folder MODELS."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from terrafix.anchor.matching.orthorectify import Rectified, rectify
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, rot_from_quat
from terrafix.core.node import Image
from terrafix.map.package import LocalMap, MapPackage
from terrafix.messages import Origin, Prediction
from terrafix.recorder.reader import read_flight
from terrafix.vision.sources import open_source
from terrafix_engines.features import open_point_features
from terrafix_engines.features.keypoints import Detector, Keypoints, PairMatcher
from terrafix_engines.runtime import ModelFileError
from terrafix_lab.bench.flights import run_part
from terrafix_tools.evaluate import Truth, offset_m, read_truth
from terrafix_tools.timing import spread

HALF_WINDOW_M = 70.0  # margin of the map window around the predicted footprint, and limit of the correction
GSD_PER_AGL = 1 / 200  # the scale of our own map fixes; at a finer one the points cost more, which would favour us
RATIO = 0.8  # Lowe 2004
RANSAC_PX = 5.0  # wide, for relief and the perspective of buildings
MIN_INLIERS = 8  # wrong homographies have 4 to 7
MAX_POINTS = 4096  # of XFeat in each image: the default of its authors (accelerated_features, top_k)
MAX_JOINED_POINTS = 1024  # of LighterGlue, whose cost is quadratic
SIFT, XFEAT, LIGHTERGLUE = "SIFT, ratio test", "XFeat, mutual nearest", "XFeat, LighterGlue"
MODELS = {XFEAT: ("xfeat", MAX_POINTS), LIGHTERGLUE: ("lighterglue-l3", MAX_JOINED_POINTS)}
RESULT = "peers.json"


class PointMethod(Protocol):
    """Points of an image, and matches of two such sets."""

    def points(self, image: Image, mask: np.ndarray) -> Keypoints:
        """``image`` (H, W, 3) uint8 BGR -> points where ``mask`` (H, W) bool is set."""
        ...

    def match(self, first: Keypoints, second: Keypoints) -> np.ndarray:
        """-> (M, 2) indices in ``first`` and ``second``."""
        ...


class SiftPoints:
    """SIFT with the ratio test."""

    def __init__(self) -> None:
        self._detector, self._matcher = cv2.SIFT.create(), cv2.BFMatcher(cv2.NORM_L2)

    def points(self, image: Image, mask: np.ndarray) -> Keypoints:
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        keypoints, descriptors = self._detector.detectAndCompute(gray, mask.astype(np.uint8) * 255)
        xy_px = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
        found = np.zeros((0, 1), np.float32) if descriptors is None else descriptors
        return Keypoints(xy_px, np.array([k.response for k in keypoints]), found, (mask.shape[1], mask.shape[0]))

    def match(self, first: Keypoints, second: Keypoints) -> np.ndarray:
        if min(len(first.xy_px), len(second.xy_px)) < 2:
            return np.zeros((0, 2), np.int64)
        pairs = [p for p in self._matcher.knnMatch(first.descriptors, second.descriptors, k=2) if len(p) == 2]
        good = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < RATIO * b.distance]
        return np.array(good, np.int64).reshape(-1, 2)


class ModelPoints:
    """Points of a learned model. ``most``: of each image."""

    def __init__(self, detector: Detector, matcher: PairMatcher, most: int) -> None:
        self._detector, self._matcher, self._most = detector, matcher, most

    def points(self, image: Image, mask: np.ndarray) -> Keypoints:
        found = self._detector.detect(image, self._most)
        x, y = np.round(found.xy_px).astype(int).T
        kept = mask[y, x]
        return Keypoints(found.xy_px[kept], found.scores[kept], found.descriptors[kept], found.size_px)

    def match(self, first: Keypoints, second: Keypoints) -> np.ndarray:
        return self._matcher.match(first, second)[0]


@dataclass
class FrameTimes:
    """Milliseconds of each frame: by the clock, of the processor, and of these the ones for the points of the map,
    which a system could keep."""

    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    map_cpu_ms: list[float] = field(default_factory=list)

    def add(self, wall_s: float, cpu_s: float, map_cpu_s: float = 0.0) -> None:
        """A frame that began at ``wall_s`` and ``cpu_s`` of the two clocks."""
        self.wall_ms.append((time.perf_counter() - wall_s) * 1e3)
        self.cpu_ms.append((time.process_time() - cpu_s) * 1e3)
        self.map_cpu_ms.append(map_cpu_s * 1e3)


class Peer:
    """Positions by one method of points."""

    def __init__(self, method: PointMethod, camera: CameraCalibration, local: LocalMap) -> None:
        self._method, self._camera, self._map = method, camera, local
        self.times = FrameTimes()

    def locate(self, image: Image, prediction: Prediction) -> tuple[float, float] | None:
        """-> (e_m, n_m) of the camera; None: no homography with enough inliers."""
        wall_s, cpu_s, map_cpu_s = time.perf_counter(), time.process_time(), 0.0
        found = None
        gsd_m = max(self._map.gsd_m, prediction.agl_m / self._camera.fx, prediction.agl_m * GSD_PER_AGL)
        frame = rectify(image, self._camera, rot_from_quat(prediction.q_w_c), prediction.agl_m, gsd_m)
        if frame is not None:
            own = self._method.points(frame.image, frame.mask)
            map_began_s = time.process_time()
            ground, west_m, north_m = self._map_points(frame, prediction)
            map_cpu_s = time.process_time() - map_began_s
            matrix = self._homography(own, ground)
            found = None if matrix is None else self._position(matrix, frame, prediction, west_m, north_m)
        self.times.add(wall_s, cpu_s, map_cpu_s)
        return found

    def _map_points(self, frame: Rectified, prediction: Prediction) -> tuple[Keypoints, float, float]:
        """-> points of the map window, and its north-west corner [m]."""
        (e_m, n_m, _), gsd_m = prediction.p_c_in_w_m, frame.gsd_m
        h, w = frame.mask.shape
        margin = round(HALF_WINDOW_M / gsd_m)
        west_m, north_m = e_m + frame.e_min_m - margin * gsd_m, n_m + frame.n_max_m + margin * gsd_m
        window, valid = self._map.window(west_m, north_m, w + 2 * margin, h + 2 * margin, gsd_m)
        return self._method.points(window, valid), west_m, north_m

    def _homography(self, own: Keypoints, ground: Keypoints) -> np.ndarray | None:
        if min(len(own.xy_px), len(ground.xy_px)) < MIN_INLIERS:
            return None
        pairs = self._method.match(own, ground)
        if len(pairs) < MIN_INLIERS:
            return None
        from_px, to_px = own.xy_px[pairs[:, 0]], ground.xy_px[pairs[:, 1]]
        matrix, inliers = cv2.findHomography(from_px, to_px, cv2.RANSAC, RANSAC_PX)
        return None if matrix is None or int(inliers.sum()) < MIN_INLIERS else np.asarray(matrix)

    @staticmethod
    def _position(
        matrix: np.ndarray, frame: Rectified, prediction: Prediction, west_m: float, north_m: float
    ) -> tuple[float, float] | None:
        """-> (e_m, n_m) of the nadir point; None: farther from the prediction than the window's margin."""
        (e_m, n_m, _), gsd_m = prediction.p_c_in_w_m, frame.gsd_m
        nadir_px = np.array([-frame.e_min_m / gsd_m - 0.5, frame.n_max_m / gsd_m - 0.5, 1.0])
        x, y, scale = matrix @ nadir_px
        if abs(scale) < 1e-9:
            return None
        at_e_m, at_n_m = west_m + (float(x / scale) + 0.5) * gsd_m, north_m - (float(y / scale) + 0.5) * gsd_m
        return (at_e_m, at_n_m) if max(abs(at_e_m - e_m), abs(at_n_m - n_m)) <= HALF_WINDOW_M else None


def methods(models: Path | None) -> tuple[dict[str, PointMethod], list[str]]:
    """-> methods that can run here, and why others cannot. ``models``: folder of the models; None: without them."""
    found: dict[str, PointMethod] = {SIFT: SiftPoints()}
    missing = []
    for title, (name, most) in MODELS.items():
        if models is None:
            missing.append(f"{title}: no weights")
            continue
        try:
            found[title] = ModelPoints(*open_point_features(name, str(models)), most)
        except ModelFileError as error:
            missing.append(f"{title}: {error}")
    return found, missing


def measure(flight: Path, map_path: Path, replayed: Path, models: Path | None = None) -> dict[str, Any]:
    """Runs each method on every frame of ``flight`` for which the replay in ``replayed`` has a prediction. -> times
    and accuracy of each, and methods that are missing."""
    messages = [message for _, _, message in read_flight(replayed)]
    origin = next(message for message in messages if isinstance(message, Origin))
    predictions = {message.frame_id: message for message in messages if isinstance(message, Prediction)}
    place, package = LocalFrame(origin.lat_deg, origin.lon_deg), MapPackage.open(map_path)
    able, missing = methods(models)
    local, camera = package.bind(place), CameraCalibration.of(origin.camera)
    peers = {name: Peer(method, camera, local) for name, method in able.items()}
    errors_m: dict[str, list[float]] = {name: [] for name in peers}
    decoding = FrameTimes()
    for image, prediction, truth in _frames(flight, predictions, decoding):
        for name, peer in peers.items():
            position_m = peer.locate(image, prediction)
            if position_m is not None:
                errors_m[name].append(float(np.hypot(*offset_m(truth, *place.to_wgs84(*position_m)))))
    package.close()
    rows = {name: _row(peer.times, decoding, errors_m[name]) for name, peer in peers.items()}
    return {"frames": len(decoding.cpu_ms), "peers": rows, "missing": missing}


def _frames(
    flight: Path, predictions: dict[int, Prediction], decoding: FrameTimes
) -> Iterator[tuple[Image, Prediction, Truth]]:
    """The frames that have a prediction and a truth. Adds the times of reading and decoding to ``decoding``."""
    truth = read_truth(flight / "truth.csv")
    source = open_source(str(flight))
    shots = source.shots()
    while True:
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        shot = next(shots, None)
        if shot is None:
            break
        prediction = predictions.get(shot.frame.frame_id)
        if shot.image is not None and prediction is not None and shot.frame.file in truth:
            decoding.add(wall_s, cpu_s)
            yield shot.image, prediction, truth[shot.frame.file]
    source.close()


def _row(times: FrameTimes, decoding: FrameTimes, errors_m: list[float]) -> dict[str, Any]:
    """-> times of whole frames, as ours are, with their decoding, and accuracy of one method."""
    frames = len(times.cpu_ms)
    kept_ms = np.subtract(times.cpu_ms, times.map_cpu_ms)
    return {
        "answered": len(errors_m),
        "frame_ms": spread(list(np.add(times.wall_ms, decoding.wall_ms))) if frames else None,
        "cpu_ms": spread(list(np.add(times.cpu_ms, decoding.cpu_ms))) if frames else None,
        "cpu_ms_with_map_points_kept": spread(list(np.add(kept_ms, decoding.cpu_ms))) if frames else None,
        "accuracy": {
            "within_20m": sum(e <= 20.0 for e in errors_m) / frames if frames else None,
            "within_50m": sum(e <= 50.0 for e in errors_m) / frames if frames else None,
            "median_m": round(float(np.median(errors_m)), 3) if errors_m else None,
        },
    }


if __name__ == "__main__":
    run_part(measure, RESULT)
