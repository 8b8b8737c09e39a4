"""One flight of the run: messages into the real estimator and smoother."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, rot_from_quat
from terrafix.core.node import Node
from terrafix.core.pose import log_so3
from terrafix.estimator.node import EstimatorNode
from terrafix.messages import (
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Prediction,
    Refinement,
    SourceEnded,
    Verdict,
)
from terrafix.smoother.node import SmootherNode
from terrafix_lab.faults.edits import Span
from terrafix_lab.faults.messages import MatchEdit
from terrafix_lab.faults.table import FAULTS
from terrafix_lab.montecarlo.edited import edited
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.faults import Faults
from terrafix_lab.montecarlo.flown import Shot, fly
from terrafix_lab.montecarlo.ground import MapError, Terrain
from terrafix_lab.montecarlo.lens import TrueLens
from terrafix_lab.montecarlo.lies import FindMatch, Lies
from terrafix_lab.montecarlo.matches import MapMatches
from terrafix_lab.montecarlo.plan import FlightPlan
from terrafix_lab.montecarlo.sightings import SimulatedOdometry
from terrafix_tools.in_process import InProcessShell


@dataclass
class Record:
    """Result of a flight. Arrays have one row for each frame, of its last estimate."""

    plan: FlightPlan
    t_s: np.ndarray
    path_m: np.ndarray  # (N,) flown over ground
    truth_m: np.ndarray  # (N, 2)
    error_m: np.ndarray  # (N, 6): east, north, up [m], rotation about them [rad]; estimate minus truth
    cov: np.ndarray  # (N, 6, 6) as published
    velocity_error_mps: np.ndarray  # (N, 3)
    velocity_sigma_mps: np.ndarray  # (N,)
    anchor_age_ms: np.ndarray  # (N,)
    refined_error_m: np.ndarray  # (N, 2); nan: not refined
    refined_sigma_m: np.ndarray  # (N, 2)
    cpu_ms: np.ndarray  # (N,) of the estimator
    refine_cpu_s: float = 0.0
    rebuilds: int = 0
    restarts: int = 0
    smoother_cpu_s: float = 0.0
    smoothed_error_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2); nan: not refined in flight
    smoothed_cov: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 2)))  # (N, 2, 2) as published
    lie: Span | None = None  # of the first false input; None: there is none
    fixes: dict[str, int] = field(default_factory=dict)  # verdicts on map matches

    def of_frames(self, estimated: np.ndarray) -> "Record":
        """The record without frames that have no estimate: images that were taken before the newest one."""
        by_frame = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **{name: value[estimated] for name, value in by_frame.items()})


def run(plan: FlightPlan, *, refine: bool = True) -> Record:
    """Deterministic except for processor time and memory."""
    return Run(plan).record(refine)


class MeasuredNode:
    """A node with the processor time that it has taken."""

    def __init__(self, node: Node) -> None:
        self._node, self.cpu_s = node, 0.0

    def on(self, message: Message) -> list[Message]:
        began_s = time.process_time()
        published = list(self._node.on(message))
        self.cpu_s += time.process_time() - began_s
        return published

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._node.tick(now_ns)


class Run:
    def __init__(self, plan: FlightPlan, estimator: EstimatorNode | None = None) -> None:
        """``estimator``: another than the usual one."""
        flown = fly(plan, Terrain(plan.seed, plan.hills_m, plan.settled))
        self._edit_match: MatchEdit = lambda match, _prediction: match
        if not isinstance(plan.fault, DrawnFault):
            fault = FAULTS[plan.fault]
            flown, self._edit_match = edited(flown, fault), fault.matches() if fault.matches else self._edit_match
        self._plan, self.flown = plan, flown
        self._node = estimator or EstimatorNode()
        self._estimator, self._smoother = MeasuredNode(self._node), MeasuredNode(SmootherNode())
        self._shell = InProcessShell({"estimator": self._estimator, "smoother": self._smoother}, self._record_message)
        self._predictions: list[Prediction] = []  # since the last odometry
        self._frame = LocalFrame(flown.origin.lat_deg, flown.origin.lon_deg)
        self._times_ns: dict[int, int] = {}  # frame -> time of its newest estimate
        n = len(flown.frames)
        self._record = Record(
            plan=plan,
            t_s=np.array([shot.t_s for shot in flown.frames]),
            path_m=flown.path_m,
            truth_m=np.array([shot.p_m[:2] for shot in flown.frames]),
            error_m=np.full((n, 6), np.nan),
            cov=np.full((n, 6, 6), np.nan),
            velocity_error_mps=np.full((n, 3), np.nan),
            velocity_sigma_mps=np.full(n, np.nan),
            anchor_age_ms=np.full(n, -1),
            refined_error_m=np.full((n, 2), np.nan),
            refined_sigma_m=np.full((n, 2), np.nan),
            cpu_ms=np.zeros(n),
            smoothed_error_m=np.full((n, 2), np.nan),
            smoothed_cov=np.full((n, 2, 2), np.nan),
        )

    def record(self, refine: bool) -> Record:
        plan, flown, record = self._plan, self.flown, self._record
        described = flown.origin.camera
        focal_error = plan.focal_error
        if described.fx != plan.camera.fx:
            focal_error = (1.0 + focal_error) * plan.camera.fx / described.fx - 1.0
        lens = TrueLens(CameraCalibration.of(described), focal_error, plan.k1_error)
        sightings = SimulatedOdometry(lens, flown.terrain, plan.seed)
        matches = MapMatches(
            lens,
            flown.terrain,
            MapError(plan.seed, np.array(plan.map_offset_m), plan.map_sigma_m),
            has_dem=plan.has_dem,
            map_sigma_m=plan.map_sigma_m,
            seed=plan.seed,
        )
        faults, lies = Faults(plan.fault, plan.duration_s, plan.seed), Lies(plan, flown)
        record.lie = lies.span()
        self._shell.feed(flown.origin)
        late: list[tuple[int, MapMatch]] = []  # frame at which it is published
        for i, shot in enumerate(flown.frames):
            picture = lies.picture(i)
            odometry = sightings.odometry(i, picture, blind=picture.dark or faults.is_blacked_out(shot.t_s))
            began_s = self._estimator.cpu_s
            self._predictions.clear()
            for message in (*flown.telemetry[i], odometry):
                self._shell.feed(message)
            find = find_match(matches, faults, shot.t_s, dark=picture.dark)
            late += [
                (
                    i + faults.late_frames(),
                    faults.alter(self._edit_match(lies.match(i, prediction, find), prediction), shot),
                )
                for prediction in self._predictions
            ]
            for due, match in late:
                if due <= i:
                    self._shell.feed(match)
            record.cpu_ms[i] = 1e3 * (self._estimator.cpu_s - began_s)
            late = [(due, match) for due, match in late if due > i]
        if refine:
            began_s = self._estimator.cpu_s
            self._shell.feed(SourceEnded(t_ns=round(flown.frames[-1].t_s * 1e9), frames=len(flown.frames)))
            record.refine_cpu_s = self._estimator.cpu_s - began_s
        record.smoother_cpu_s = self._smoother.cpu_s
        estimator = self._node.estimator  # no message has this number
        record.rebuilds = estimator.graph.rebuilds if estimator is not None else 0
        return record.of_frames(np.isfinite(record.error_m[:, 0]))

    def _record_message(self, publisher: str, message: Message) -> None:
        record = self._record
        match message:
            case Prediction():
                self._predictions.append(message)
            case NavEstimate():
                self._record_estimate(message)
            case MeasurementVerdict(measurement="map"):
                record.fixes[str(message.verdict)] = record.fixes.get(str(message.verdict), 0) + 1
                record.restarts += message.verdict is Verdict.ACCEPTED and message.detail.startswith("restarted")
            case Refinement():
                for pose in message.poses:
                    at = self._frame.to_local(pose.lat_deg, pose.lon_deg)
                    error_m = np.array(at) - self._truth(pose.frame_id).p_m[:2]
                    if publisher == "smoother":
                        (e2, n2), en = np.square([pose.sigma_e_m, pose.sigma_n_m]), pose.cov_en_m2
                        record.smoothed_error_m[pose.frame_id] = error_m
                        record.smoothed_cov[pose.frame_id] = [[e2, en], [en, n2]]
                    else:
                        record.refined_error_m[pose.frame_id] = error_m
                        record.refined_sigma_m[pose.frame_id] = pose.sigma_e_m, pose.sigma_n_m

    def _truth(self, frame_id: int) -> Shot:
        """At the time of the newest estimate of the frame. That is earlier than the frame's time stamp if the estimator
        corrects a time offset of the camera."""
        shot, t_ns = self.flown.frames[frame_id], self._times_ns[frame_id]
        return shot if round(shot.t_s * 1e9) == t_ns else self.flown.at(t_ns * 1e-9)

    def _record_estimate(self, estimate: NavEstimate) -> None:
        i, record = estimate.frame_id, self._record
        self._times_ns[i] = estimate.t_ns
        shot = self._truth(i)
        e_m, n_m = self._frame.to_local(estimate.lat_deg, estimate.lon_deg)
        record.error_m[i, :3] = np.array([e_m, n_m, estimate.alt_amsl_m]) - shot.p_m
        record.error_m[i, 3:] = log_so3(rot_from_quat(estimate.q_w_b) @ shot.r_w_b.T)
        record.cov[i] = np.array(estimate.cov).reshape(6, 6)
        record.velocity_error_mps[i] = np.array(estimate.velocity_enu_mps) - shot.velocity_mps
        record.velocity_sigma_mps[i] = estimate.velocity_sigma_mps
        record.anchor_age_ms[i] = estimate.last_anchor_age_ms


def find_match(matches: MapMatches, faults: Faults, t_s: float, *, dark: bool = False) -> FindMatch:
    """The matches at ``t_s``: none of a ``dark`` picture, in a blackout, or over ground that the map does not have."""
    if dark or faults.is_blacked_out(t_s):
        return partial(matches.no_match, verdict=Verdict.BAD_IMAGE)
    if faults.is_unmapped(t_s):
        return partial(matches.no_match, verdict=Verdict.FEW_INLIERS)
    return matches.match
