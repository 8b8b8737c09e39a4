"""Executes PositionSource at the autopilot: selects another GPS instance, or another set of EKF sources, and restores
what was selected before.

Source sets choose between GPS and external navigation, not between two GPS instances. So the mechanism follows from the
output that carries our position: for GPS_INPUT beside a receiver it is GPS_PRIMARY (it takes effect at once, also in
flight); for ODOMETRY and VISION_POSITION_ESTIMATE it is MAV_CMD_SET_EKF_SOURCE_SET. Set 1 is GNSS, set 2 is external
navigation (docs/autopilot.md).

The parameters survive a power cycle of the autopilot. So their values are read and saved on disk before they are
changed, and the file stays until the autopilot has confirmed that they are restored: the next start, or preflight,
restores them after a crash or a loss of power. With GPS_AUTO_SWITCH 4 the firmware itself returns to the receiver when
GPS_INPUT has no 3D fix (AP_GPS.cpp, update_primary)."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.gnss.previous_source import PreviousSource, PreviousSourceFile
from terrafix.link.output.selection import LOCAL_FRAME_OUTPUTS
from terrafix.messages import PositionSource

RETRY_PERIOD_NS = 1_000_000_000  # ns between attempts [tuned]
MAX_ATTEMPTS = 5  # to switch; what was changed is restored without a limit [tuned]
GNSS_SET, VISION_SET = 1, 2  # source sets as the parameters of docs/autopilot.md configure them [spec: EK3_SRCn_*]
ONLY_PRIMARY, PRIMARY_WHILE_3D = 0.0, 4.0  # [spec: ArduPilot GPS_AUTO_SWITCH]
AUTO_SWITCH, PRIMARY = "GPS_AUTO_SWITCH", "GPS_PRIMARY"
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1


class SourceSwitch:
    """``set_target`` with the wanted source, send what ``requests`` yields, ``on_message`` for the replies.
    ``problem``: text when the autopilot did not switch, or empty."""

    def __init__(self, gps_id: int, file: PreviousSourceFile | None = None) -> None:
        self._gps_id = gps_id
        self._file = file or PreviousSourceFile(None)
        self._previous = self._file.load()
        self._before: dict[str, float] | None = None  # values read so far for ``_previous``; None: not being read
        self._parameters: dict[str, float] = {}  # wanted values that the autopilot has not confirmed yet
        self._source_set: int | None = None  # wanted source set that is not confirmed yet
        self._restoring = False
        self._requested_ns: int | None = None
        self._attempts = 0
        self.problem = ""

    def set_target(self, source: PositionSource, outputs: tuple[str, ...]) -> None:
        """``outputs``: names of the outputs in use."""
        self._requested_ns, self._attempts, self.problem = None, 0, ""
        self._parameters, self._source_set, self._before = {}, None, None
        self._restoring = not source.vision
        if self._restoring:
            if self._previous is not None:
                self._parameters, self._source_set = dict(self._previous.parameters), self._previous.source_set
        elif "gps_input" in outputs:
            switch = PRIMARY_WHILE_3D if source.fallback else ONLY_PRIMARY
            self._parameters = {AUTO_SWITCH: switch, PRIMARY: float(self._gps_id)}
            self._before = {} if self._previous is None else None
        elif set(LOCAL_FRAME_OUTPUTS) & set(outputs):
            self._source_set = VISION_SET

    @property
    def switched(self) -> bool:
        """Whether something is to be restored."""
        return self._previous is not None

    @property
    def pending(self) -> bool:
        """Whether the autopilot has not confirmed the target yet."""
        return bool(self._parameters or self._source_set)

    def requests(self, sysid: int, now_ns: int) -> Iterator[Any]:
        """The packets to send now: all that is not confirmed, once in RETRY_PERIOD_NS. What another vehicle than
        ``sysid`` had before is not restored on this one."""
        waits = self._requested_ns is not None and now_ns - self._requested_ns < RETRY_PERIOD_NS
        if not self.pending or waits:
            return
        if self._previous is not None and self._previous.sysid != sysid:
            if self._restoring:
                return
            self._previous, self._before = None, {} if self._parameters else None
        if self._attempts == MAX_ATTEMPTS:
            self.problem = "the autopilot did not switch its source of position"
            if not self._restoring:
                self._parameters, self._source_set, self._before = {}, None, None
                return
        self._requested_ns, self._attempts = now_ns, self._attempts + 1
        if self._before is not None and not self._read_all(sysid):
            for name in self._parameters.keys() - self._before.keys():
                yield mavlink.MAVLink_param_request_read_message(sysid, AUTOPILOT, name.encode(), -1)
            return
        if self._source_set is not None and self._previous is None:
            self._save(PreviousSource(sysid, source_set=GNSS_SET))
        for name, value in self._parameters.items():
            kind = mavlink.MAV_PARAM_TYPE_INT8
            yield mavlink.MAVLink_param_set_message(sysid, AUTOPILOT, name.encode(), value, kind)
        if self._source_set is not None:
            command, unused = mavlink.MAV_CMD_SET_EKF_SOURCE_SET, (0.0,) * 6
            yield mavlink.MAVLink_command_long_message(sysid, AUTOPILOT, command, 0, float(self._source_set), *unused)

    def on_message(self, message: Any) -> None:
        """A message of the autopilot that is served."""
        kind = message.get_type()
        if kind == "PARAM_VALUE" and message.param_id in self._parameters:
            if self._before is not None:
                self._before[message.param_id] = message.param_value
                self._requested_ns = None  # the next packet need not wait
            elif self._parameters[message.param_id] == message.param_value:
                del self._parameters[message.param_id]
        elif kind == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            self._source_set = None if message.result == mavlink.MAV_RESULT_ACCEPTED else self._source_set
        if self._restoring and self._previous is not None and not self.pending:
            self._previous, self.problem = None, ""
            self._file.remove()

    def _read_all(self, sysid: int) -> bool:
        """Saves what the autopilot has now, when all of it was read -> whether that is so."""
        if self._before is None or self._before.keys() != self._parameters.keys():
            return False
        self._save(PreviousSource(sysid, self._before))
        self._before = None
        return True

    def _save(self, previous: PreviousSource) -> None:
        self._previous = previous
        self._file.save(previous)
