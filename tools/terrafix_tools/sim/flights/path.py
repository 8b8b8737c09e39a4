"""A flight that was flown: the truth, step after step, and at any moment between."""

import math
from collections.abc import Callable

import numpy as np

from terrafix_tools.sim.interfaces import Readings, Sensors, State, Vehicle

STEP_S = 0.02  # of the simulation


class FlownPath:
    """``states``: one for each STEP_S, from time zero."""

    def __init__(self, states: list[State]) -> None:
        self.states = states

    @property
    def duration_s(self) -> float:
        return (len(self.states) - 1) * STEP_S

    def state(self, t_s: float) -> State:
        """Truth at ``t_s``; before the first step and after the last the vehicle is where it was then."""
        at = min(max(t_s / STEP_S, 0.0), len(self.states) - 1.0)
        i = min(int(at), len(self.states) - 2)
        return between(self.states[i], self.states[i + 1], at - i)

    def length_m(self, until_s: float = math.inf) -> float:
        """Flown over ground, horizontally."""
        places = np.array([s.p_b_in_w_m[:2] for s in self.states if s.t_s <= until_s])
        return float(np.hypot(*np.diff(places, axis=0).T).sum())


def fly(
    vehicle: Vehicle,
    sensors: Sensors,
    first: State,
    duration_s: float,
    *,
    until: Callable[[], bool] = lambda: False,
    each: Callable[[Readings], None],
) -> FlownPath:
    """``duration_s`` from ``first``, on the truth; ``until`` ends it earlier. ``each`` hears every reading."""
    states = [first]
    each(sensors.read(first))
    for _ in range(math.ceil(duration_s / STEP_S)):
        states.append(vehicle.step(STEP_S, None))
        each(sensors.read(states[-1]))
        if until():
            break
    return FlownPath(states)


def between(a: State, b: State, share: float) -> State:
    """The state at ``share`` of the way from ``a`` to ``b``; a step apart, so that a straight line will do."""

    def angle(from_rad: float, to_rad: float) -> float:
        return math.remainder(from_rad + share * math.remainder(to_rad - from_rad, math.tau), math.tau)

    return State(
        t_s=a.t_s + share * (b.t_s - a.t_s),
        p_b_in_w_m=a.p_b_in_w_m + share * (b.p_b_in_w_m - a.p_b_in_w_m),
        velocity_enu_mps=a.velocity_enu_mps + share * (b.velocity_enu_mps - a.velocity_enu_mps),
        yaw_rad=angle(a.yaw_rad, b.yaw_rad),
        pitch_rad=angle(a.pitch_rad, b.pitch_rad),
        roll_rad=angle(a.roll_rad, b.roll_rad),
        agl_m=a.agl_m + share * (b.agl_m - a.agl_m),
        rates_b_radps=b.rates_b_radps,
        force_b_mps2=b.force_b_mps2,
        airspeed_mps=a.airspeed_mps + share * (b.airspeed_mps - a.airspeed_mps),
    )
