"""Selection between two GPS: ArduPilot's GPS_AUTO_SWITCH and GPS_PRIMARY (AP_GPS::update_primary, as measured).

Blending (2) selects like 1 and does not average: on the firmware both switched alike.
"""

from collections.abc import Sequence

from terrafix_lab.sim.autopilot.navigation.gps import GpsInstance

USE_PRIMARY, USE_BEST, BLEND, PRIMARY_IF_3D = 0, 1, 2, 4
ONE_SATELLITE_S = 20.0  # one more satellite must persist this long to be preferred,
TWO_SATELLITES_S = 5.0  # two more this long


class ReceiverSwitch:
    """Call ``choose`` at every step; ``chosen`` is an index into the instances."""

    def __init__(self) -> None:
        self.chosen = 0
        self._last_switch_s = 0.0

    def choose(self, gps: Sequence[GpsInstance | None], mode: int, primary: int, now_s: float) -> int:
        """``gps``: None where there is no GPS of that number. Returns the index of the one in use."""
        previous = self.chosen
        present = [i for i, g in enumerate(gps) if g is not None]
        if len(present) < 2 or mode == USE_PRIMARY:
            self.chosen = primary if primary in present or not present else present[0]
        elif mode == PRIMARY_IF_3D and (first := gps[primary]) is not None and first.has_fix():
            self.chosen = primary
        else:
            self.chosen = self._best(gps, present, now_s)
        if self.chosen != previous:
            self._last_switch_s = now_s
        return self.chosen

    def _best(self, gps: Sequence[GpsInstance | None], present: list[int], now_s: float) -> int:
        """A higher fix type wins at once, more satellites after a hold time."""
        if self.chosen not in present:
            return present[0]
        current = gps[self.chosen]
        since_switch_s = now_s - self._last_switch_s
        for i in present:
            other = gps[i]
            if i == self.chosen or other is None or current is None:
                continue
            more = other.satellites - current.satellites
            if other.fix_type > current.fix_type:
                return i
            by_satellites = (more == 1 and since_switch_s >= ONE_SATELLITE_S) or (
                more >= 2 and since_switch_s >= TWO_SATELLITES_S
            )
            if other.fix_type == current.fix_type and other.has_fix() and by_satellites:
                return i
        return self.chosen
