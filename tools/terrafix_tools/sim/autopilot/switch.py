"""Which of two GPS the filter gets: ArduPilot's GPS_AUTO_SWITCH and GPS_PRIMARY (AP_GPS::update_primary, as measured).

Blending (2) chooses like 1 but does not average: on the firmware both switched alike."""

from collections.abc import Sequence

from terrafix_tools.sim.autopilot.gps import GpsInstance

USE_PRIMARY, USE_BEST, BLEND, PRIMARY_IF_3D = 0, 1, 2, 4
ONE_SATELLITE_S = 20.0  # a satellite more must hold this long to be preferred,
TWO_SATELLITES_S = 5.0  # two more this long


class Switch:
    """``choose`` at every step; the choice is an index into the instances."""

    def __init__(self) -> None:
        self.chosen = 0
        self._last_switch_s = 0.0

    def choose(self, gps: Sequence[GpsInstance | None], mode: int, primary: int, now_s: float) -> int:
        """``gps``: None where there is no GPS of that number. -> the one in use."""
        before = self.chosen
        there = [i for i, g in enumerate(gps) if g is not None]
        if len(there) < 2 or mode == USE_PRIMARY:
            self.chosen = primary if primary in there or not there else there[0]
        elif mode == PRIMARY_IF_3D and (first := gps[primary]) is not None and first.has_fix():
            self.chosen = primary
        else:
            self.chosen = self._best(gps, there, now_s)
        if self.chosen != before:
            self._last_switch_s = now_s
        return self.chosen

    def _best(self, gps: Sequence[GpsInstance | None], there: list[int], now_s: float) -> int:
        """A higher fix wins at once, satellites after a while."""
        if self.chosen not in there:
            return there[0]
        current = gps[self.chosen]
        held_s = now_s - self._last_switch_s
        for i in there:
            other = gps[i]
            if i == self.chosen or other is None or current is None:
                continue
            more = other.satellites - current.satellites
            if other.fix_type > current.fix_type:
                return i
            by_satellites = (more == 1 and held_s >= ONE_SATELLITE_S) or (more >= 2 and held_s >= TWO_SATELLITES_S)
            if other.fix_type == current.fix_type and other.has_fix() and by_satellites:
                return i
        return self.chosen
