"""`terrafix finalise`: batch smoothing of a flight record after landing."""

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

from terrafix.core.camera import Mount
from terrafix.core.errors import SourceError
from terrafix.core.geodesy import LocalFrame, quat_from_rot, yaw_of
from terrafix.core.map_error import shared_variance_m2
from terrafix.core.pose import exp_so3, tangent_to_world, world_to_tangent
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.state import EAST, HORIZONTAL, MOUNT_TILT, NORTH, TRANSLATION, UP
from terrafix.messages import Frame, SourceEnded
from terrafix.processes import PROCESSES
from terrafix.recorder.provenance import versions
from terrafix.recorder.reader import ReadResult, check_format, read_flight
from terrafix_tools.before_after import FINALISED, REFINED, Change, kept_line
from terrafix_tools.estimates import NS, numbers
from terrafix_tools.finalise.batch_smoother import Smoothed, smooth
from terrafix_tools.finalise.flight_graph import FlightGraph, FlightReplayer
from terrafix_tools.finalise.held_out import EVERY, Choice, Comparison, choose
from terrafix_tools.finalise.point_cloud import POINTS, VERTEX, cloud_name, write_ply
from terrafix_tools.finalised import TABLE, FinalRow, write
from terrafix_tools.progress import LineProgress

# Messages that the estimator subscribes to. SourceEnded is left out: it starts the estimator's own refinement.
REPLAYED = tuple(t for p in PROCESSES if p.name == "estimator" for t in p.subscribes if t is not SourceEnded)

Step = Callable[[str, int, int | None], None]


def _no_step(_name: str, _done: int, _of: int | None) -> None:
    """Progress that nobody sees."""


def finalise(folder: Path, step: Step = _no_step) -> dict[str, Any]:
    """Writes finalised.csv, finalised.json and points.ply beside the record, returns the summary (docs/finalise.md).

    ``folder``: of a replay or of a live run, or a record file in it. ``step``: gets the progress. Raises SourceError,
    OutputError."""
    began_s = time.process_time()
    result = ReadResult()
    chosen = _choices(folder, step)
    rows, replayer = _replay(folder, result, step)
    smoothed = [
        _smoothed(flight, estimator, choice, rows, step)
        for (flight, estimator), choice in zip(_flown(replayer), chosen, strict=True)
    ]
    summary: dict[str, Any] = {
        "record": [path.name for path in result.files],
        "cut_off": [path.name for path in result.truncated_files],
        "undecodable": result.undecodable,
        "frames": len(rows),
        "versions": versions(),
        "flights": [part for part, _ in smoothed],
    }
    summary["finalised"] = sum(row.lat_deg is not None for row in rows.values())
    summary["cpu_s"] = round(time.process_time() - began_s, 2)
    out = folder if folder.is_dir() else folder.parent
    write(out, list(rows.values()), summary)
    for i, ((flight, _), (_, points)) in enumerate(zip(_flown(replayer), smoothed, strict=True)):
        axes = LocalFrame(flight.origin.lat_deg, flight.origin.lon_deg)
        write_ply(out / cloud_name(i), points, axes)
    return summary


def last_lines(summary: dict[str, Any], folder: Path) -> Iterator[str]:
    """Lines of the summary for the user."""
    for name in summary["cut_off"]:
        yield f"{name} ends in the middle of a record: what came before was used."
    if summary["undecodable"]:
        yield f"{summary['undecodable']} messages are of another version of this program, and were left out."
    for flight in summary["flights"]:
        fixes = flight["map_matches"]
        if not fixes["believed"]:
            yield "No map match was accepted: the track follows from the start coordinate and odometry alone."
        if line := kept_line(flight):
            yield line
        for why in flight["not_placed"]:
            yield f"{why['frames']} frames have no position: {why['why']}."
    yield f"{sum(flight['points'] for flight in summary['flights'])} points of the ground in {folder / POINTS}"
    found = [f["map_matches"] for f in summary["flights"]]
    yield (
        f"{summary['finalised']} of {summary['frames']} frames placed by {sum(f['believed'] for f in found)} map "
        f"matches ({sum(f['refused'] for f in found)} rejected); written to {folder / TABLE}"
    )


