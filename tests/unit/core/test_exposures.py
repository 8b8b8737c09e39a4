"""Which frame is which exposure of the autopilot."""

import numpy as np
import pytest

from terrafix.core.exposures import Matched, match_exposures

RNG = np.random.default_rng(3)
UNEVEN_S = np.cumsum(RNG.uniform(0.4, 0.9, 40))  # by distance: no interval is like another
EVEN_S = np.arange(40) * 0.5
LATENCY_S, JITTER_S, SIGMA_S = 0.084, 0.004, 0.2


def stamps_s(exposures_s: np.ndarray, latency_s: float = LATENCY_S, lost: tuple[int, ...] = ()) -> np.ndarray:
    seen = np.delete(exposures_s, lost)
    return np.asarray(seen + latency_s + RNG.normal(0.0, JITTER_S, len(seen)))


@pytest.mark.parametrize("complete", [True, False])
def test_frames_get_their_exposures_though_images_and_reports_are_lost(complete: bool) -> None:
    frames, reports = stamps_s(UNEVEN_S, lost=(0, 7, 8, 30)), np.delete(UNEVEN_S, (12, 25))
    found = match_exposures(frames, reports, SIGMA_S, complete=complete)
    assert isinstance(found, Matched)
    assert found.latency_s == pytest.approx(LATENCY_S, abs=0.002)
    assert found.jitter_s == pytest.approx(JITTER_S, rel=0.5)
    truth_s = np.delete(UNEVEN_S, (0, 7, 8, 30))
    assert (~found.seen).sum() == 2
    assert found.times_s[found.seen] == pytest.approx(truth_s[found.seen], abs=1e-9)
    assert found.times_s == pytest.approx(truth_s, abs=5 * JITTER_S)


def test_an_even_rate_is_ambiguous_unless_the_latency_is_known_well_enough() -> None:
    frames = stamps_s(EVEN_S)
    unknown = match_exposures(frames, EVEN_S, 1.0, complete=False)
    assert isinstance(unknown, str) and "ambiguous" in unknown and "latency_ms" in unknown
    known = match_exposures(frames, EVEN_S, 0.1, complete=False)
    assert isinstance(known, Matched) and known.latency_s == pytest.approx(LATENCY_S, abs=0.002)


def test_a_complete_log_with_as_many_rows_as_images_settles_the_count_of_an_even_rate() -> None:
    found = match_exposures(stamps_s(EVEN_S, 12.3), EVEN_S, 100.0, complete=True)
    assert isinstance(found, Matched)
    assert found.latency_s == pytest.approx(12.3, abs=0.002)


def test_exposures_of_another_camera_do_not_fit() -> None:
    other = np.sort(RNG.uniform(0.0, UNEVEN_S[-1], 55))
    for frames in (stamps_s(UNEVEN_S), EVEN_S + 0.1):
        found = match_exposures(frames, other, SIGMA_S, complete=False)
        assert isinstance(found, str) and "fits" in found


def test_too_few_are_not_compared() -> None:
    assert "too few" in str(match_exposures(UNEVEN_S[:3], UNEVEN_S, SIGMA_S, complete=True))
