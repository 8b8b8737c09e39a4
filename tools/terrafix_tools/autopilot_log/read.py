"""Reads an autopilot's own log of any known format; the format is recognised by content."""

from pathlib import Path

from terrafix.core.autopilot_log.dataflash import is_dataflash
from terrafix.core.errors import SourceError
from terrafix.core.mavlink.tlog import is_tlog
from terrafix_tools.autopilot_log.structure import AutopilotLog

_HEAD_BYTES = 256 * 1024  # in which a record is searched: a log may begin with lost or foreign bytes
_ULOG_MAGIC = b"ULog"
SUFFIXES = (".bin", ".log", ".tlog", ".ulg")


def read_autopilot_log(path: Path, system_id: int = 0) -> AutopilotLog:
    """``system_id``: the vehicle of a telemetry log with several; 0: the only one that moves. Raises SourceError: no
    such file, empty, no log of an autopilot, or one without attitude."""
    head = _head(path)
    if not head:
        raise SourceError(f"{path}: is empty; copy the log from the autopilot again")
    if is_dataflash(head):
        from terrafix_tools.autopilot_log.ardupilot import read_ardupilot

        return read_ardupilot(path)
    if head.startswith(_ULOG_MAGIC):
        from terrafix_tools.autopilot_log.px4 import read_px4

        return read_px4(path)
    if is_tlog(head) or path.suffix.lower() == ".tlog":  # a telemetry log may begin with a damaged record
        from terrafix_tools.autopilot_log.telemetry import read_telemetry

        return read_telemetry(path, system_id)
    if path.suffix.lower() in (".bin", ".log") and is_dataflash(path.read_bytes()):  # more than the head is lost
        from terrafix_tools.autopilot_log.ardupilot import read_ardupilot

        return read_ardupilot(path)
    raise SourceError(
        f"{path}: is no log of an autopilot; give ArduPilot's .bin or .log, a .tlog of a ground station, or PX4's .ulg"
    )


def is_autopilot_log(path: Path) -> bool:
    """Whether a file is one by its content, or says so by its suffix."""
    if not path.is_file():
        return False
    head = _head(path)
    known = is_dataflash(head) or head.startswith(_ULOG_MAGIC) or is_tlog(head)
    return known or path.suffix.lower() in SUFFIXES


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(_HEAD_BYTES)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
