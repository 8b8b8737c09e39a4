"""Fixes that are not believed one by one."""

import numpy as np

from terrafix.estimator.integrity.innovation_run import AGREE_M, InnovationRun


def row(offsets_m: list[tuple[float, float]], spacing_m: float = 20.0, *, coarse: int = 0) -> InnovationRun:
    """``coarse``: so many of them, the first ones."""
    said = InnovationRun()
    for i, offset_m in enumerate(offsets_m):
        said.add(np.array(offset_m), np.array([spacing_m * i, 0.0]), coarse=i < coarse)
    return said


def test_several_that_agree_over_new_ground_hold() -> None:
    said = row([(100.0, 0.0), (103.0, -4.0), (98.0, 2.0), (101.0, 1.0)])
    assert said.holds(4, 50.0)
    assert not said.holds(5, 50.0)  # too few
    assert not said.holds(4, 60.0)  # over too little way: 60 m, and more is asked


def test_one_mistake_seen_again_and_again_does_not() -> None:
    assert not row([(100.0, 0.0)] * 10, spacing_m=0.5).holds(4, 50.0)


def test_coarse_ones_are_none_of_the_poses() -> None:
    said = row([(100.0, 0.0)] * 5, coarse=3)
    assert said.holds(5, 50.0) and said.holds(2, 50.0, poses=True)
    assert not said.holds(3, 50.0, poses=True) and not said.holds(2, 80.0, poses=True)


def test_one_that_does_not_agree_begins_a_new_row() -> None:
    said = row([(100.0, 0.0)] * 5 + [(100.0, AGREE_M + 1.0)])
    assert len(said.offsets_m) == said.poses == 1 and not said.holds(1, 1.0)


def test_what_was_said_can_be_forgotten() -> None:
    said = row([(100.0, 0.0)] * 5)
    said.clear()
    assert not said.holds(1, 0.0) and said.poses == 0
