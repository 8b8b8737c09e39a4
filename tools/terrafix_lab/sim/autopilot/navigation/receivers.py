"""The two GPS instances of the simulated autopilot: driver type, last report, and selection for the filter."""

from typing import Any

from terrafix_lab.sim.autopilot.navigation.gps import TYPE_MAV, TYPE_NONE, Fix, GpsInputDriver, GpsInstance, Receiver
from terrafix_lab.sim.autopilot.navigation.status import INFO, NOTICE, StatusMessage
from terrafix_lab.sim.autopilot.navigation.switch import ReceiverSwitch
from terrafix_lab.sim.interfaces import GnssFix

InstanceFix = tuple[GpsInstance, Fix | None]  # instance and its fix; None: below 3D


class Receivers:
    """Call ``on_*`` for reports and ``update`` at every step; returned texts are sent to the ground station."""

    def __init__(self, parameters: dict[str, float]) -> None:
        """``parameters`` are read at every step, since they may change in flight."""
        self._parameters = parameters
        self._switch = ReceiverSwitch()
        self.gps: list[GpsInstance | None] = [self._create(0), self._create(1)]

    @property
    def used(self) -> int:
        """Index of the GPS in use."""
        return self._switch.chosen

    def fix_in_use(self) -> Fix | None:
        """Returns the last 3D fix of the GPS in use, if it has one."""
        gps = self.gps[self.used]
        return gps.fix if gps is not None and gps.has_fix() else None

    def update(self, now_s: float) -> None:
        for gps in self.gps:
            if gps is not None:
                gps.check_timeout(now_s)
        self.choose(now_s)

    def choose(self, now_s: float) -> None:
        mode, primary = int(self._parameters["GPS_AUTO_SWITCH"]), int(self._parameters["GPS_PRIMARY"])
        self._switch.choose(self.gps, mode, primary, now_s)

    def on_gnss(self, gnss: GnssFix, now_s: float) -> list[InstanceFix]:
        """Processes the reading of the real receiver, for every GPS of that type."""
        return [(gps, gps.on_report(gnss, now_s)) for gps in self.gps if isinstance(gps, Receiver)]

    def on_gps_input(self, message: Any, now_s: float) -> tuple[InstanceFix | None, list[StatusMessage]]:
        """Processes a decoded GPS_INPUT. None: no GPS of this type has its gps_id."""
        gps = self.gps[message.gps_id] if message.gps_id < len(self.gps) else None
        if not isinstance(gps, GpsInputDriver):
            return None, []
        texts = [(INFO, f"GPS {gps.instance + 1}: detected MAV")] if gps.timed_out or not gps.has_reported() else []
        return (gps, gps.on_report(message, now_s)), texts

    def on_parameter_change(self, parameter: str) -> list[StatusMessage]:
        """Handles a changed parameter: a new GPS type creates another driver."""
        for number in range(len(self.gps)):
            if parameter == f"GPS{number + 1}_TYPE":
                self.gps[number] = self._create(number)
                if isinstance(self.gps[number], GpsInputDriver):
                    return [(NOTICE, f"GPS {number + 1}: specified as MAV")]
        return []

    def _create(self, number: int) -> GpsInstance | None:
        kind = int(self._parameters[f"GPS{number + 1}_TYPE"])
        if kind == TYPE_NONE:
            return None
        if kind == TYPE_MAV:
            return GpsInputDriver(number, self._parameters[f"GPS{number + 1}_DELAY_MS"])
        return Receiver(number)
