"""Frame rate of a live source by thermal band."""

import itertools

import pytest

from terrafix.core.config import HealthSection
from terrafix.messages import ThermalBand
from terrafix.vision.frame_rate import FrameRateLimit

LIMITS = HealthSection(hot_rate_hz=5.0, critical_rate_hz=2.0)


def frames_taken(limit: FrameRateLimit, rate_hz: float, seconds: float, from_s: float = 0.0) -> list[float]:
    """-> times [s] of the frames of a camera with ``rate_hz`` that ``limit`` takes."""
    times = [from_s + i / rate_hz for i in range(round(rate_hz * seconds))]
    return [t for t in times if limit.takes_frame(round(t * 1e9))]


@pytest.mark.parametrize("band, taken", [(ThermalBand.NORMAL, 240), (ThermalBand.HOT, 40), (ThermalBand.CRITICAL, 16)])
def test_a_30_hz_camera_keeps_the_rate_of_the_band(band: ThermalBand, taken: int) -> None:
    limit = FrameRateLimit(LIMITS)
    limit.band = band
    assert abs(len(frames_taken(limit, 30.0, 8.0)) - taken) <= 1


def test_the_mean_rate_holds_for_a_camera_whose_rate_is_no_multiple_of_it() -> None:
    limit = FrameRateLimit(LIMITS)
    limit.band = ThermalBand.HOT
    assert abs(len(frames_taken(limit, 7.0, 20.0)) - 100) <= 1


def test_a_camera_slower_than_the_limit_loses_no_frame() -> None:
    limit = FrameRateLimit(LIMITS)
    limit.band = ThermalBand.CRITICAL
    assert len(frames_taken(limit, 2.0, 10.0)) == 20


def test_after_a_gap_the_frames_come_at_the_limit_and_not_in_a_burst() -> None:
    limit = FrameRateLimit(LIMITS)
    limit.band = ThermalBand.HOT
    frames_taken(limit, 30.0, 1.0)
    after = frames_taken(limit, 30.0, 2.0, from_s=60.0)
    assert len(after) == 10
    assert min(b - a for a, b in itertools.pairwise(after)) > 0.19


def test_the_normal_band_takes_every_frame_at_once_after_a_hot_one_also_one_whose_time_went_back() -> None:
    limit = FrameRateLimit(LIMITS)
    limit.band = ThermalBand.CRITICAL
    assert limit.takes_frame(10**9)
    limit.band = ThermalBand.NORMAL
    assert limit.takes_frame(10**9 + 1)
    assert limit.takes_frame(10**9 - 1)
