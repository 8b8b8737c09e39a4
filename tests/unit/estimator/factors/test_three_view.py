"""Three-view factor: ratio of both translations, without absolute scale."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, F

from terrafix.estimator.factors.focal import FocalKey
from terrafix.estimator.factors.three_view import (
    MIN_FACTOR_TRIPLES,
    ThreeViewConstraint,
    ThreeViewPose,
    three_view_constraint,
    three_view_constraint_of_focal,
    three_view_factor,
)
from terrafix.estimator.state import CALIBRATION_SIZE, HEIGHT, RADIAL_K1

DOWN = gtsam.Rot3(np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]))
HEIGHT_M, SIGMA, FOCAL_SIGMA = 100.0, 5e-4, 0.01
NODES = ((C(0), B(0)), (C(1), B(1)), (C(2), B(2)))


class ThreeCameras:
    """Three cameras over hills of ``relief_m`` (1-sigma), their matches, and a guess of their poses."""

    def __init__(self, seed: int, relief_m: float = 8.0, lens: float = 0.0, *, points: int = 60) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.poses = [
            gtsam.Pose3(
                DOWN.compose(gtsam.Rot3.Expmap(rng.normal(0.0, 0.05, 3))),
                np.array([22.0 * i, 2.0 * i * i, HEIGHT_M + 2.0 * i]),
            )
            for i in range(3)
        ]
        ground = np.column_stack(
            [rng.uniform(-60, 110, 3000), rng.uniform(-60, 60, 3000), rng.normal(0, relief_m, 3000)]
        )
        views = []
        for pose in self.poses:
            in_c = (ground - pose.translation()) @ pose.rotation().matrix()
            views.append(in_c[:, :2] / in_c[:, 2:])
        inside = np.all([np.all(np.abs(xy) < (0.9, 0.5), axis=1) for xy in views], axis=0)
        seen = np.stack(views, 1)[inside][:points]
        seen = seen * (1.0 + lens * np.sum(seen**2, axis=2, keepdims=True))
        self.triples = seen.reshape(-1, 6) + SIGMA * rng.normal(size=(len(seen), 6))

    def guess(self, off: float = 1.0) -> ThreeViewPose:
        guessed = [
            pose.retract(off * np.concatenate([self.rng.normal(0, 0.005, 3), self.rng.normal(0, 0.5, 3)]))
            for pose in self.poses
        ]
        return ThreeViewPose(guessed[1].between(guessed[0]), guessed[1].between(guessed[2]), HEIGHT_M, 0.0, 0.0)

    def values(self, scale: float = 1.0, lens: float = 0.0) -> gtsam.Values:
        values = gtsam.Values()
        bias = np.zeros(CALIBRATION_SIZE)
        bias[RADIAL_K1] = lens
        for i, pose in enumerate(self.poses):
            values.insert(C(i), gtsam.Pose3(pose.rotation(), scale * pose.translation()))
            values.insert(B(i), bias)
        return values


def length(pose: gtsam.Pose3) -> float:
    return float(np.linalg.norm(pose.translation()))


def constraint_of(flown: ThreeCameras, guess: ThreeViewPose | None = None) -> ThreeViewConstraint:
    constraint = three_view_constraint(flown.triples, SIGMA, guess or flown.guess(), FOCAL_SIGMA)
    assert constraint is not None
    return constraint


def test_the_ratio_of_the_translations_does_not_depend_on_relief() -> None:
    off = []
    for seed in range(30):
        flown = ThreeCameras(seed)
        at = constraint_of(flown).at
        true = length(flown.poses[1].between(flown.poses[2])) / length(flown.poses[1].between(flown.poses[0]))
        off.append(length(at.last) / length(at.first) / true - 1.0)
    assert np.sqrt(np.mean(np.square(off))) < 0.01  # one plane through such ground has an error of some 5 %


def test_the_residual_at_the_truth_is_within_the_stated_noise() -> None:
    squares, rows = 0.0, 0
    for seed in range(40):
        flown = ThreeCameras(seed)
        constraint = constraint_of(flown)
        error = three_view_factor(NODES, constraint, rises=False).unwhitenedError(flown.values())
        squares, rows = squares + float(error @ error), rows + len(error)
    assert 0.02 < squares / rows < 0.5  # its points have a third of their weight, and count as sixteen at most


def test_the_factor_carries_no_information_about_absolute_scale() -> None:
    flown = ThreeCameras(3)
    constraint = constraint_of(flown)
    factor = three_view_factor(NODES, constraint, rises=False)
    same, longer = (factor.unwhitenedError(flown.values(scale)) for scale in (1.0, 1.3))
    assert longer == pytest.approx(same, abs=0.02 * float(np.linalg.norm(same)) + 1e-6)
    assert constraint.jacobian.shape[0] <= 12


def test_the_radial_coefficient_is_observable() -> None:
    flown = ThreeCameras(4, lens=-0.03)
    factor = three_view_factor(NODES, constraint_of(flown, flown.guess(0.2)), rises=False)
    square = {lens: float(np.sum(factor.unwhitenedError(flown.values(lens=lens)) ** 2)) for lens in (0.0, -0.03, -0.06)}
    assert square[-0.03] < 0.5 * min(square[0.0], square[-0.06])


def test_short_translations_and_few_points_give_no_constraint() -> None:
    flown = ThreeCameras(5)
    guess = flown.guess()
    assert three_view_constraint(flown.triples[: MIN_FACTOR_TRIPLES - 1], SIGMA, guess, FOCAL_SIGMA) is None
    short = replace(guess, last=gtsam.Pose3(guess.last.rotation(), 0.05 * guess.last.translation()))
    assert three_view_constraint(flown.triples, SIGMA, short, FOCAL_SIGMA) is None


def test_mismatched_points_give_no_constraint() -> None:
    flown = ThreeCameras(6)
    mixed = flown.triples.copy()
    mixed[:, 4:] = mixed[::-1, 4:]
    assert three_view_constraint(mixed, SIGMA, flown.guess(), FOCAL_SIGMA) is None


def test_a_solution_far_from_the_guess_is_rejected() -> None:
    flown = ThreeCameras(7)
    guess = flown.guess(0.0)
    far = replace(guess, last=guess.last.compose(gtsam.Pose3(gtsam.Rot3.Rz(0.2), np.zeros(3))))
    assert three_view_constraint(flown.triples, SIGMA, guess, FOCAL_SIGMA) is not None
    assert three_view_constraint(flown.triples, SIGMA, far, FOCAL_SIGMA) is None


@pytest.mark.parametrize("rises", [False, True])
def test_the_jacobians_match_numerical_differences(rises: bool) -> None:
    flown = ThreeCameras(8)
    factor = three_view_factor(NODES, constraint_of(flown, flown.guess(0.0)), rises=rises)
    values = flown.values()
    if rises:
        for i in range(3):
            bias = values.atVector(B(i))
            bias[HEIGHT] = 0.3 * i
            values.update(B(i), bias)
    keys = list(factor.keys())
    by, _ = factor.linearize(values).jacobian()
    step = 1e-5

    def moved(change: np.ndarray) -> np.ndarray:
        there = gtsam.Values(values)
        for i, key in enumerate(keys):
            part = change[6 * i : 6 * i + 6]
            if key in (C(0), C(1), C(2)):
                there.update(key, values.atPose3(key).retract(part))
            else:
                there.update(key, values.atVector(key) + part)
        return np.asarray(factor.unwhitenedError(there))

    size = 6 * len(keys)
    expected = np.column_stack([(moved(e) - moved(-e)) / (2 * step) for e in step * np.eye(size)])
    assert np.abs(by - expected).max() < 0.01 * np.abs(expected).max()


def test_a_focal_length_that_is_a_variable_explains_its_error() -> None:
    """Images through a focal length that is 2 % longer than described fit the true poses at that value, and not at the
    described one."""
    flown, longer = ThreeCameras(3), 0.02
    triples = flown.triples * np.exp(longer)
    guess = flown.guess(0.1)
    constraint = three_view_constraint_of_focal(triples, SIGMA, guess, 0.1)
    assert constraint is not None and constraint.by_focal is not None
    factor = three_view_factor(NODES, constraint, rises=False, focal=FocalKey(F(0), 0.0))
    errors = []
    for value in (0.0, longer):
        values = flown.values()
        values.insert(F(0), np.array([value]))
        errors.append(float(np.sum(factor.unwhitenedError(values) ** 2)))
    assert errors[1] < 0.3 * errors[0]
    by_focal = factor.linearize(values).jacobian()[0][:, -1]
    assert by_focal == pytest.approx(constraint.by_focal)
