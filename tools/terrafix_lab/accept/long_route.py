"""A long route from a short flight."""

from collections.abc import Iterable, Iterator

import msgspec

from terrafix.messages import VehicleState
from terrafix.vision.sources import Shot, Source
from terrafix.vision.sources.contract import WrappedSource
from terrafix_lab.accept.flight import FrameRef

LAP_MARK = "@"  # "0001.jpg@2": the same picture flown over again


class ThereAndBack(WrappedSource):
    """The flight forwards and backwards in turn: a long route from a short one. Implements Source."""

    def __init__(self, source: Source, frame_refs: list[FrameRef], frames: int) -> None:
        """``stops``: every frame of ``source``. ``frames``: of the long flight."""
        super().__init__(source)
        self._frame_refs, self._frames = frame_refs, frames

    def length(self) -> int | None:
        return self._frames

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        first_s, last_s = self._frame_refs[0].t_s, self._frame_refs[-1].t_s
        for number in range(self._frames):
            lap, index = divmod(number, len(self._frame_refs) - 1)
            ref = self._frame_refs[-1 - index if lap % 2 else index]
            t_s = lap * (last_s - first_s) + (last_s - ref.t_s if lap % 2 else ref.t_s - first_s)
            if t_s < from_s:
                continue
            shot = next(self._source.shots(from_s=ref.t_s))
            file = shot.frame.file + (f"{LAP_MARK}{lap + 1}" if lap else "")
            frame = msgspec.structs.replace(shot.frame, frame_id=number, file=file, t_ns=round(t_s * 1e9))
            states = () if ref.state is None else (_moved(ref.state, frame.t_ns, bool(lap % 2)),)
            yield Shot(frame, states, shot.image)


def _moved(state: VehicleState, t_ns: int, backwards: bool) -> VehicleState:
    velocity = state.velocity_enu_mps
    if velocity is not None and backwards:
        velocity = (-velocity[0], -velocity[1], -velocity[2])
    return msgspec.structs.replace(state, t_ns=t_ns, velocity_enu_mps=velocity)


def original(files: Iterable[str]) -> list[str]:
    """File names without the lap mark, as in the truth of the flight."""
    return [file.split(LAP_MARK)[0] for file in files]
