"""Integration of specific force: gap rule, rotation into the world, gravity, and both rules of integration."""

import math

import numpy as np
import pytest

from terrafix.core.geodesy import rot_w_b
from terrafix.core.inertial import GRAVITY_MPS2, covers, integrate_held, rotate_to_world, trapezoid_weights

MS, S = 1_000_000, 1_000_000_000
TIMES = [0, 100 * MS, 200 * MS, 320 * MS]


@pytest.mark.parametrize("times", [TIMES, np.array(TIMES)])
@pytest.mark.parametrize(
    ("t0_ms", "t1_ms", "gap_ms", "covered"),
    [
        (0, 320, 120, True),
        (0, 320, 119, False),  # between the last two
        (-120, 440, 120, True),
        (-121, 320, 120, False),  # before the first
        (0, 441, 120, False),  # after the last
    ],
)
def test_a_gap_of_the_limit_is_still_covered(
    times: list[int], t0_ms: int, t1_ms: int, gap_ms: int, covered: bool
) -> None:
    assert covers(times, t0_ms * MS, t1_ms * MS, gap_ms * MS) is covered


def test_one_measurement_covers_its_surroundings_and_none_covers_nothing() -> None:
    assert covers([S], S - 10 * MS, S + 10 * MS, 10 * MS)
    assert not covers([S], S - 10 * MS, S + 11 * MS, 10 * MS)
    assert not covers([], S, S, 10 * MS)


def test_many_rotations_are_those_of_one() -> None:
    angles = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 20))
    v_b = np.random.default_rng(2).normal(size=(3, 20))
    one = [rot_w_b(*angles[:, i]) @ v_b[:, i] for i in range(20)]
    assert rotate_to_world(list(v_b), *angles) == pytest.approx(np.array(one), abs=1e-12)


def test_a_level_vehicle_at_rest_has_no_acceleration() -> None:
    force_b = [np.array([0.0]), np.array([0.0]), np.array([-GRAVITY_MPS2])]  # forward, right, down
    yaw, level = np.array([0.7]), np.zeros(1)
    assert rotate_to_world(force_b, yaw, level, level) - [0.0, 0.0, GRAVITY_MPS2] == pytest.approx(np.zeros((1, 3)))


def test_a_constant_acceleration_is_integrated_exactly_by_both_rules() -> None:
    accel = [(1.0, -2.0, 0.5)] * len(TIMES)
    delta_v, delta_p = integrate_held(TIMES, accel, -50 * MS, 400 * MS)
    assert delta_v == pytest.approx(0.45 * np.array(accel[0]))
    assert delta_p == pytest.approx(0.5 * 0.45**2 * np.array(accel[0]))
    s_s = np.array(TIMES) * 1e-9
    assert trapezoid_weights(s_s) @ np.array(accel) == pytest.approx(0.32 * np.array(accel[0]))


def test_the_trapezoid_rule_is_exact_for_a_linear_acceleration_and_the_held_one_converges() -> None:
    errors = []
    for n in (10, 40):
        t_ns = [round(t) for t in np.linspace(0, S, n + 1)]
        s_s = np.array(t_ns) * 1e-9
        assert float(trapezoid_weights(s_s) @ (3.0 * s_s)) == pytest.approx(1.5)
        delta_v, delta_p = integrate_held(t_ns, [(3.0 * s, 0.0, 0.0) for s in s_s], 0, S)
        assert delta_v[0] == pytest.approx(1.5)  # by symmetry
        errors.append(abs(float(delta_p[0]) - 0.5))
    assert errors[1] < errors[0] / 10.0 < 1e-3


def test_the_held_rule_uses_only_the_part_inside_the_interval() -> None:
    """A reading before the interval holds from its midpoint on, and no time is counted twice."""
    t_ns = [0, 200 * MS, 400 * MS]
    delta_v, _ = integrate_held(t_ns, [(10.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0)], 150 * MS, 350 * MS)
    assert math.isclose(delta_v[0], 1.0 * 0.15 + 2.0 * 0.05)
