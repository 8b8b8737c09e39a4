"""Records and flight graphs of a simulated flight with altered messages, for the tests of the post-flight smoother."""

from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np

from flight_records import write_record
from map_matches import pose_of, with_pose
from simulated_flight import PLACE, Alter, Flight, blind, t_ns, unaltered
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.messages import Frame, MapMatch, Message, Odometry, Relocalization, Verdict
from terrafix_lab.sim.true_messages import seen_from
from terrafix_tools.finalise.batch_smoother import Smoothed
from terrafix_tools.finalise.flight_graph import FlightGraph, FlightReplayer


def messages(flight: Flight, alter: Alter = unaltered) -> Iterable[Message]:
    """-> all messages of the flight, altered, with a Frame before the odometry of each frame."""
    newest_id = -1
    for message in flight.all_messages():
        frame_id = getattr(message, "frame_id", None)
        if isinstance(message, Odometry) and frame_id != newest_id:
            newest_id = message.frame_id
            yield Frame(t_ns=message.t_ns, frame_id=newest_id, file=f"{newest_id:04d}.jpg", width=960, height=540)
        if (altered := alter(message)) is not None:
            yield altered


def replayed_graph(flight: Flight, alter: Alter = unaltered, afterwards: Iterable[Message] = ()) -> FlightGraph:
    """-> graph of the replayed flight. ``afterwards``: messages that arrive after its end."""
    replayer = FlightReplayer()
    for message in (*messages(flight, alter), *afterwards):
        replayer.on(message)
    graph = replayer.flights[0]
    graph.recorder.store_estimates()
    return graph


def record(folder: Path, flight: Flight, alter: Alter = unaltered) -> Path:
    """Writes flight.mcap and truth.csv -> path of the record."""
    folder.mkdir(exist_ok=True)
    write_record(folder / "flight.mcap", list(messages(flight, alter)))
    lines = ["file,lat_deg,lon_deg"]
    for i, p_m in enumerate(flight.p_m):
        lat_deg, lon_deg = PLACE.to_wgs84(float(p_m[0]), float(p_m[1]))
        lines.append(f"{i:04d}.jpg,{lat_deg:.9f},{lon_deg:.9f}")
    (folder / "truth.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "flight.mcap"


def shifted(match: MapMatch, by_m: tuple[float, float], turn: np.ndarray | None = None) -> MapMatch:
    """-> an outlier: the match rotated by ``turn`` (3, 3) about the origin, then shifted by ``by_m`` (east, north)."""
    turn = np.eye(3) if turn is None else turn
    pose = pose_of(match)
    p = turn @ np.array(pose.p_c_in_w_m) + (*by_m, 0.0)
    return with_pose(
        match,
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
        q_w_c=quat_from_rot(turn @ rot_from_quat(pose.q_w_c)),
    )


def unmatched(match: MapMatch) -> MapMatch:
    """-> the match of the same frame with a rejection."""
    return msgspec.structs.replace(match, verdict=Verdict.FEW_INLIERS, pose=None)


def blind_between(first: int, end: int) -> Alter:
    """The frames ``first`` .. ``end`` - 1 have neither tracked features nor a map match."""

    def alter(message: Message) -> Message | None:
        inside = t_ns(first) <= message.t_ns < t_ns(end)
        if inside and isinstance(message, Odometry):
            return blind(message)
        return unmatched(message) if inside and isinstance(message, MapMatch) else message

    return alter


def errors(flight: Flight, graph: FlightGraph, smoothed: Smoothed) -> tuple[np.ndarray, np.ndarray]:
    """-> of every frame the error east and north (N, 2) [m], and its covariance (N, 2, 2)."""
    errors_m, covs = [], []
    for i in range(flight.frames):
        node = graph.node_of[i]
        r = smoothed.poses[node].rotation().matrix()[:2]
        errors_m.append((smoothed.poses[node].translation() - flight.p_m[i])[:2])
        covs.append(r @ smoothed.covs[node][3:, 3:] @ r.T)
    return np.array(errors_m), np.array(covs)


def seen_again(flight: Flight, keyframe: int, i: int, *, shown: int | None = None, fragment_id: int = 0) -> Message:
    """Frame i sees the ground of ``keyframe``; or, by mistake, that of the frame ``shown``."""
    truth = keyframe if shown is None else shown
    poses = [(flight.r_w_c[k], flight.p_m[k]) for k in (truth, i)]
    return Relocalization(
        t_ns=t_ns(i),
        frame_id=i,
        fragment_id=fragment_id,
        keyframe_id=keyframe,
        keyframe_fragment_id=0,
        **seen_from(poses[0], poses[1], np.random.default_rng([keyframe, i])),
    )
