"""A simulated flight as a record, with what may go wrong in it, for the tests of what is done after landing."""

from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import numpy as np

from flight_records import write_record
from simulated_flight import PLACE, Flight, blind, t_ns
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.messages import Frame, MapMatch, Message, Odometry, Verdict
from terrafix_tools.finalise.batch_smoother import Smoothed
from terrafix_tools.finalise.flight_graph import FlightGraph, FlightReplayer

Alter = Callable[[Message], Message | None]


def as_it_is(message: Message) -> Message | None:
    return message


def messages(flight: Flight, alter: Alter = as_it_is) -> Iterable[Message]:
    """With frames, and as ``alter`` leaves them; None leaves one out."""
    framed = -1
    for message in flight.all_messages():
        frame_id = getattr(message, "frame_id", None)
        if isinstance(message, Odometry) and frame_id != framed:
            framed = message.frame_id
            yield Frame(t_ns=message.t_ns, frame_id=framed, file=f"{framed:04d}.jpg", width=960, height=540)
        if (altered := alter(message)) is not None:
            yield altered


def told(flight: Flight, alter: Alter = as_it_is, afterwards: Iterable[Message] = ()) -> FlightGraph:
    """``afterwards``: heard when the flight is over."""
    storyteller = FlightReplayer()
    for message in (*messages(flight, alter), *afterwards):
        storyteller.on(message)
    retold = storyteller.flights[0]
    retold.graph.remember()
    return retold


def record(folder: Path, flight: Flight, alter: Alter = as_it_is) -> Path:
    """-> the record file."""
    folder.mkdir(exist_ok=True)
    write_record(folder / "flight.mcap", list(messages(flight, alter)))
    lines = ["file,lat_deg,lon_deg"]
    for i, p_m in enumerate(flight.p_m):
        lat_deg, lon_deg = PLACE.to_wgs84(float(p_m[0]), float(p_m[1]))
        lines.append(f"{i:04d}.jpg,{lat_deg:.9f},{lon_deg:.9f}")
    (folder / "truth.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "flight.mcap"


def shifted(match: MapMatch, by_m: tuple[float, float], turn: np.ndarray | None = None) -> MapMatch:
    """A match that saw another place: turned by ``turn`` (3, 3) about the origin, then moved."""
    turn = np.eye(3) if turn is None else turn
    assert match.p_c_in_w_m is not None and match.q_w_c is not None
    p = turn @ np.array(match.p_c_in_w_m) + (*by_m, 0.0)
    return msgspec.structs.replace(
        match,
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
        q_w_c=quat_from_rot(turn @ rot_from_quat(match.q_w_c)),
    )


def unmatched(match: MapMatch) -> MapMatch:
    return msgspec.structs.replace(match, verdict=Verdict.WEAK_PEAK, p_c_in_w_m=None, q_w_c=None, cov=None)


def blind_between(first: int, end: int) -> Alter:
    """Nothing is seen from frame ``first`` to before ``end``."""

    def alter(message: Message) -> Message | None:
        inside = t_ns(first) <= message.t_ns < t_ns(end)
        if inside and isinstance(message, Odometry):
            return blind(message)
        return unmatched(message) if inside and isinstance(message, MapMatch) else message

    return alter


def errors(flight: Flight, retold: FlightGraph, found: Smoothed) -> tuple[np.ndarray, np.ndarray]:
    """Of every frame: east and north from truth (N, 2), and the covariance that is claimed (N, 2, 2)."""
    off, covs = [], []
    for i in range(flight.frames):
        node = retold.node_of[i]
        r = found.poses[node].rotation().matrix()[:2]
        off.append((found.poses[node].translation() - flight.p_m[i])[:2])
        covs.append(r @ found.covs[node][3:, 3:] @ r.T)
    return np.array(off), np.array(covs)


def nees(off: np.ndarray, covs: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", off, np.linalg.solve(covs, off[..., None])[..., 0])
