"""What a link leaves to the one that is started in its place: which autopilot it served, while that was armed, where
its filter was with our last fix (ekf_dead_reckoning.py), where its heights begin (pressure_height.py,
core/mavlink/home_altitude.py), how far off the map is (map_registration.py), and by which time GPS_INPUT goes
(gps_time.py).

An autopilot says who it is once a second, and its attitude long before. Who knows it already can say where it leans
with the first packet, which is what the estimator waits for after a restart in flight."""

from pathlib import Path

import msgspec

from terrafix.link.autopilot.ekf_dead_reckoning import LastFix
from terrafix.link.mavlink.transport import Address
from terrafix.messages import MapOffset
from terrafix.runtime.run_dir import load, save

SAME_TIME_NS = 2_000_000


class ArmedAutopilot(msgspec.Struct, frozen=True):
    """Of its HEARTBEAT: system id, MAV_AUTOPILOT, MAV_TYPE."""

    sysid: int
    firmware: int
    vehicle: int


class LinkCheckpoint(msgspec.Struct, frozen=True):
    autopilot: ArmedAutopilot
    last: LastFix | None = None
    home_moved_m: float = 0.0
    map_offset: MapOffset | None = None
    pressure_zero_m: float | None = None  # where it took off (pressure_height.PressureHeight)
    peer: Address | None = None  # where it speaks from, on a listening port
    unix_minus_monotonic_ns: int | None = None  # by which GPS_INPUT states the time (gps_time.LatchedClock)


def load_checkpoint(file: Path | None) -> LinkCheckpoint | None:
    """What the link before this one left; None: there was none in this flight."""
    return load(file, msgspec.json.Decoder(LinkCheckpoint).decode)


class CheckpointWriter:
    """``heard`` after every HEARTBEAT of the autopilot, ``flies`` and ``timed`` after each fix, ``learnt`` with each
    MapOffset.

    One that is not armed is not kept: a vehicle on the ground stands where its flight begins, and nobody may believe
    that of one that has taken off meanwhile."""

    def __init__(self, file: Path | None) -> None:
        """``file`` None: nothing is kept."""
        self._file = file
        self.found = load_checkpoint(file)
        self._kept = self.found

    def heard(self, autopilot: ArmedAutopilot | None, peer: Address | None = None) -> None:
        """None: it is not armed."""
        if autopilot is None:
            self._keep(None)
        elif self._kept is None or (self._kept.autopilot, self._kept.peer) != (autopilot, peer):
            self._keep(LinkCheckpoint(autopilot, peer=peer))

    def flies(self, last: LastFix | None, home_moved_m: float, pressure_zero_m: float | None = None) -> None:
        if self._kept is not None:
            heights = {"home_moved_m": home_moved_m, "pressure_zero_m": pressure_zero_m}
            self._keep(msgspec.structs.replace(self._kept, last=last, **heights))

    def timed(self, unix_minus_monotonic_ns: int | None) -> None:
        """With each GPS_INPUT, to the millisecond that it states: what differs by less is the same."""
        before = None if self._kept is None else self._kept.unix_minus_monotonic_ns
        if self._kept is None or unix_minus_monotonic_ns is None:
            return
        if before is None or abs(unix_minus_monotonic_ns - before) > SAME_TIME_NS:
            self._keep(msgspec.structs.replace(self._kept, unix_minus_monotonic_ns=unix_minus_monotonic_ns))

    def learnt(self, map_offset: MapOffset) -> None:
        if self._kept is not None:
            self._keep(msgspec.structs.replace(self._kept, map_offset=map_offset))

    def _keep(self, kept: LinkCheckpoint | None) -> None:
        if self._file is None or kept == self._kept:
            return
        self._kept = kept
        if kept is None:
            self._file.unlink(missing_ok=True)
        else:
            save(self._file, msgspec.json.encode(kept))