def flights_of(folder: Path) -> list[FlightGraph]:
    """Flights of a record, as the smoother takes them. Raises SourceError."""
    return [flight for flight, _ in _flown(_replay(folder, ReadResult(), _no_step)[1])]


def _flown(replayer: FlightReplayer) -> list[tuple[FlightGraph, Estimator]]:
    """The flights of a record that have a frame, each with its estimator."""
    flown = zip(replayer.flights, replayer.estimators, strict=True)
    return [(flight, estimator) for flight, estimator in flown if flight.node_of]


def _choices(folder: Path, step: Step) -> list[Choice]:
    """By the map matches that each flight is replayed without."""
    _, replayer = _replay(folder, ReadResult(), step, hold_out_every=EVERY)
    return [choose(flight, lambda done, of: step("compare", done, of)) for flight, _ in _flown(replayer)]


def _replay(
    folder: Path, result: ReadResult, step: Step, hold_out_every: int = 0
) -> tuple[dict[int, FinalRow], FlightReplayer]:
    """-> a row for every frame, in order of arrival; the flights of the record."""
    replayer = FlightReplayer(hold_out_every)
    rows: dict[int, FinalRow] = {}
    for _, _, message in read_flight(folder, result):
        if isinstance(message, Frame):
            rows.setdefault(message.frame_id, FinalRow(message.file, message.t_ns / NS))
            step("read", len(rows), None)
        if isinstance(message, REPLAYED):
            replayer.on(message)
    check_format(folder, result)
    if not replayer.flights or not rows:
        missing = "no frame" if replayer.flights else "no origin of a flight"
        where = ", ".join(path.name for path in result.files)
        also = f" ({result.undecodable} messages are of another version)" if result.undecodable else ""
        raise SourceError(f"{folder}: {where} has {missing}{also}; was the source of the flight opened?")
    for flight in replayer.flights:
        flight.recorder.store_estimates()
    return rows, replayer


def _smoothed(
    flight: FlightGraph, estimator: Estimator, choice: Choice, rows: dict[int, FinalRow], step: Step
) -> tuple[dict[str, Any], np.ndarray]:
    """Fills the rows of one flight. -> its part of the summary, and its point cloud."""
    try:
        found = smooth(flight, lambda done, of: step("smooth", done, of), estimates_lens=choice.estimates_lens)
    except RuntimeError as error:  # GTSAM: the system is indeterminate
        reason = f"the measurements do not determine the track ({str(error).strip().splitlines()[0]})"
        summary = _summary(flight, None, choice, [{"frames": len(flight.node_of), "why": reason}])
        return {**summary, "points": 0}, np.zeros(0, VERTEX)
    frame = LocalFrame(flight.origin.lat_deg, flight.origin.lon_deg)
    r_b_c = Mount.of(flight.origin.camera).r_b_c()
    track = solved_track(flight, found)
    if not choice.kept:
        track |= {i: at for i, at in refined_track(flight, estimator).items() if i in track}
    if not choice.estimates_lens:
        track = heights_as_seen(flight, track)
    scales = m_per_unit(flight, found)
    lost: Counter[int] = Counter()
    for frame_id, node in flight.node_of.items():
        if not found.placed[node]:
            lost[int(found.begins[node])] += 1
        elif frame_id in rows:
            _fill(rows[frame_id], track[frame_id], frame, r_b_c)
            rows[frame_id].fragment_id = flight.fragment_of.get(frame_id, -1)
            rows[frame_id].m_per_unit = scales.get(int(found.begins[node]))
            if not estimator.state.amsl_known:
                rows[frame_id].alt_amsl_m = None
    why = "no map match is accepted there, and its start is unknown"
    summary = _summary(flight, found, choice, [{"frames": count, "why": why} for count in lost.values()])
    cameras = {frame_id: found.poses[node] for frame_id, node in flight.node_of.items() if found.placed[node]}
    points = flight.features.triangulated(cameras, found.lens)
    return {**summary, "points": len(points)}, points


