"""Where an edit is applied: to a whole source, and one shot at a time in a flight that is being simulated."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import msgspec

from terrafix.messages import Frame, GimbalAttitude, Origin, VehicleState
from terrafix.vision.sources import Shot, Source
from terrafix.vision.sources.contract import WrappedSource
from terrafix_lab.faults.edits import Edit, OriginEdit, unchanged, unchanged_origin
from terrafix_lab.sim.interfaces import Readings, Sensors, State

ANGLES = ("yaw_rad", "pitch_rad", "roll_rad")


class AlteredSource(WrappedSource):
    """A Source that wraps and edits another one, and renumbers its frames."""

    def __init__(
        self,
        source: Source,
        edit: Edit = unchanged,
        *,
        frames: int | None = None,
        origin: OriginEdit = unchanged_origin,
    ) -> None:
        """``frames``: limit of the frames of ``source``. ``origin``: edits start and camera."""
        super().__init__(source)
        self._edit, self._frames, self._origin = edit, frames, origin

    def origin(self) -> Origin:
        return self._origin(self._source.origin())

    def length(self) -> int | None:
        """Approximate: an edit may add or remove frames."""
        length = self._source.length()
        return length if self._frames is None or length is None else min(length, self._frames)

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        for number, shot in enumerate(self._edit(islice(self._source.shots(), self._frames))):
            if shot.frame.t_ns >= round(from_s * 1e9):
                yield replace(shot, frame=msgspec.structs.replace(shot.frame, frame_id=number))


class Stepwise:
    """Applies ``edit``, which must give one shot for each shot, to one shot at a time."""

    def __init__(self, edit: Edit) -> None:
        self._given: deque[Shot] = deque()
        self._edited = edit(self._shots())

    def __call__(self, shot: Shot) -> Shot:
        self._given.append(shot)
        return next(self._edited)

    def _shots(self) -> Iterator[Shot]:
        while True:
            yield self._given.popleft()


class EditedSensors:
    """Sensors whose attitude, heading, height and gimbal pass through an edit of telemetry, as those of an autopilot
    with the fault."""

    def __init__(self, sensors: Sensors) -> None:
        self._sensors = sensors
        self._stepwise: Stepwise | None = None
        self._newest: VehicleState | None = None
        self._zero_s = 0.0

    def alter(self, edit: Edit, zero_s: float = 0.0) -> None:
        """From now on, with one shot for each. ``zero_s``: of the readings' time in the times of ``edit``."""
        self._stepwise, self._zero_s = None if edit is unchanged else Stepwise(edit), zero_s
        self._newest = None

    def read(self, state: State) -> Readings:
        true, stepwise = self._sensors.read(state), self._stepwise
        if stepwise is None:
            return true
        t_ns = round(1e9 * (self._zero_s + true.t_s))
        reported = VehicleState(
            t_ns=t_ns,
            source="",
            yaw_rad=true.yaw_rad,
            pitch_rad=true.pitch_rad,
            roll_rad=true.roll_rad,
            agl_m=state.agl_m,
        )
        held = () if true.gimbal is None else (GimbalAttitude(t_ns=t_ns, q=true.gimbal, from_north=True),)
        frame = Frame(t_ns=t_ns, frame_id=0, file="", width=0, height=0)
        shot = stepwise(Shot(frame, (reported,), None, others=held))
        true = replace(true, gimbal=next((m.q for m in shot.others if isinstance(m, GimbalAttitude)), None))
        self._newest = shot.states[-1] if shot.states else self._newest
        if self._newest is None:
            return true
        known = {name: value for name in ANGLES if (value := getattr(self._newest, name)) is not None}
        agl_m = state.agl_m if self._newest.agl_m is None else self._newest.agl_m
        return replace(true, baro_amsl_m=true.baro_amsl_m + agl_m - state.agl_m, **known)
