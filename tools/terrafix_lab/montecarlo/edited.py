"""A flight of the run with a fault of the table (terrafix_lab/faults): the edits of its source, applied to messages."""

from dataclasses import replace

import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.messages import Frame, GimbalAttitude, Imu, VehicleState
from terrafix.vision.sources import Shot as SourceShot
from terrafix_lab.faults.fault import Fault
from terrafix_lab.montecarlo.flown import Shot, SimulatedFlight


def edited(flown: SimulatedFlight, fault: Fault) -> SimulatedFlight:
    """``flown`` with the fault at its usual time. The truth of a frame is that of its time stamp."""
    times_s = np.array([shot.t_s for shot in flown.frames])
    span = fault.span(float(times_s[0]), float(times_s[-1]))
    found = list(fault.edit(span)(iter([_given(flown, i) for i in range(len(times_s))])))
    known = {round(1e9 * shot.t_s): shot for shot in flown.frames}
    frames = [known.get(shot.frame.t_ns) or flown.at(shot.frame.t_ns / 1e9) for shot in found]
    pictures = [_picture(shot, true) for shot, true in zip(found, frames, strict=True)]
    telemetry = [sorted((*shot.states, *shot.imu, *shot.others), key=lambda message: message.t_ns) for shot in found]
    if fault.source is not None:  # of a stream
        telemetry[0] = [msgspec.structs.replace(found[0].frame, buffered=True), *telemetry[0]]
    changed = replace(
        flown,
        frames=frames,
        pictures=pictures,
        telemetry=telemetry,
        path_m=np.interp([shot.t_s for shot in frames], times_s, flown.path_m),
        lie=None if fault.is_true else span,
    )
    return changed if fault.origin is None else _with_origin(changed, fault)


def _given(flown: SimulatedFlight, i: int) -> SourceShot:
    picture, camera = flown.pictures[i], flown.origin.camera
    frame = Frame(t_ns=round(1e9 * picture.t_s), frame_id=i, file=str(i), width=camera.width, height=camera.height)
    states = tuple(message for message in flown.telemetry[i] if isinstance(message, VehicleState))
    imu = tuple(message for message in flown.telemetry[i] if isinstance(message, Imu))
    held = tuple(message for message in flown.telemetry[i] if isinstance(message, GimbalAttitude))
    return SourceShot(frame, states, picture, imu, held)  # type: ignore[arg-type]  # a Sight instead of pixels


def _picture(shot: SourceShot, true: Shot) -> Shot:
    seen = shot.image
    return replace(seen, t_s=true.t_s) if isinstance(seen, Shot) else true.darkened()


def _with_origin(flown: SimulatedFlight, fault: Fault) -> SimulatedFlight:
    """The world is seen from the stated start."""
    assert fault.origin is not None
    stated = fault.origin(flown.origin)
    moved_m = np.array(LocalFrame(flown.origin.lat_deg, flown.origin.lon_deg).to_local(stated.lat_deg, stated.lon_deg))

    def seen(shot: Shot) -> Shot:
        return replace(shot, p_m=shot.p_m - np.array([*moved_m, 0.0]))

    return replace(
        flown,
        origin=msgspec.structs.replace(stated, lat_deg=flown.origin.lat_deg, lon_deg=flown.origin.lon_deg),
        frames=[seen(shot) for shot in flown.frames],
        pictures=[seen(shot) for shot in flown.pictures],
        terrain=flown.terrain.seen_from(moved_m),
    )