@dataclass(frozen=True)
class PlacedCamera:
    """A camera with the covariance of its pose (6, 6), tangent order, and its calibration state."""

    pose: gtsam.Pose3
    cov: np.ndarray
    bias: np.ndarray


def solved_track(flight: FlightGraph, found: Smoothed) -> dict[int, PlacedCamera]:
    """By frame: the batch solution."""
    return {i: PlacedCamera(found.poses[n], found.covs[n], found.bias[n]) for i, n in flight.node_of.items()}


def heights_as_seen(flight: FlightGraph, track: dict[int, PlacedCamera]) -> dict[int, PlacedCamera]:
    """The covariance with what the description leaves open of the focal length: heights are as seen through it."""
    seen, camera = dict[int, PlacedCamera](), flight.origin.camera
    for frame_id, at in track.items():
        up = at.pose.rotation().matrix()[UP]
        height_m = float(at.pose.translation()[UP]) - (flight.origin.ground_amsl_m or 0.0)
        cov = at.cov.copy()
        cov[TRANSLATION, TRANSLATION] += (camera.focal_sigma * height_m) ** 2 * np.outer(up, up)
        seen[frame_id] = replace(at, cov=cov)
    return seen


def refined_track(flight: FlightGraph, estimator: Estimator) -> dict[int, PlacedCamera]:
    """By frame: the positions that the estimator refines after landing, as in estimates.csv, with its orientations."""
    map_cov = np.diag([shared_variance_m2(estimator.map_sigma_m)] * 2 + [0.0] * 4)
    placed = {}
    for frame_id, past in estimator.refine().items():
        if (node := flight.node_of.get(frame_id)) is None:
            continue
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(past.r_w_c), past.p_m)
        cov = world_to_tangent(past.cov + map_cov, past.r_w_c)
        placed[frame_id] = PlacedCamera(pose, cov, flight.recorder.nodes[node].state.calibration)
    return placed


def m_per_unit(flight: FlightGraph, found: Smoothed) -> dict[int, float]:
    """By the first node of each segment: its length in the solution over that by odometry as it was flown."""
    lengths: defaultdict[int, np.ndarray] = defaultdict(lambda: np.zeros(2))
    for i, node in enumerate(flight.recorder.nodes):
        if node.motion is not None and node.motion.rays is not None and found.placed[i]:
            solved_m = found.poses[node.parent].between(found.poses[i]).translation()
            flown = node.motion.between.translation()
            lengths[int(found.begins[i])] += np.linalg.norm([solved_m, flown], axis=1)
    return {begin: float(solved_m / flown) for begin, (solved_m, flown) in lengths.items() if flown > 0.0}


def _fill(row: FinalRow, placed: PlacedCamera, frame: LocalFrame, r_b_c: np.ndarray) -> None:
    r_w_c, p = placed.pose.rotation().matrix(), placed.pose.translation()
    cov = tangent_to_world(placed.cov, r_w_c)
    tilt = exp_so3(np.array([*placed.bias[MOUNT_TILT], 0.0]))
    row.lat_deg, row.lon_deg = frame.to_wgs84(float(p[EAST]), float(p[NORTH]))
    row.alt_amsl_m = float(p[UP])
    row.sigma_e_m, row.sigma_n_m, row.sigma_u_m = (math.sqrt(float(cov[i, i])) for i in (EAST, NORTH, UP))
    row.cov_en_m2 = float(cov[EAST, NORTH])
    row.q_w_c, row.cov = numbers(quat_from_rot(r_w_c)), numbers(cov.ravel().tolist())
    row.yaw_deg = math.degrees(yaw_of(r_w_c @ (r_b_c @ tilt).T)) % 360.0


