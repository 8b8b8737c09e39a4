"""Checkpoint of the link, for its successor after a restart in flight. It exists only while the autopilot is armed.

Contents: the identity of the served autopilot, the state of its EKF at our last fix (ekf_dead_reckoning.py), the zero
of its heights (pressure_height.py, core/mavlink/home_altitude.py), the map offset (map_registration.py), and the clock
of GPS_INPUT (gps_time.py).

The autopilot identifies itself once a second, by its heartbeat, but sends its attitude more often. With the checkpoint
the attitude is published from the first packet on; the estimator waits for it after a restart in flight."""

from pathlib import Path

import msgspec

from terrafix.link.autopilot.ekf_dead_reckoning import LastFix
from terrafix.link.mavlink.transport import Address
from terrafix.messages import MapOffset
from terrafix.runtime.checkpoint import CheckpointFile

# A change of the clock below this is not saved: GPS_INPUT states its time in whole milliseconds. [tuned]
CLOCK_TOLERANCE_NS = 2_000_000


class ArmedAutopilot(msgspec.Struct, frozen=True):
    """From its HEARTBEAT: system id, MAV_AUTOPILOT, MAV_TYPE."""

    sysid: int
    firmware: int
    vehicle: int


class LinkCheckpoint(msgspec.Struct, frozen=True):
    """Content of the checkpoint file, as JSON."""

    autopilot: ArmedAutopilot
    last: LastFix | None = None
    home_moved_m: float = 0.0  # see Telemetry.home_moved_m
    map_offset: MapOffset | None = None
    pressure_zero_m: float | None = None  # see PressureHeight
    peer: Address | None = None  # address of the autopilot, on a listening port
    unix_minus_monotonic_ns: int | None = None  # clock of GPS_INPUT (gps_time.LatchedClock)


def load_checkpoint(file: Path | None) -> LinkCheckpoint | None:
    """-> checkpoint of the previous link process of this flight; None if there is none."""
    return _checkpoint_file(file).load()


def _checkpoint_file(file: Path | None) -> CheckpointFile[LinkCheckpoint]:
    return CheckpointFile(file, LinkCheckpoint, "json")


class LinkCheckpointWriter:
    """Writes the checkpoint when its content changes. ``restored``: checkpoint found at the start.

    The file is deleted when the autopilot is not armed: a vehicle on the ground is at the start of its flight, and this
    must not be assumed of one that has taken off since."""

    def __init__(self, file: Path | None) -> None:
        """``file`` None: nothing is saved."""
        self._checkpoint = None if file is None else _checkpoint_file(file)
        self.restored = None if self._checkpoint is None else self._checkpoint.load()
        self._saved = self.restored

    def on_heartbeat(self, autopilot: ArmedAutopilot | None, peer: Address | None = None) -> None:
        """After every HEARTBEAT of the autopilot. ``autopilot`` None: it is not armed."""
        if autopilot is None:
            self._save(None)
        elif self._saved is None or (self._saved.autopilot, self._saved.peer) != (autopilot, peer):
            self._save(LinkCheckpoint(autopilot, peer=peer))

    def on_fix(self, last: LastFix | None, home_moved_m: float, pressure_zero_m: float | None = None) -> None:
        """After every GPS_INPUT."""
        if self._saved is not None:
            heights = {"home_moved_m": home_moved_m, "pressure_zero_m": pressure_zero_m}
            self._save(msgspec.structs.replace(self._saved, last=last, **heights))

    def on_gps_time(self, unix_minus_monotonic_ns: int | None) -> None:
        """After every GPS_INPUT, by the time that it states. Differences up to ``CLOCK_TOLERANCE_NS`` are ignored."""
        before = None if self._saved is None else self._saved.unix_minus_monotonic_ns
        if self._saved is None or unix_minus_monotonic_ns is None:
            return
        if before is None or abs(unix_minus_monotonic_ns - before) > CLOCK_TOLERANCE_NS:
            self._save(msgspec.structs.replace(self._saved, unix_minus_monotonic_ns=unix_minus_monotonic_ns))

    def on_map_offset(self, map_offset: MapOffset) -> None:
        """After every MapOffset message."""
        if self._saved is not None:
            self._save(msgspec.structs.replace(self._saved, map_offset=map_offset))

    def _save(self, checkpoint: LinkCheckpoint | None) -> None:
        if self._checkpoint is None or checkpoint == self._saved:
            return
        self._saved = checkpoint
        if checkpoint is None:
            self._checkpoint.remove()
        else:
            self._checkpoint.save(checkpoint)
