"""Carries out PositionSource at the autopilot: another GPS instance, or another set of EKF sources.

Source sets choose between GPS and external navigation, not between two GPS. So what switches is what carries our
position: GPS_INPUT beside a receiver goes by GPS_PRIMARY (it works at once, in the air), ODOMETRY and its like by
MAV_CMD_SET_EKF_SOURCE_SET. Sets: 1 is GNSS, 2 is external navigation (docs/autopilot.md)."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.output.selection import LOCAL
from terrafix.messages import PositionSource

AGAIN_NS = 1_000_000_000
TIMES = 5
GNSS_SET, VISION_SET = 1, 2
ONLY_PRIMARY, PRIMARY_WHILE_3D = 0.0, 4.0  # GPS_AUTO_SWITCH
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1


class SourceSwitch:
    """``order`` what is wanted, send what ``requests`` gives, ``heard`` what the autopilot answers."""

    def __init__(self, gps_id: int) -> None:
        self._gps_id = gps_id
        self._wanted: dict[str, float] = {}  # parameters that are not yet as they should be
        self._set: int | None = None  # source set that is not yet confirmed
        self._asked_ns: int | None = None
        self._left = 0
        self.problem = ""

    def order(self, source: PositionSource, outputs: tuple[str, ...]) -> None:
        self._wanted, self._set = {}, None
        if "gps_input" in outputs:
            primary = self._gps_id if source.vision else source.receiver
            switch = ONLY_PRIMARY if source.vision else PRIMARY_WHILE_3D
            self._wanted = {"GPS_AUTO_SWITCH": switch, "GPS_PRIMARY": float(primary)}
        elif set(LOCAL) & set(outputs):
            self._set = VISION_SET if source.vision else GNSS_SET
        self._asked_ns, self._left, self.problem = None, TIMES, ""

    def requests(self, sysid: int, now_ns: int) -> Iterator[Any]:
        if not (self._wanted or self._set) or (self._asked_ns is not None and now_ns - self._asked_ns < AGAIN_NS):
            return
        if self._left == 0:
            self.problem = "the autopilot did not switch its source of position"
            self._wanted, self._set = {}, None
            return
        self._asked_ns, self._left = now_ns, self._left - 1
        for name, value in self._wanted.items():
            kind = mavlink.MAV_PARAM_TYPE_INT8
            yield mavlink.MAVLink_param_set_message(sysid, AUTOPILOT, name.encode(), value, kind)
        if self._set is not None:
            command, no = mavlink.MAV_CMD_SET_EKF_SOURCE_SET, (0.0,) * 6
            yield mavlink.MAVLink_command_long_message(sysid, AUTOPILOT, command, 0, float(self._set), *no)

    def heard(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "PARAM_VALUE" and self._wanted.get(message.param_id) == message.param_value:
            del self._wanted[message.param_id]
        elif kind == "COMMAND_ACK" and message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            self._set = None if message.result == mavlink.MAV_RESULT_ACCEPTED else self._set
