"""Runs of consecutive rejected fixes with consistent offsets."""

import numpy as np
import pytest

from terrafix.estimator.integrity.innovation_run import CONSISTENT_M, InnovationRun


def make_run(offsets_m: list[tuple[float, float]], spacing_m: float = 20.0, *, coarse: int = 0) -> InnovationRun:
    """``coarse``: the first ones of the fixes are coarse."""
    run = InnovationRun()
    for i, offset_m in enumerate(offsets_m):
        run.add(np.array(offset_m), np.array([spacing_m * i, 0.0]), position_only=i < coarse)
    return run


def test_enough_consistent_offsets_over_a_long_span_confirm_the_run() -> None:
    run = make_run([(100.0, 0.0), (103.0, -4.0), (98.0, 2.0), (100.0, 0.0)])
    assert run.is_confirmed(4, 50.0)
    assert not run.is_confirmed(5, 50.0)  # too few
    assert not run.is_confirmed(4, 60.0)  # the span is 60 m, and it must be more


def test_repeated_offsets_over_the_same_ground_do_not_confirm_the_run() -> None:
    assert not make_run([(100.0, 0.0)] * 10, spacing_m=0.5).is_confirmed(4, 50.0)


def test_coarse_fixes_do_not_count_as_poses() -> None:
    run = make_run([(100.0, 0.0)] * 5, coarse=3)
    assert run.is_confirmed(5, 50.0) and run.is_confirmed(2, 50.0, poses_only=True)
    assert not run.is_confirmed(3, 50.0, poses_only=True) and not run.is_confirmed(2, 80.0, poses_only=True)


def test_an_inconsistent_offset_begins_a_new_run() -> None:
    run = make_run([(100.0, 0.0)] * 5 + [(100.0, CONSISTENT_M + 1.0)])
    assert len(run.offsets_m) == run.poses == 1 and not run.is_confirmed(1, 1.0)


def test_clear_empties_the_run() -> None:
    run = make_run([(100.0, 0.0)] * 5)
    run.clear()
    assert not run.is_confirmed(1, 0.0) and run.poses == 0


def test_fixes_agree_if_the_estimate_that_has_moved_since_explains_their_offsets() -> None:
    """The estimate turns about its last fix between two frames: the second offset is 20 m off the first one. With both
    frames as estimated now they agree; a node that has left the window keeps its offset."""
    run, now_m = InnovationRun(), {1: np.array([0.0, 20.0]), 2: np.array([60.0, 20.0])}
    run.add(np.array([100.0, 0.0]), np.array([0.0, 0.0]), position_only=True, node=1)
    run.re_estimate(now_m.get)
    assert run.offsets_m[0] == pytest.approx([100.0, -20.0])
    assert run.add(np.array([100.0, -20.0]), np.array([60.0, 20.0]), position_only=True, node=2)
    run.re_estimate({2: np.array([61.0, 20.0])}.get)
    assert run.offsets_m[0] == pytest.approx([100.0, -20.0]) and run.offsets_m[1] == pytest.approx([99.0, -20.0])
    run.clear()
    run.re_estimate(now_m.get)
    assert not run.offsets_m


def test_an_estimate_that_stands_where_its_claim_says_it_may_move_agrees_with_fixes_that_move() -> None:
    """A plane that began in the air: nothing has measured its 25 m/s, and each right match is 50 m farther off."""
    run, ignorant = InnovationRun(), InnovationRun()
    for i in range(1, 5):
        at = {"offset_m": np.array([50.0 * i, 0.0]), "p_m": np.zeros(2), "position_only": False, "t_s": 2.0 * i}
        run.add(**at, cov_m2=np.diag([(26.0 * i) ** 2, (26.0 * i) ** 2]))
        ignorant.add(**at)  # of an estimate whose claim does not grow
    assert run.is_confirmed(4, 100.0) and run.drift_mps.tolist() == [25.0, 0.0]
    assert len(ignorant.offsets_m) == 1 and not ignorant.drift_mps.any()
