"""Whether the map has confirmed the start (``Cause.START``) and the description (``Cause.DESCRIPTION``) of the flight,
from the success of correlations over new ground: Wald's SPRT of "the description is right" against "something in it
that no other monitor names is wrong, so that the matcher finds no place". Once confirmed the test ends: none of these
changes in flight."""

import math

from terrafix.core.agreement import RANGES, Agreement, Cause, Observed

# heights flown between two correlations that count: closer ones see the same ground [tuned]
REGISTRATION_SPACING_HEIGHTS = 0.25
# Position error per path length in the worst case, a heading that is off by 180 degrees.
ERROR_PER_PATH = 2.0  # [spec: geometry]


class Registration:
    """``active``: the alarm, the description is wrong."""

    def __init__(self, agreement: Agreement) -> None:
        self._agreement = agreement
        self._heights = math.inf  # flown since the last correlation that counted
        self._path_m = 0.0  # flown since the last accepted pose
        self.active = False

    @property
    def path_error_m(self) -> float:
        """Largest position error that a wrong description causes over the path since the last accepted pose."""
        return ERROR_PER_PATH * self._path_m

    def add_path(self, path_m: float, agl_m: float) -> None:
        """Path since the frame before and height above ground, both by the estimate; their ratio does not depend on
        the scale."""
        self._path_m += path_m
        self._heights += path_m / max(agl_m, 1.0)

    def add_attempt(self, *, found: bool) -> None:
        """A correlation over textured ground. ``found``: the estimator accepted a camera pose on the map."""
        if found and not self.active:
            self._path_m = 0.0
        if self._heights < REGISTRATION_SPACING_HEIGHTS:
            return
        self._heights = 0.0
        for cause in (Cause.START, Cause.DESCRIPTION):
            self._agreement.observe(Observed.POSE if found else Observed.NOTHING, cause)
        log_odds = self._agreement.log_odds[Cause.DESCRIPTION]
        self.active = log_odds >= RANGES[Cause.DESCRIPTION].most or (self.active and log_odds > 0.0)
