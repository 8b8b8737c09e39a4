"""Baseline of the benchmark, the usual first approach: python -m terrafix_tools.bench.baseline FLIGHT MAP OUT.

The frame is orthorectified with the prediction that the matcher gets, and matched against the map around the predicted
position: SIFT, ratio test (Lowe 2004), homography by RANSAC. The position is the nadir point, transformed by the
homography. The prediction is the estimator's, which has used all earlier frames: a system of this method alone would
have a worse one."""

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from terrafix.anchor.matching.orthorectify import rectify
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, rot_from_quat
from terrafix.core.node import Image
from terrafix.map.package import LocalMap, MapPackage
from terrafix.messages import Origin, Prediction
from terrafix.recorder.reader import read_flight
from terrafix.vision.sources import open_source
from terrafix_tools.bench.flights import run_part, spread
from terrafix_tools.evaluate import offset_m, read_truth

HALF_WINDOW_M = 70.0  # margin of the map window around the predicted footprint, and limit of the correction
GSD_PER_AGL = 1 / 200  # the scale of our own map fixes; at a finer one SIFT is slower, which would favour us
RATIO = 0.8  # Lowe 2004
RANSAC_PX = 5.0  # wide, for relief and the perspective of buildings
MIN_INLIERS = 8  # wrong homographies have 4 to 7
METHOD = "SIFT, ratio test 0.8, RANSAC homography"
RESULT = "baseline.json"


class SiftBaseline:
    def __init__(self, camera: CameraCalibration, local: LocalMap) -> None:
        self._camera, self._map = camera, local
        self._sift = cv2.SIFT.create()
        self._matcher = cv2.BFMatcher(cv2.NORM_L2)

    def locate(self, image: Image, prediction: Prediction) -> tuple[float, float] | None:
        """-> (e_m, n_m) of the camera; None: no homography with enough inliers."""
        e_m, n_m, _ = prediction.p_c_in_w_m
        gsd_m = max(self._map.gsd_m, prediction.agl_m / self._camera.fx, prediction.agl_m * GSD_PER_AGL)
        frame = rectify(image, self._camera, rot_from_quat(prediction.q_w_c), prediction.agl_m, gsd_m)
        if frame is None:
            return None
        h, w = frame.mask.shape
        margin = round(HALF_WINDOW_M / gsd_m)
        west, north = e_m + frame.e_min_m - margin * gsd_m, n_m + frame.n_max_m + margin * gsd_m
        window, valid = self._map.window(west, north, w + 2 * margin, h + 2 * margin, gsd_m)
        frame_descriptors, frame_px = self._describe(frame.image, frame.mask)
        map_descriptors, map_px = self._describe(window, valid)
        if len(frame_px) < MIN_INLIERS or len(map_px) < MIN_INLIERS:
            return None
        neighbours = [p for p in self._matcher.knnMatch(frame_descriptors, map_descriptors, k=2) if len(p) == 2]
        good = [a for a, b in neighbours if a.distance < RATIO * b.distance]
        if len(good) < MIN_INLIERS:
            return None
        from_px, to_px = frame_px[[g.queryIdx for g in good]], map_px[[g.trainIdx for g in good]]
        matrix, inliers = cv2.findHomography(from_px, to_px, cv2.RANSAC, RANSAC_PX)
        if matrix is None or int(inliers.sum()) < MIN_INLIERS:
            return None
        nadir_px = np.array([-frame.e_min_m / gsd_m - 0.5, frame.n_max_m / gsd_m - 0.5, 1.0])
        x, y, scale = matrix @ nadir_px
        if abs(scale) < 1e-9:
            return None
        at_e_m, at_n_m = west + (float(x / scale) + 0.5) * gsd_m, north - (float(y / scale) + 0.5) * gsd_m
        inside = max(abs(at_e_m - e_m), abs(at_n_m - n_m)) <= HALF_WINDOW_M
        return (at_e_m, at_n_m) if inside else None

    def _describe(self, image: Image, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> descriptors (N, 128) float32 and their pixels (N, 2)."""
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        keypoints, descriptors = self._sift.detectAndCompute(gray, mask.astype(np.uint8) * 255)
        if descriptors is None:
            return np.zeros((0, 128), np.float32), np.zeros((0, 2), np.float32)
        return descriptors, np.array([k.pt for k in keypoints], np.float32)


def measure(flight: Path, map_path: Path, replayed: Path, _xfeat: Path | None = None) -> dict[str, Any]:
    """Runs the baseline on every frame of ``flight`` for which the replay in ``replayed`` has a prediction. -> times
    and accuracy."""
    messages = [message for _, _, message in read_flight(replayed)]
    origin = next(message for message in messages if isinstance(message, Origin))
    predictions = {message.frame_id: message for message in messages if isinstance(message, Prediction)}
    place = LocalFrame(origin.lat_deg, origin.lon_deg)
    truth = read_truth(flight / "truth.csv")
    package = MapPackage.open(map_path)
    baseline = SiftBaseline(CameraCalibration.of(origin.camera), package.bind(place))
    times_ms, cpu_ms, errors_m, frames = [], [], [], 0
    source = open_source(str(flight))
    shots = source.shots()
    while True:
        began_s, cpu_s = time.perf_counter(), time.process_time()
        shot = next(shots, None)  # timed: reading and decoding are part of our own time per frame, too
        if shot is None:
            break
        prediction = predictions.get(shot.frame.frame_id)
        if shot.image is None or prediction is None or shot.frame.file not in truth:
            continue
        position_m = baseline.locate(shot.image, prediction)
        times_ms.append((time.perf_counter() - began_s) * 1e3)
        cpu_ms.append((time.process_time() - cpu_s) * 1e3)
        frames += 1
        if position_m is not None:
            errors_m.append(float(np.hypot(*offset_m(truth[shot.frame.file], *place.to_wgs84(*position_m)))))
    source.close()
    package.close()
    return {
        "method": METHOD,
        "frames": frames,
        "answered": len(errors_m),
        "frame_ms": spread(times_ms) if times_ms else None,
        "cpu_ms": spread(cpu_ms) if cpu_ms else None,
        "accuracy": {
            "within_20m": sum(e <= 20.0 for e in errors_m) / frames if frames else None,
            "within_50m": sum(e <= 50.0 for e in errors_m) / frames if frames else None,
            "median_m": round(float(np.median(errors_m)), 3) if errors_m else None,
        },
    }


if __name__ == "__main__":
    run_part(measure, RESULT)
