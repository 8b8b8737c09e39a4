"""Height above take-off, from one above a home that a pilot may move in flight.

An autopilot tells its height above home (GLOBAL_POSITION_INT.relative_alt, ALTITUDE.altitude_relative), which is where
it was armed, until a ground station moves it (MAV_CMD_DO_SET_HOME): to a boat, to the pilot who walks along. Then that
height jumps, and the vehicle has not moved. Its height above the sea, in the same message, does not jump."""

import math

JUMPED_M = 1.0  # rounding, and a filter that speaks of both a moment apart, are below


class TakeOffHeight:
    """``above`` with every height that the autopilot tells. ``moved_m``: by how much home has risen since take-off."""

    def __init__(self, moved_m: float = 0.0) -> None:
        self.moved_m = moved_m
        self._last: tuple[float, float] | None = None

    def above(self, relative_m: float, amsl_m: float, armed: bool | None) -> float:
        """``relative_m`` above home. Before it is armed an autopilot moves home by itself, to where it stands.
        ``amsl_m`` not finite: it does not tell."""
        last, self._last = self._last, (relative_m, amsl_m)
        if armed is False:
            self.moved_m = 0.0
        elif last is not None and math.isfinite(amsl_m) and math.isfinite(last[1]):
            rose_m, said_m = amsl_m - last[1], relative_m - last[0]
            # The other way round, the filter has got its height above the sea from somebody, and home is where it was.
            if abs(said_m - rose_m) > JUMPED_M and abs(rose_m) < abs(said_m):
                self.moved_m += rose_m - said_m
        return relative_m + self.moved_m
