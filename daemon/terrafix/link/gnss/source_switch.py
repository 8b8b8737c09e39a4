"""Executes PositionSource at the autopilot: selects another GPS instance, or another set of EKF sources.

Source sets choose between GPS and external navigation, not between two GPS instances. So the mechanism follows from the
output that carries our position: for GPS_INPUT beside a receiver it is GPS_PRIMARY (it takes effect at once, also in
flight); for ODOMETRY and VISION_POSITION_ESTIMATE it is MAV_CMD_SET_EKF_SOURCE_SET. Set 1 is GNSS, set 2 is external
navigation (docs/autopilot.md)."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.output.selection import LOCAL_FRAME_OUTPUTS
from terrafix.messages import PositionSource

RETRY_PERIOD_NS = 1_000_000_000  # ns between attempts [tuned]
MAX_ATTEMPTS = 5  # [tuned]
GNSS_SET, VISION_SET = 1, 2  # source sets as the parameters of docs/autopilot.md configure them [spec: EK3_SRCn_*]
ONLY_PRIMARY, PRIMARY_WHILE_3D = 0.0, 4.0  # [spec: ArduPilot GPS_AUTO_SWITCH]
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1


class SourceSwitch:
    """``set_target`` with the wanted source, send what ``requests`` yields, ``on_message`` for the replies.
    ``problem``: text when the autopilot did not switch, or empty."""

    def __init__(self, gps_id: int) -> None:
        self._gps_id = gps_id
        self._parameters: dict[str, float] = {}  # wanted values that the autopilot has not confirmed yet
        self._source_set: int | None = None  # wanted source set that is not confirmed yet
        self._requested_ns: int | None = None
        self._attempts_left = 0
        self.problem = ""

    def set_target(self, source: PositionSource, outputs: tuple[str, ...]) -> None:
        """``outputs``: names of the outputs in use."""
        self._parameters, self._source_set = {}, None
        if "gps_input" in outputs:
            primary = self._gps_id if source.vision else source.receiver
            switch = ONLY_PRIMARY if source.vision else PRIMARY_WHILE_3D
            self._parameters = {"GPS_AUTO_SWITCH": switch, "GPS_PRIMARY": float(primary)}
        elif set(LOCAL_FRAME_OUTPUTS) & set(outputs):
            self._source_set = VISION_SET if source.vision else GNSS_SET
        self._requested_ns, self._attempts_left, self.problem = None, MAX_ATTEMPTS, ""

    def requests(self, sysid: int, now_ns: int) -> Iterator[Any]:
        """The packets to send now: all that is not confirmed, once in RETRY_PERIOD_NS."""
        if not (self._parameters or self._source_set) or (
            self._requested_ns is not None and now_ns - self._requested_ns < RETRY_PERIOD_NS
        ):
            return
        if self._attempts_left == 0:
            self.problem = "the autopilot did not switch its source of position"
            self._parameters, self._source_set = {}, None
            return
        self._requested_ns, self._attempts_left = now_ns, self._attempts_left - 1
        for name, value in self._parameters.items():
            kind = mavlink.MAV_PARAM_TYPE_INT8
            yield mavlink.MAVLink_param_set_message(sysid, AUTOPILOT, name.encode(), value, kind)
        if self._source_set is not None:
            command, unused = mavlink.MAV_CMD_SET_EKF_SOURCE_SET, (0.0,) * 6
            yield mavlink.MAVLink_command_long_message(sysid, AUTOPILOT, command, 0, float(self._source_set), *unused)

    def on_message(self, message: Any) -> None:
        """A message of the autopilot that is served."""
        kind = message.get_type()
        if kind == "PARAM_VALUE" and self._parameters.get(message.param_id) == message.param_value:
            del self._parameters[message.param_id]
        elif kind == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            self._source_set = None if message.result == mavlink.MAV_RESULT_ACCEPTED else self._source_set
