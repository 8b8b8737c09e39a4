"""The two GPS of the simulated autopilot: of which type each is, what it last said, and which one the filter gets."""

from typing import Any

from terrafix_tools.sim.autopilot.gps import TYPE_MAV, TYPE_NONE, Fix, GpsInputDriver, GpsInstance, Receiver
from terrafix_tools.sim.autopilot.status import INFO, NOTICE, Said
from terrafix_tools.sim.autopilot.switch import Switch
from terrafix_tools.sim.interfaces import GnssFix

Heard = tuple[GpsInstance, Fix | None]  # who spoke; None: below 3D


class Receivers:
    """``take_*`` what comes, ``look`` at every step; ``texts`` are for the ground."""

    def __init__(self, parameters: dict[str, float]) -> None:
        """``parameters`` are looked at again at every step: they change in flight."""
        self._parameters = parameters
        self._switch = Switch()
        self.gps: list[GpsInstance | None] = [self._made(0), self._made(1)]

    @property
    def used(self) -> int:
        """Index of the GPS in use."""
        return self._switch.chosen

    def fix_in_use(self) -> Fix | None:
        """The last 3D fix of the GPS in use, while it has one."""
        gps = self.gps[self.used]
        return gps.fix if gps is not None and gps.has_fix() else None

    def look(self, now_s: float) -> None:
        for gps in self.gps:
            if gps is not None:
                gps.look(now_s)
        self.choose(now_s)

    def choose(self, now_s: float) -> None:
        mode, primary = int(self._parameters["GPS_AUTO_SWITCH"]), int(self._parameters["GPS_PRIMARY"])
        self._switch.choose(self.gps, mode, primary, now_s)

    def take_gnss(self, gnss: GnssFix, now_s: float) -> list[Heard]:
        """What a real receiver shows; every GPS of that type hears the same sky."""
        return [(gps, gps.take(gnss, now_s)) for gps in self.gps if isinstance(gps, Receiver)]

    def take_gps_input(self, message: Any, now_s: float) -> tuple[Heard | None, list[Said]]:
        """A decoded GPS_INPUT. None: it is for no GPS of this type."""
        gps = self.gps[message.gps_id] if message.gps_id < len(self.gps) else None
        if not isinstance(gps, GpsInputDriver):
            return None, []
        said = [(INFO, f"GPS {gps.instance + 1}: detected MAV")] if gps.gone or not gps.heard() else []
        return (gps, gps.take(message, now_s)), said

    def changed(self, parameter: str) -> list[Said]:
        """A parameter was set: a new type is another driver, at once."""
        for number in range(len(self.gps)):
            if parameter == f"GPS{number + 1}_TYPE":
                self.gps[number] = self._made(number)
                if isinstance(self.gps[number], GpsInputDriver):
                    return [(NOTICE, f"GPS {number + 1}: specified as MAV")]
        return []

    def _made(self, number: int) -> GpsInstance | None:
        kind = int(self._parameters[f"GPS{number + 1}_TYPE"])
        if kind == TYPE_NONE:
            return None
        if kind == TYPE_MAV:
            return GpsInputDriver(number, self._parameters[f"GPS{number + 1}_DELAY_MS"])
        return Receiver(number)
