"""Patch consensus: evidence under one motion of the camera, for right, random and changed ground."""

import numpy as np
import pytest

from terrafix.anchor.verification.patch_consensus import _best_offsets, estimate_consensus

CELL = 0.01  # of the height
REACH = 16
TILT_SIGMA = 0.1
ACROSS = np.linspace(-0.5, 0.5, 7)
GROUND = np.array([(x, y) for x in ACROSS for y in 0.7 * ACROSS])


def moved(motion: tuple[float, ...]) -> np.ndarray:
    """(N, 2): offsets of the ground at GROUND for a motion (east, north, yaw, scale, tilt, tilt), by projection instead
    of a Jacobian."""
    east, north, yaw, scale, tilt_e, tilt_n = motion
    turned = (1.0 + scale) * GROUND @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    rays = np.column_stack([turned, -np.ones(len(turned))])
    for angle, axes in ((tilt_e, (0, 2)), (tilt_n, (1, 2))):
        a, b = rays[:, axes[0]].copy(), rays[:, axes[1]].copy()
        rays[:, axes[0]] = np.cos(angle) * a - np.sin(angle) * b
        rays[:, axes[1]] = np.sin(angle) * a + np.cos(angle) * b
    return rays[:, :2] / -rays[:, 2:] + (east, north) - GROUND


def surfaces(offsets: np.ndarray, right: np.ndarray, seed: int = 1, height: float = 4.0) -> np.ndarray:
    """Smooth noise as at wrong places; the patches in ``right`` have a peak of ``height`` standard deviations at
    ``offsets`` (N, 2)."""
    rng, side = np.random.default_rng(seed), 2 * REACH + 1
    rows, columns = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1] * CELL
    out = np.zeros((len(offsets), side, side))
    for i, (east, north) in enumerate(offsets):
        for _ in range(60):
            e, n = rng.uniform(-REACH * CELL, REACH * CELL, 2)
            out[i] += rng.normal() * np.exp(-((columns - e) ** 2 + (rows + n) ** 2) / (2 * 0.02**2))
        out[i] /= out[i].std()
        if right[i]:
            out[i] += height * np.exp(-((columns - east) ** 2 + (rows + north) ** 2) / (2 * 0.02**2))
    return out


ALL, NONE = np.ones(len(GROUND), bool), np.zeros(len(GROUND), bool)


@pytest.mark.parametrize(
    "motion",
    [
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.06, -0.04, 0.0, 0.0, 0.0, 0.0),
        (0.02, 0.03, 0.10, 0.0, 0.0, 0.0),
        (-0.03, 0.01, 0.0, -0.06, 0.0, 0.0),
        (0.0, 0.0, 0.05, 0.04, 0.08, -0.05),
    ],
)
def test_the_motion_is_found(motion: tuple[float, ...]) -> None:
    offsets = moved(motion)
    found = estimate_consensus(surfaces(offsets, ALL), GROUND, CELL, TILT_SIGMA)
    assert found.inliers.mean() > 0.8
    assert np.median(np.linalg.norm(found.offsets - offsets, axis=1)) < 1.5 * CELL
    assert found.motion[2:4] == pytest.approx(motion[2:4], abs=0.015)
    assert found.motion[:2] + found.motion[4:] == pytest.approx(np.add(motion[:2], motion[4:]), abs=0.015)


def test_clear_peaks_are_located_without_bias() -> None:
    """Around a clear peak several cells reach the bound of one patch's evidence."""
    offsets = moved((0.03, 0.02, 0.0, 0.0, 0.0, 0.0))
    found = estimate_consensus(surfaces(offsets, ALL, height=12.0), GROUND, CELL, TILT_SIGMA)
    assert np.abs((found.offsets - offsets).mean(0)).max() < 0.15 * CELL
    assert found.motion[:2] == pytest.approx((0.03, 0.02), abs=0.15 * CELL)


def test_random_surfaces_give_little_evidence_and_changed_ground_removes_only_its_share() -> None:
    offsets = moved((0.03, 0.02, 0.04, 0.02, 0.0, 0.0))
    half = GROUND[:, 0] + GROUND[:, 1] > 0.0
    right, changed, wrong = (
        [estimate_consensus(surfaces(offsets, which, seed), GROUND, CELL, TILT_SIGMA).llr for seed in range(5)]
        for which in (ALL, half, NONE)
    )
    assert min(right) > 2.0 * max(wrong)
    assert min(changed) > max(wrong)
    assert np.mean(right) > np.mean(changed)


def test_two_places_of_a_patch_that_are_almost_equally_high_share_it() -> None:
    """Of the highest cell alone the place would jump from one to the other by the last bit."""
    z = np.zeros((1, 21, 21), np.float32)
    found = []
    for more in (-1e-4, 1e-4):
        z[0, 10, 8], z[0, 10, 12] = 4.0 - more, 4.0 + more
        [offset], [value] = _best_offsets(z, z, np.zeros((1, 2)), CELL, 4.0 * CELL)
        assert value == pytest.approx(4.0, abs=1e-3)
        found.append(offset)
    assert found[0] == pytest.approx(found[1], abs=0.01 * CELL)
    assert found[0] == pytest.approx((0.0, 0.0), abs=0.1 * CELL)