def _summary(
    flight: FlightGraph, found: Smoothed | None, choice: Choice, not_placed: list[dict[str, Any]]
) -> dict[str, Any]:
    accepted = int(found.inliers.sum()) if found else 0
    offsets = found.map_offset_m if found else {}
    tilt_deg = np.degrees(np.median(found.bias[:, MOUNT_TILT], axis=0)) if found else None
    return {
        "frames": len(flight.node_of),
        "map_matches": {
            "believed": accepted,
            "refused": len(flight.fixes) - accepted,
            "none": dict(sorted(flight.refused.items())),
        },
        "pieces": len(set(found.begins.tolist())) if found else 0,
        "starts_believed": sum(found.start_inliers.values()) if found else 0,
        "mount_tilt_deg": None if tilt_deg is None else [round(float(v), 3) for v in tilt_deg],
        "map_offset_m": [
            {
                "map_sigma_m": round(sigma_m, 3),
                "offset_m": [round(float(v), 3) for v in offset[HORIZONTAL]],
                "sigma_m": [round(float(v), 3) for v in sigmas[HORIZONTAL]],
            }
            for sigma_m, (offset, sigmas) in offsets.items()
        ],
        "not_placed": not_placed,
        "solution": FINALISED if choice.kept else REFINED,
        "held_out": {"lens": _compared(choice.lens), "track": _compared(choice.track)},
        "before_after": _changes(flight, found, choice) if found else [],
    }


def _compared(compared: Comparison | None) -> dict[str, Any] | None:
    """As in finalised.json: the fields of ``Comparison``."""
    return (
        None
        if compared is None
        else {k: round(v, 3) if isinstance(v, float) else v for k, v in asdict(compared).items()}
    )


def _changes(flight: FlightGraph, found: Smoothed, choice: Choice) -> list[dict[str, Any]]:
    """Rows of the table as in finalised.json, fields of ``Change``."""
    camera, (k1, k1_sigma) = flight.origin.camera, flight.radial_k1
    focal_px, sigma_px = camera.fx, camera.fx * camera.focal_sigma
    if found.sees_lens:
        focal_px, sigma_px = camera.fx * np.exp(found.lens.log_focal), focal_px * found.lens_sigma.log_focal
    before_px, after_px = (
        None if xy is None else xy * px for xy, px in zip(found.map_residual, (camera.fx, focal_px), strict=True)
    )
    rows = [
        Change("focal length", "px", camera.fx, camera.fx * camera.focal_sigma, focal_px, sigma_px),
        Change("radial coefficient", "", k1, k1_sigma, found.lens.k1, found.lens_sigma.k1),
        Change("map points from the camera's pose, mean", "px", before_px, None, after_px, None),
    ]
    for what, compared in (
        ("held-out map points: estimated lens", choice.lens),
        ("held-out map points", choice.track),
    ):
        if compared is not None and compared.matches:
            rows.append(Change(f"{what}, mean", compared.unit, compared.before, None, compared.after, None))
    moved_m = found.moved_m[found.placed]
    if len(moved_m):
        rows.append(Change("positions moved, median", "m", None, None, float(np.median(moved_m)), None))
        rows.append(Change("positions moved, largest", "m", None, None, float(np.max(moved_m)), None))
    return [{k: round(v, 5) if isinstance(v, float) else v for k, v in asdict(row).items()} for row in rows]


@contextmanager
def bar(shown: bool) -> Iterator[Step]:
    """-> progress as a bar on standard error."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with LineProgress(*columns, console=Console(stderr=True), shown=shown, transient=True) as bar:
        tasks: dict[str, Any] = {}

        def step(name: str, done: int, of: int | None) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=of)
            bar.update(tasks[name], completed=done, total=of)

        yield step
