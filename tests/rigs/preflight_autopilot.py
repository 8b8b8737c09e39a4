"""An ArduPilot on the ground for the preflight's tests: it answers what it is asked, at once, over a wire in memory."""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.mavlink.transport import Address, Chunk

VERSION_4_6 = 4 << 24 | 6 << 16 | 3 << 8 | 255


class GroundAutopilot:
    """A Transport whose other side is the autopilot. Parameters: ``values``; those in ``deaf`` are never answered."""

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
        """``also``: system ids of other autopilots on the wire. ``loses``: so many answers about parameters are lost.
        ``mission``: (command, latitude, longitude, height) of items after home."""
        self.values = dict(values)
        self._mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
        self._ear = mavlink.MAVLink(None)
        self._beat = mavlink.MAVLink_heartbeat_message(kind, firmware, 128 * armed, 0, mavlink.MAV_STATE_ACTIVE, 3)
        self._also, self._read_only, self._loses, self._version = also, read_only, loses, version
        self._mission = ((16, *home, 0.0), *mission) if mission else ()
        self._coming: list[bytes] = []
        self.was_set: list[str] = []

    def read(self) -> list[Chunk]:
        coming, self._coming = self._coming, []
        return [(chunk, None) for chunk in coming]

    def close(self) -> None:
        pass

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        said = self._ear.decode(bytearray(packet))
        match said.get_type():
            case "HEARTBEAT":
                self._say(self._beat)
                for sysid in self._also:
                    other = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
                    self._coming.append(bytes(self._beat.pack(other)))
            case "PARAM_REQUEST_READ" if said.param_id in self.values:
                self._tell(said.param_id)
            case "PARAM_SET" if said.param_id in self.values:
                if said.param_id not in self._read_only:
                    self.values[said.param_id] = said.param_value
                self.was_set.append(said.param_id)
                self._tell(said.param_id)
            case "TIMESYNC" if said.tc1 == 0:
                self._say(mavlink.MAVLink_timesync_message(1, said.ts1))
            case "COMMAND_LONG" if said.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
                versions = (self._version, 0, 0, 0, bytes(8), bytes(8), bytes(8))
                self._say(mavlink.MAVLink_autopilot_version_message(0, *versions, 0, 0, 0))
            case "MISSION_REQUEST_LIST":
                self._say(mavlink.MAVLink_mission_count_message(255, 0, len(self._mission)))
            case "MISSION_REQUEST_INT":
                self._item(said.seq)
        return True

    def _item(self, number: int) -> None:
        command, lat, lon, height = self._mission[number]
        place = (round(lat * 1e7), round(lon * 1e7), height)
        frame = 3 if number else 0
        item = (255, 0, number, frame, command, int(number == 0), 1, 0.0, 0.0, 0.0, 0.0, *place)
        self._say(mavlink.MAVLink_mission_item_int_message(*item))

    def _tell(self, name: str) -> None:
        if self._loses > 0:
            self._loses -= 1
            return
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        self._say(mavlink.MAVLink_param_value_message(name.encode(), self.values[name], kind, 1, 0))

    def _say(self, message: Any) -> None:
        self._coming.append(bytes(message.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256
