"""Height above take-off from the height above home, which a ground station can move in flight.

An autopilot reports its height above home (GLOBAL_POSITION_INT.relative_alt, ALTITUDE.altitude_relative). Home is the
place where it was armed, until a ground station moves it (MAV_CMD_DO_SET_HOME), for example to a boat or to a walking
pilot. The height above home then jumps although the vehicle has not moved. The height above mean sea level in the same
message does not jump."""

import math

# Metres. Smaller differences are rounding, or filter states sampled at slightly different times.
MIN_HOME_MOVE_M = 1.0


class TakeOffHeight:
    """Call ``update`` with every height that the autopilot reports. ``home_rise_m``: rise of home since take-off."""

    def __init__(self, home_rise_m: float = 0.0) -> None:
        self.home_rise_m = home_rise_m
        self._last: tuple[float, float] | None = None

    def update(self, relative_m: float, amsl_m: float, armed: bool | None) -> float:
        """``relative_m``: height above home; ``amsl_m``: height above mean sea level, not finite if unknown.

        Returns the height above take-off [m]. Before arming, the autopilot itself moves home to its position, so that
        the rise is reset."""
        last, self._last = self._last, (relative_m, amsl_m)
        if armed is False:
            self.home_rise_m = 0.0
        elif last is not None and math.isfinite(amsl_m) and math.isfinite(last[1]):
            amsl_change_m, relative_change_m = amsl_m - last[1], relative_m - last[0]
            # In the opposite case the filter has corrected its height above sea level, and home has not moved.
            if abs(relative_change_m - amsl_change_m) > MIN_HOME_MOVE_M and abs(amsl_change_m) < abs(relative_change_m):
                self.home_rise_m += amsl_change_m - relative_change_m
        return relative_m + self.home_rise_m
