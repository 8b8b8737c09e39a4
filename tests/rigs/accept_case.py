"""A synthetic flight for the acceptance tests: straight north, estimates with known errors, and its record."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.geodesy import LocalFrame
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_lab.accept.measuring.evidence import Evidence, gather
from terrafix_lab.accept.measuring.results import Marks
from terrafix_lab.sim.true_messages import estimate as true_estimate
from terrafix_tools.estimates import ESTIMATES, RowTable, write_rows
from terrafix_tools.evaluate import Truth

PLACE = LocalFrame(48.0, 11.0)
CAMERA = m.Camera(width=960, height=540, fx=500.0, fy=500.0, cx=479.5, cy=269.5)
STEP_M, STEP_S = 10.0, 0.5
UNMARKED = Marks()
LOOKING_DOWN = (0.0, 1.0, 0.0, 0.0)  # q_w_c, w first


@dataclass(frozen=True)
class FrameCase:
    """Messages about one frame, by their errors."""

    error_m: float = 1.0  # east
    late_s: float = 0.0  # time of the estimate before the stamp of the frame
    sigma_m: float = 5.0
    label: m.SourceLabel = m.SourceLabel.SATELLITE_ANCHORED
    fixed: bool = True
    predicted_error_m: float = 0.0  # of the prediction before the map fix
    mode: m.CovarianceMode = m.CovarianceMode.MARGINALS
    odometry: m.Verdict = m.Verdict.ACCEPTED
    keyframe_id: int = 0  # of its odometry
    fragment_id: int = 0
    anchor_age_ms: int = 0
    refined_after_s: float | None = None  # by the smoother, after the time stamp; None: not in flight


def file_of(i: int) -> str:
    return f"{i:04d}.jpg"


def true_m(i: int) -> tuple[float, float]:
    """-> true east, north of frame i."""
    return 0.0, i * STEP_M


def evidence(out: Path, frames: Sequence[FrameCase], marks: Marks = UNMARKED, **gathered: object) -> Evidence:
    """Evidence as of a replay."""
    out.mkdir(exist_ok=True)
    messages: list[m.Message] = [
        m.Origin(
            t_ns=0, camera=CAMERA, lat_deg=48.0, lon_deg=11.0, ground_amsl_m=0.0, start_sigma_m=10.0,
            yaw_sigma_deg=3.0, agl_sigma_m=3.0, attitude_sigma_deg=1.0)
    ]  # fmt: skip
    for i, case in enumerate(frames):
        messages += _frame(i, case)
    poses = [
        m.RefinedPose(frame_id=i, lat_deg=48.0, lon_deg=11.0, alt_amsl_m=0.0, sigma_e_m=1.0, sigma_n_m=1.0)
        for i in range(len(frames))
    ]
    messages += [_refined_in_flight(i, case) for i, case in enumerate(frames) if case.refined_after_s is not None]
    messages.append(m.Refinement(t_ns=0, poses=poses))
    table = RowTable()
    writer = FlightWriter(out / "flight.mcap", header(Config()))
    for message in messages:
        writer.write(message, message.t_ns)
        table.take(message)
    writer.close()
    for row in table.rows.values():
        row.process_ms = 100.0
    with (out / ESTIMATES).open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, table.rows.values())
    accepted = sum(f.odometry is m.Verdict.ACCEPTED for f in frames)
    summary = {"frames": len(frames), "odometry_frames": accepted - 1, "peak_memory_mb": 321.0}
    (out / "summary.json").write_text(json.dumps(summary))
    truth = {file_of(i): Truth(*PLACE.to_wgs84(*true_m(i))) for i in range(len(frames))}
    return gather(out, truth, marks, **gathered)  # type: ignore[arg-type]


def _refined_in_flight(i: int, case: FrameCase) -> m.Refinement:
    assert case.refined_after_s is not None
    pose = m.RefinedPose(
        frame_id=i, lat_deg=48.0, lon_deg=11.0, alt_amsl_m=0.0, sigma_e_m=1.0, sigma_n_m=1.0,
        fragment_id=case.fragment_id)  # fmt: skip
    t_ns = round((i * STEP_S + case.refined_after_s) * 1e9)
    return m.Refinement(t_ns=t_ns, poses=[pose], source=m.RefinementSource.SMOOTHER)


def _frame(i: int, case: FrameCase) -> list[m.Message]:
    t_ns = round(i * STEP_S * 1e9)
    e_m, n_m = true_m(i)
    lat_deg, lon_deg = PLACE.to_wgs84(e_m + case.error_m, n_m - case.late_s * STEP_M / STEP_S)
    match_verdict = m.Verdict.ACCEPTED if case.fixed else m.Verdict.FEW_INLIERS
    cov = tuple(float(v) for v in (np.eye(6) * case.sigma_m**2).ravel())
    return [
        m.Frame(t_ns=t_ns, frame_id=i, file=file_of(i), width=960, height=540),
        m.Odometry(
            t_ns=t_ns, frame_id=i, keyframe_id=case.keyframe_id, verdict=case.odometry, fragment_id=case.fragment_id,
            two_view=[(0.0, 0.0, 0.0, 0.0)] if i != case.keyframe_id and case.odometry is m.Verdict.ACCEPTED else []),
        m.MeasurementVerdict(t_ns=t_ns, frame_id=i, measurement="odometry", verdict=case.odometry),
        m.Prediction(
            t_ns=t_ns, frame_id=i, p_c_in_w_m=(e_m + case.predicted_error_m, n_m, 100.0), q_w_c=LOOKING_DOWN, cov=cov,
            agl_m=100.0, agl_sigma_m=2.0, step_m=(0.0, STEP_M), step_cov_m2=(1.0, 0.0, 0.0, 1.0)),
        m.MapMatch(t_ns=t_ns, frame_id=i, verdict=match_verdict, matcher="gradient"),
        m.MeasurementVerdict(t_ns=t_ns, frame_id=i, measurement="map", verdict=match_verdict),
        true_estimate(
            t_ns - round(case.late_s * 1e9), lat_deg, lon_deg, sigmas=(case.sigma_m,) * 3, frame_id=i,
            alt_amsl_m=100.0, agl_m=100.0, velocity_enu_mps=(0.0, 20.0, 0.0), velocity_sigma_mps=1.0,
            source_label=case.label, covariance_mode=case.mode, last_anchor_age_ms=case.anchor_age_ms,
            emitted_at_ns=t_ns),
    ]  # fmt: skip
