"""A simulated ArduPilot on the ground, as preflight sees it: it replies at once, over a transport in memory."""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.mavlink.transport import Address, Chunk

# Of the simulated vehicles, too
FIRMWARE = {  # defaults of ArduPilot 4.6
    "AHRS_OPTIONS": 0.0,  # bit 0: no fall-back to DCM in a fixed wing
    "ARMING_CHECK": 1.0,  # bit 0 all, bit 3 GPS
    "ARSPD_USE": 1.0,
    "EK3_CHECK_SCALE": 100.0,  # per cent of the limits below
    "EK3_GPS_CHECK": 31.0,  # bits: satellites, HDOP, speed accuracy, position accuracy, yaw
    "EK3_SRC1_POSXY": 3.0,  # 0 none, 3 GPS
    "EK3_SRC1_VELXY": 3.0,
    "EK3_SRC1_POSZ": 1.0,
    "EK3_SRC1_VELZ": 3.0,
    "EK3_SRC2_POSXY": 0.0,
    "EK3_SRC2_VELXY": 0.0,
    "EK3_SRC3_POSXY": 0.0,
    "EK3_SRC3_VELXY": 0.0,
    "GPS1_TYPE": 1.0,
    "GPS1_DELAY_MS": 0.0,
    "GPS2_TYPE": 0.0,
    "GPS2_DELAY_MS": 0.0,
    "GPS_AUTO_SWITCH": 1.0,  # 0 the primary alone, 1 the best, 2 blend, 4 the primary if it has a 3D fix
    "GPS_PRIMARY": 0.0,
}
# Defaults of ArduPilot 4.6 (read from its firmware in software in the loop)
GROUND_DEFAULTS = FIRMWARE | {
    "AHRS_EKF_TYPE": 3,
    "EK3_ENABLE": 1,
    "EK3_GLITCH_RAD": 25,
    "EK3_POSNE_M_NSE": 0.5,
    "EK3_POS_I_GATE": 500,
    "EK3_SRC_OPTIONS": 1,
    "EK3_SRC1_YAW": 1,
    "EK3_VELNE_M_NSE": 0.5,
    "EK3_VEL_I_GATE": 500,
    "FS_EKF_ACTION": 1,
    "FS_EKF_THRESH": 0.8,
    **{f"GPS{n}_POS_{axis}": 0 for n in (1, 2) for axis in "XYZ"},
    "GPS_HDOP_GOOD": 140,
    "SERIAL1_PROTOCOL": 2,
    "SERIAL1_BAUD": 57,
    "VISO_DELAY_MS": 10,
    "VISO_TYPE": 0,
}
VERSION_4_6 = 4 << 24 | 6 << 16 | 3 << 8 | 255


class GroundAutopilot:
    """A Transport whose other side is the autopilot. ``values``: its parameters; ``parameters_set``: names of those
    that were set."""

    def __init__(
        self,
        values: dict[str, float],
        *,
        sysid: int = 1,
        kind: int = mavlink.MAV_TYPE_FIXED_WING,
        firmware: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        version: int = VERSION_4_6,
        also: tuple[int, ...] = (),
        read_only: tuple[str, ...] = (),
        loses: int = 0,
        armed: bool = False,
        mission: tuple[tuple[int, float, float, float], ...] = (),
        home: tuple[float, float] = (48.0, 11.0),
    ) -> None:
        """``also``: system ids of other autopilots on the link. ``loses``: number of parameter replies that are lost.
        ``mission``: (command, latitude, longitude, height) of the items after home."""
        self.values = dict(values)
        self._mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
        self._parser = mavlink.MAVLink(None)
        self._heartbeat = mavlink.MAVLink_heartbeat_message(kind, firmware, 128 * armed, 0, mavlink.MAV_STATE_ACTIVE, 3)
        self._also, self._read_only, self._loses, self._version = also, read_only, loses, version
        self._mission = ((16, *home, 0.0), *mission) if mission else ()
        self._outgoing: list[bytes] = []
        self.parameters_set: list[str] = []
        self.intervals_s: dict[int, float] = {}  # of the messages that were requested, by id

    def read(self) -> list[Chunk]:
        outgoing, self._outgoing = self._outgoing, []
        return [(chunk, None) for chunk in outgoing]

    def close(self) -> None:
        pass

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        message = self._parser.decode(bytearray(packet))
        match message.get_type():
            case "HEARTBEAT":
                self.send(self._heartbeat)
                for sysid in self._also:
                    other = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
                    self._outgoing.append(bytes(self._heartbeat.pack(other)))
            case "PARAM_REQUEST_READ" if message.param_id in self.values:
                self._send_parameter(message.param_id)
            case "PARAM_SET" if message.param_id in self.values:
                if message.param_id not in self._read_only:
                    self.values[message.param_id] = message.param_value
                self.parameters_set.append(message.param_id)
                self._send_parameter(message.param_id)
            case "TIMESYNC" if message.tc1 == 0:
                self.send(mavlink.MAVLink_timesync_message(1, message.ts1))
            case "COMMAND_LONG" if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.intervals_s[int(message.param1)] = message.param2 / 1e6
                self.send(mavlink.MAVLink_command_ack_message(message.command, mavlink.MAV_RESULT_ACCEPTED))
            case "COMMAND_LONG" if message.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
                versions = (self._version, 0, 0, 0, bytes(8), bytes(8), bytes(8))
                self.send(mavlink.MAVLink_autopilot_version_message(0, *versions, 0, 0, 0))
            case "MISSION_REQUEST_LIST":
                self.send(mavlink.MAVLink_mission_count_message(255, 0, len(self._mission)))
            case "MISSION_REQUEST_INT":
                self._send_mission_item(message.seq)
        return True

    def _send_mission_item(self, number: int) -> None:
        command, lat, lon, height = self._mission[number]
        position = (round(lat * 1e7), round(lon * 1e7), height)
        frame = 3 if number else 0
        item = (255, 0, number, frame, command, int(number == 0), 1, 0.0, 0.0, 0.0, 0.0, *position)
        self.send(mavlink.MAVLink_mission_item_int_message(*item))

    def _send_parameter(self, name: str) -> None:
        if self._loses > 0:
            self._loses -= 1
            return
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        self.send(mavlink.MAVLink_param_value_message(name.encode(), self.values[name], kind, 1, 0))

    def send(self, message: Any) -> None:
        self._outgoing.append(bytes(message.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256
