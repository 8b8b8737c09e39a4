"""Times of single parts on a recorded flight: python -m terrafix_lab.bench.micro FLIGHT MAP OUT.

The inputs of each part are those of the replay in OUT, from its record."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.matching.point_mass_filter import Belief, belief_cell_m
from terrafix.core.camera import CameraCalibration
from terrafix.core.config import Config
from terrafix.core.geodesy import LocalFrame, rot_from_quat
from terrafix.core.node import Image
from terrafix.estimator.node import EstimatorNode
from terrafix.link.node import TICK_HZ, LinkNode
from terrafix.map.package import MapPackage
from terrafix.messages import (
    Health,
    MapMatch,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    Prediction,
    ThermalBand,
    VehicleState,
    WallClock,
)
from terrafix.recorder.reader import read_flight
from terrafix.vision.feature_tracker import FrameTracker
from terrafix.vision.sources import open_source
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_lab.bench.flights import run_part
from terrafix_tools.in_process import InProcessShell
from terrafix_tools.timing import spread

RESULT = "micro.json"
FRAMES = 40  # first frames of the flight
CORRELATIONS = 10  # evenly spread frames among these, for the slow parts
NODES = 20  # window of the estimator; it is full after so many frames
UNIX_NS = 1_750_000_000 * 10**9  # of the link's wall clock: any time after the GPS epoch
BELIEF_SIGMA_M = 20.0  # initial 1-sigma of the belief: a usual value in flight


def measure(flight: Path, map_path: Path, replayed: Path, _xfeat: Path | None = None) -> dict[str, Any]:
    """-> part -> {median, p95} in ms."""
    messages = [message for _, _, message in read_flight(replayed)]
    origin = next(message for message in messages if isinstance(message, Origin))
    camera = CameraCalibration.of(origin.camera)
    images = _images(flight)
    tracker = FrameTracker(camera)
    result = {"odometry": spread([_ms(partial(tracker.track, i, p)) for i, p in images.items()])}
    package = MapPackage.open(map_path)
    local = package.bind(LocalFrame(origin.lat_deg, origin.lon_deg))
    predictions = [m for m in messages if isinstance(m, Prediction) and m.frame_id in images]
    chosen = predictions[:: max(1, len(predictions) // CORRELATIONS)]
    matcher = FrameMatcher(camera, local, GradientDescriber())
    result |= _correlations(matcher, chosen, images, origin.ground_amsl_m or 0.0)
    package.close()
    for band, name in ((ThermalBand.NORMAL, "marginals"), (ThermalBand.HOT, "jacobian")):
        times_ms = _estimator(messages, band)
        result[f"estimator frame, {NODES} nodes, {name}"] = spread(times_ms) if times_ms else {}
    result["link, one second"] = spread(_link(messages))
    return result


def _correlations(
    matcher: FrameMatcher, predictions: list[Prediction], images: dict[int, Image], ground_m: float
) -> dict[str, Any]:
    """-> times of correlation, belief update and map fix."""
    correlate_ms, update_ms, fix_ms = [], [], []
    for prediction in predictions:
        image, view = images[prediction.frame_id], _view(prediction, ground_m)
        belief = Belief(
            view.e_m, view.n_m, BELIEF_SIGMA_M, belief_cell_m(view.agl_m, matcher.correlation_cell_m(view.agl_m))
        )
        matcher.correlate(image, view, belief)  # not timed: in flight the map's descriptors are in the cache
        began_s = time.perf_counter()
        correlation = matcher.correlate(image, view, belief)
        correlate_ms.append((time.perf_counter() - began_s) * 1e3)
        if not correlation.surfaces:
            continue
        update_ms.append(_ms(partial(belief.update, correlation.surfaces, 1.0)))
        mode = belief.mode()
        hypothesis, _ = correlation.best_at(mode.e_m, mode.n_m)
        matcher.fix(image, view, hypothesis, mode.e_m, mode.n_m)
        fix_ms.append(_ms(partial(matcher.fix, image, view, hypothesis, mode.e_m, mode.n_m)))
    parts = {"look (search)": correlate_ms, "belief update": update_ms, "fix (patches + PnP)": fix_ms}
    return {name: spread(values) for name, values in parts.items() if values}


def _estimator(messages: list[Message], band: ThermalBand) -> list[float]:
    """-> time of each frame [ms] after the window is full: odometry in, prediction and estimate out, map match in,
    estimate out, with covariance."""
    shell = InProcessShell({"estimator": EstimatorNode()}, lambda _, __: None)
    shell.feed(Health(t_ns=0, band=band, temperature_c=None, throttled=False, disk_free_mb=None, cause="benchmark"))
    times: dict[int, float] = {}
    for message in messages:
        if isinstance(message, Origin | VehicleState):
            shell.feed(message)
        elif isinstance(message, Odometry | MapMatch):
            elapsed = _ms(partial(shell.feed, message))
            times[message.frame_id] = times.get(message.frame_id, 0.0) + elapsed
    return list(times.values())[NODES:]


def _link(messages: list[Message]) -> list[float]:
    """-> time of the ticks of each second [ms], at the link's tick rate, with the estimates of the record."""
    shell = InProcessShell({"link": LinkNode(Config().link.rate_hz)}, lambda _, __: None)
    shell.feed_read("link", WallClock(t_ns=0, unix_ns=UNIX_NS, source="system"))  # without it the link sends nothing
    times_ms, now_ns = [], 0
    for message in messages:
        if isinstance(message, Origin | NavEstimate | VehicleState):
            while now_ns < message.t_ns:
                now_ns += round(1e9 / TICK_HZ)
                times_ms.append(_ms(partial(shell.tick, now_ns)))
            if isinstance(message, VehicleState):
                shell.feed_read("link", message)
            else:
                shell.feed(message)
    second = round(TICK_HZ)
    return [sum(times_ms[i : i + second]) for i in range(0, len(times_ms), second)]


def _view(prediction: Prediction, ground_m: float) -> View:
    e_m, n_m, _ = prediction.p_c_in_w_m
    cov = np.array(prediction.cov).reshape(6, 6)
    return View(
        e_m=e_m,
        n_m=n_m,
        r_w_c=rot_from_quat(prediction.q_w_c),
        agl_m=prediction.agl_m,
        ground_m=ground_m,
        yaw_sigma_rad=float(np.sqrt(cov[5, 5])),
        scale_sigma=prediction.agl_sigma_m / max(prediction.agl_m, 1.0),
        tilt_sigma_rad=float(np.sqrt(max(cov[3, 3], cov[4, 4]))),
    )


def _images(flight: Path) -> dict[int, Image]:
    source = open_source(str(flight))
    found: dict[int, Image] = {}
    for shot in source.shots():
        if shot.image is not None:
            found[shot.frame.frame_id] = shot.image
        if len(found) >= FRAMES:
            break
    source.close()
    return found


def _ms(work: Callable[[], object]) -> float:
    began_s = time.perf_counter()
    work()
    return (time.perf_counter() - began_s) * 1e3


if __name__ == "__main__":
    run_part(measure, RESULT)
