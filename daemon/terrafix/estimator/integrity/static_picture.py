"""A picture that does not move: a vehicle that stands, or a frozen camera."""

import math

from terrafix.estimator.measurements.telemetry_buffer import Attitude

ATTITUDE_MOVED_RAD = math.radians(1.0)  # beyond what an attitude filter of a vehicle at rest wanders in a minute
# No multirotor in the air keeps its attitude to 0.006 degrees, what a static picture claims, for so long.
AT_REST_S = 3.0


class StaticPicture:
    """Whether pictures that show the same view as the one before are taken for a vehicle that hovers."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._attitude: Attitude | None = None  # when it began
        self._frozen = False

    def is_frozen(self, t_s: float, attitude: Attitude, *, static: bool, moves: bool) -> bool:
        """``static``: the frame at ``t_s`` shows the view of the frame before. ``moves``: by velocity or inertial
        readings the vehicle cannot stand. A camera that was found frozen is until the view changes."""
        if not static or attitude.stands:
            self._since_s, self._attitude, self._frozen = None, None, False
            return False
        if self._since_s is None or self._attitude is None:
            self._since_s, self._attitude = t_s, attitude
        turned = _tilt_apart_rad(self._attitude, attitude) > ATTITUDE_MOVED_RAD
        self._frozen = self._frozen or moves or turned or t_s - self._since_s >= AT_REST_S
        return self._frozen


def _tilt_apart_rad(a: Attitude, b: Attitude) -> float:
    """Larger of the differences of roll and pitch; 0 where they are not reported."""
    pairs = ((a.roll_rad, b.roll_rad), (a.pitch_rad, b.pitch_rad))
    return max((abs(y - x) for x, y in pairs if x is not None and y is not None), default=0.0)
