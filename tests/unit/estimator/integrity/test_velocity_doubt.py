"""Doubt about velocity by odometry that contradicts it for long."""

import numpy as np
import pytest

from terrafix.estimator.integrity.motion_gate import MotionInnovation
from terrafix.estimator.integrity.velocity_doubt import MOTION_TIMEOUT_S, VelocityDoubt
from terrafix.messages import Verdict

BEGAN_S = 10.0  # of motions that contradict velocity


@pytest.mark.parametrize("fix_s", [None, BEGAN_S - 1.0, BEGAN_S + 3.0])
def test_velocity_is_doubted_after_odometry_has_contradicted_it_for_long_without_a_map_match(
    fix_s: float | None,
) -> None:
    doubt = VelocityDoubt()
    doubt.on_fused(0.0)
    doubt.note(Verdict.IMPLAUSIBLE, MotionInnovation(np.zeros(3), np.eye(3), 0.5, inertial=True), BEGAN_S)
    due_s = max(BEGAN_S, fix_s or 0.0) + MOTION_TIMEOUT_S
    assert not doubt.is_timed_out(due_s - 0.1, fix_s) and doubt.is_timed_out(due_s + 0.1, fix_s)
    doubt.note(Verdict.ACCEPTED, None, due_s)
    assert not doubt.is_timed_out(due_s + 0.1, fix_s)
