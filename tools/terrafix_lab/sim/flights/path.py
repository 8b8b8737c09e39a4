"""True path of a flown flight: states per step, with interpolation."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from terrafix_lab.sim.interfaces import Navigation, Readings, Sensors, State, Vehicle

STEP_S = 0.02  # of the simulation


class FlownPath:
    """``states``: one per STEP_S, from time zero."""

    def __init__(self, states: list[State]) -> None:
        self.states = states

    @property
    def duration_s(self) -> float:
        return (len(self.states) - 1) * STEP_S

    def state(self, t_s: float) -> State:
        """Returns the true state at ``t_s``; before the first and after the last step the vehicle stands still."""
        at = min(max(t_s / STEP_S, 0.0), len(self.states) - 1.0)
        i = min(int(at), len(self.states) - 2)
        return interpolate(self.states[i], self.states[i + 1], at - i)

    def length_m(self, until_s: float = math.inf) -> float:
        """Horizontal distance flown."""
        places = np.array([s.p_b_in_w_m[:2] for s in self.states if s.t_s <= until_s])
        return float(np.hypot(*np.diff(places, axis=0).T).sum())


def states_of(
    vehicle: Vehicle, count: int, navigation: Callable[[State], Navigation | None] = lambda _: None
) -> Iterator[State]:
    """-> ``count`` true states, STEP_S apart, of which the first is that of now. ``navigation``: by which the vehicle
    steers, of the state before; None: by the truth."""
    for i in range(count):
        yield vehicle.step(STEP_S, navigation(vehicle.state)) if i else vehicle.state


def fly(
    vehicle: Vehicle,
    sensors: Sensors,
    duration_s: float,
    *,
    until: Callable[[], bool] = lambda: False,
    on_reading: Callable[[Readings], None],
) -> FlownPath:
    """Flies for ``duration_s``, steering by the truth; ``until`` ends it earlier. ``on_reading`` is called with every
    reading."""
    states = []
    for state in states_of(vehicle, math.ceil(duration_s / STEP_S) + 1):
        states.append(state)
        on_reading(sensors.read(state))
        if until():
            break
    return FlownPath(states)


def interpolate(a: State, b: State, share: float) -> State:
    """Interpolates the state at ``share`` between ``a`` and ``b``, which are one step apart, so that linear is
    sufficient.
    """

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
