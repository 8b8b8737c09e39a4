"""Frame rate of a live source by thermal band."""

import itertools

import pytest

from terrafix.core.config import HealthSection
from terrafix.messages import ThermalBand
from terrafix.vision.frame_rate import FrameRateLimit


def limit_of(band: ThermalBand) -> FrameRateLimit:
    limit = FrameRateLimit(HealthSection(hot_rate_hz=5.0, critical_rate_hz=2.0))
    limit.band = band
    return limit


def frames_taken(limit: FrameRateLimit, rate_hz: float, seconds: float, from_s: float = 0.0) -> list[float]:
    """-> times [s] of the frames of a camera with ``rate_hz`` that ``limit`` takes."""
    times = [from_s + i / rate_hz for i in range(round(rate_hz * seconds))]
    return [t for t in times if limit.takes_frame(round(t * 1e9))]


@pytest.mark.parametrize(
    ("band", "rate_hz", "seconds", "taken"),
    [
        pytest.param(ThermalBand.NORMAL, 30.0, 8.0, 240, id="all of a normal computer"),
        pytest.param(ThermalBand.HOT, 30.0, 8.0, 40, id="5 a second of a hot one"),
        pytest.param(ThermalBand.CRITICAL, 30.0, 8.0, 16, id="2 a second of a critical one"),
        pytest.param(ThermalBand.HOT, 7.0, 20.0, 100, id="the mean rate, of which the camera's is no multiple"),
        pytest.param(ThermalBand.CRITICAL, 2.0, 10.0, 20, id="all of a camera that is not faster"),
    ],
)
def test_a_camera_keeps_the_rate_of_the_band(band: ThermalBand, rate_hz: float, seconds: float, taken: int) -> None:
    off = abs(len(frames_taken(limit_of(band), rate_hz, seconds)) - taken)
    assert off <= (rate_hz != 2.0)


def test_after_a_gap_the_frames_come_at_the_limit_and_not_in_a_burst() -> None:
    limit = limit_of(ThermalBand.HOT)
    frames_taken(limit, 30.0, 1.0)
    after = frames_taken(limit, 30.0, 2.0, from_s=60.0)
    assert len(after) == 10
    assert min(b - a for a, b in itertools.pairwise(after)) > 0.19


def test_the_normal_band_takes_every_frame_at_once_after_a_hot_one_also_one_whose_time_went_back() -> None:
    limit = limit_of(ThermalBand.CRITICAL)
    assert limit.takes_frame(10**9)
    limit.band = ThermalBand.NORMAL
    assert limit.takes_frame(10**9 + 1)
    assert limit.takes_frame(10**9 - 1)
