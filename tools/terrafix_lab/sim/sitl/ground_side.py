"""Ground station of a SITL flight: MAVSDK uploads the mission, arms and starts it.

MAVSDK 4 has no server process; it is a library, used here through its blocking interface.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mavsdk
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action
from mavsdk.plugins.mission_raw import MissionItem, MissionRaw
from mavsdk.plugins.param import Param

from terrafix.core.errors import LinkError
from terrafix_tools.mission.file import COMMANDS
from terrafix_tools.mission.items import AltitudeFrame, Do, Mission

DISCOVERY_TIMEOUT_S = 60.0  # time-out: the firmware boots in a few seconds, longer on a loaded machine
# MISSION_ITEM_INT frames (MAVLink common.xml, MAV_FRAME)
FRAMES = {AltitudeFrame.SEA: 0, AltitudeFrame.HOME: 3, AltitudeFrame.GROUND: 10}
TAKE_OFF_PITCH_DEG = 12.0  # least pitch of a plane until the height is reached; a copter ignores it


class GroundSide:
    """Connection to one autopilot. Raises LinkError when a command fails."""

    def __init__(self, system: Any) -> None:
        self._action, self._mission, self._param = Action(system), MissionRaw(system), Param(system)

    def upload(self, mission: Mission) -> None:
        self._try("upload the mission", lambda: self._mission.upload_mission(items(mission)))

    def start_mission(self) -> None:
        """Switches to the mode that flies the mission; on the ground the vehicle waits to be armed."""
        self._try("switch to the mission", self._mission.start_mission)

    def arm(self) -> None:
        self._try("arm", self._action.arm)

    def set_parameter(self, name: str, value: float) -> None:
        """As the parameter's type requires: an integer for an ``int``."""
        if isinstance(value, int):
            self._try(f"set {name}", lambda: self._param.set_param_int(name, value))
        else:
            self._try(f"set {name}", lambda: self._param.set_param_float(name, value))

    def parameter(self, name: str) -> int:
        """Value of an integer parameter."""
        return int(self._try(f"report {name}", lambda: self._param.get_param_int(name)))

    @staticmethod
    def _try(what: str, call: Any) -> Any:
        try:
            return call()
        except MavsdkError as error:
            raise LinkError(f"the autopilot did not {what}: {error}") from None


@contextmanager
def connected(port: int) -> Iterator[GroundSide]:
    """Connects to the autopilot that sends to UDP ``port`` of this machine. Raises LinkError: port taken, or no
    autopilot.
    """
    mavsdk.log_subscribe(lambda *_: True)  # suppresses MAVSDK's output on the console
    configuration = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    with mavsdk.Mavsdk(configuration) as station:
        result = station.add_any_connection(f"udpin://127.0.0.1:{port}")
        if result != mavsdk.ConnectionResult.SUCCESS:
            raise LinkError(f"UDP port {port} cannot be listened on ({result.name}); choose another --port")
        system = station.first_autopilot(DISCOVERY_TIMEOUT_S)
        if system is None:
            raise LinkError(f"no autopilot sent to UDP port {port} within {DISCOVERY_TIMEOUT_S:.0f} s")
        yield GroundSide(system)


def items(mission: Mission) -> list[MissionItem]:
    """Converts to MISSION_ITEM_INT; item 0 is home, which ArduPilot replaces by its own."""
    numbers = {do: number for number, do in COMMANDS.items()}
    home = MissionItem(
        seq=0,
        command=numbers[Do.WAYPOINT],
        autocontinue=1,
        x=round(mission.home_lat_deg * 1e7),
        y=round(mission.home_lon_deg * 1e7),
    )
    mission_items = [home]
    for item in mission.items:
        params = (item.amount, 0.0, item.radius_m)
        if item.do is Do.SPEED:
            params = (1.0, item.amount, -1.0)  # ground speed, m/s, throttle unchanged
        elif item.do is Do.TAKE_OFF:
            params = (TAKE_OFF_PITCH_DEG, 0.0, 0.0)
        mission_items.append(
            MissionItem(
                seq=len(mission_items),
                frame=FRAMES[item.altitude_frame],
                command=numbers[item.do],
                current=int(len(mission_items) == 1),
                autocontinue=1,
                param1=params[0],
                param2=params[1],
                param3=params[2],
                x=round((item.lat_deg or 0.0) * 1e7),
                y=round((item.lon_deg or 0.0) * 1e7),
                z=item.height_m or 0.0,
            )
        )
    return mission_items
