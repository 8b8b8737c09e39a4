"""Where a receiver should be by how it was: what is usual is learnt, a drag-off is not, nobody pays for our errors."""

import math

import numpy as np
import pytest

from link_rig import LAT, LON, MS, SPEED_EAST, S, estimate
from terrafix.link.gnss.offset_predictor import LAG_S, OffsetForecast
from terrafix.link.gnss.predictor_noise import LEAST_SCALE, PRIOR_SAMPLES, Errors, Scatter
from terrafix.link.gnss.spoofing_detector import DRAG_CHANCE, JUMP_SIGMAS, SpoofingDetector
from terrafix.link.integrity.output_predictor import Attitudes, offset, predict_to
from terrafix.messages import GnssReading, GnssState

DT_S = 0.2
MAP_M = (-9.0, 4.0)  # what the map is off, for the whole flight


NOTHING_M = 1e6  # 1-sigma of a slip: our velocity says nothing


def chances(
    forecast: OffsetForecast,
    offsets: list[complex],
    sigma_m: float = 6.0,
    slips: list[complex] | None = None,
    slip_sigma_m: float = NOTHING_M,
) -> list[float]:
    moved = slips or [0j] * len(offsets)
    return [
        forecast.take(offset, sigma_m, slip, slip_sigma_m, DT_S, learn=True)[0]
        for offset, slip in zip(offsets, moved, strict=True)
    ]


def seconds(value_s: float) -> int:
    return round(value_s / DT_S)


def test_the_chance_is_that_of_a_student_t_in_two_dimensions() -> None:
    """Against drawn numbers: with nothing but the prior there are two degrees of freedom for each of its samples."""
    forecast = OffsetForecast()
    chances(forecast, [0j] * seconds(LAG_S + 2.0), sigma_m=1.0)  # a mean, and no error of a forecast yet
    rng, freedom = np.random.default_rng(1), 2.0 * PRIOR_SAMPLES
    drawn = rng.normal(size=(400_000, 2)) / np.sqrt(rng.chisquare(freedom, 400_000) / freedom)[:, None]
    away = np.hypot(*drawn.T)
    for limit in (1.0, 2.0, 4.0):
        fresh = OffsetForecast()
        chances(fresh, [0j] * seconds(LAG_S + 2.0), sigma_m=1.0)
        fresh.pause()
        said, error_m = fresh.take(complex(limit, 0.0), 1.0, 0j, NOTHING_M, DT_S, learn=False)
        assert error_m == pytest.approx(limit)
        assert said == pytest.approx(float((away > limit).mean()), rel=0.05)


def test_what_stays_for_the_flight_is_usual_and_a_change_of_it_is_not() -> None:
    forecast, steady = OffsetForecast(), complex(*MAP_M)
    assert min(chances(forecast, [steady] * seconds(600.0))) > 0.05  # never a word against it
    walked = chances(forecast, [steady + 1.0 * DT_S * k for k in range(seconds(40.0))])
    seen_s = next(k for k, chance in enumerate(walked) if chance < DRAG_CHANCE) * DT_S
    assert seen_s < 29.0
    away_m = abs(steady + seen_s)
    assert away_m < JUMP_SIGMAS * 6.0  # the distance alone says nothing yet


def test_the_slip_against_our_velocity_makes_it_seen_earlier() -> None:
    drag, quiet = 1.0 * DT_S, [0j] * seconds(600.0)
    walked, slips = [drag * k + 0j for k in range(seconds(40.0))], [drag + 0j] * seconds(40.0)
    seen_s = []
    for slip_sigma_m in (NOTHING_M, 18.0):
        forecast = OffsetForecast()
        chances(forecast, quiet, slip_sigma_m=slip_sigma_m)
        said = chances(forecast, walked, slips=slips, slip_sigma_m=slip_sigma_m)
        seen_s.append(next(k for k, chance in enumerate(said) if chance < DRAG_CHANCE) * DT_S)
    assert seen_s[1] < seen_s[0] - 2.0


def test_when_the_receiver_has_not_moved_against_our_velocity_it_is_we_who_are_elsewhere() -> None:
    """A map that is off elsewhere: the offset walks, the slip does not."""
    walked = [0.6 * DT_S * k + 0j for k in range(seconds(40.0))]
    least = []
    for slip_sigma_m in (NOTHING_M, 18.0):
        forecast = OffsetForecast()
        chances(forecast, [0j] * seconds(600.0), slip_sigma_m=slip_sigma_m)
        least.append(min(chances(forecast, walked, slip_sigma_m=slip_sigma_m)))
    assert least[1] > 5.0 * least[0]


def test_both_forecasts_together_have_the_variance_that_drawn_errors_have() -> None:
    """Errors that are alike in part, of which much was seen: a chance of 5 % is one in twenty."""
    rng = np.random.default_rng(3)
    mixed = rng.normal(size=(4000, 2)) @ np.array([1.0, 1j])
    position_m = 6.0 * mixed
    slip_m = 12.0 * (0.4 * mixed + math.sqrt(1.0 - 0.4**2) * rng.normal(size=(4000, 2)) @ np.array([1.0, 1j]))
    scatter, said = Scatter(), []
    for k, (position, slip) in enumerate(zip(position_m, slip_m, strict=True)):
        errors = Errors(complex(position), 6.0, complex(slip), 12.0)
        if k >= 2000:
            said.append(scatter.chance(errors)[0])
        scatter.learn(errors, gain=1.0, keep=1.0)
    for chance in (0.05, 0.3):
        assert float(np.mean(np.array(said) < chance)) == pytest.approx(chance, rel=0.25)


def test_a_drag_off_is_not_learnt_while_it_begins() -> None:
    forecast = OffsetForecast()
    chances(forecast, [0j] * seconds(600.0))
    _, before_m = forecast.take(10.0 + 0j, 6.0, 0j, NOTHING_M, DT_S, learn=True)
    chances(forecast, [10.0 + 0j] * seconds(LAG_S - 5.0))
    _, after_m = forecast.take(10.0 + 0j, 6.0, 0j, NOTHING_M, DT_S, learn=True)
    assert before_m is not None and after_m is not None
    assert after_m == pytest.approx(10.0, abs=0.1) and before_m < after_m  # smoothed, and then in full


def test_a_flight_that_was_better_than_claimed_may_become_as_bad() -> None:
    """However quiet it was: three times what is claimed is no drag-off."""
    forecast = OffsetForecast()
    chances(forecast, [0j] * seconds(3000.0))
    said = chances(forecast, [complex(3.0 * 6.0, 0.0)] * seconds(10.0))
    assert min(said) > DRAG_CHANCE
    assert LEAST_SCALE * math.sqrt(-2.0 * math.log(DRAG_CHANCE)) > 3.0  # why, for as much as there is to learn


def test_after_a_vague_stretch_nobody_is_accused_of_what_was_vague() -> None:
    forecast = OffsetForecast()
    chances(forecast, [0j] * seconds(600.0))
    drift = [complex(0.5 * DT_S * k, 0.0) for k in range(seconds(60.0))]
    blind = [forecast.take(x, math.hypot(6.0, abs(x)), 0j, NOTHING_M, DT_S, learn=True)[0] for x in drift]
    back = chances(forecast, [0j] * seconds(120.0))
    assert min(blind + back) > 0.01


def judged(
    judge: SpoofingDetector, begin_s: float, end_s: float, east_m: float, ours_m: float, step_m: float = 0.0
) -> set[GnssState]:
    """What is said of readings at 5 Hz that are ``east_m`` off. Estimates are new with each, ``ours_m`` off, with a
    sigma of 6 m, and have made a step of ``step_m`` lately."""
    said = set()
    for k in range(seconds(begin_s), seconds(end_s)):
        t_ns = round(k * DT_S * S)
        vision = predict_to(estimate(t_ns - 50 * MS, sigma_m=6.0, east_m=ours_m), t_ns, Attitudes())
        lat, lon = offset(LAT, LON, SPEED_EAST * t_ns / S + east_m, 0.0)
        place = {"lat_deg": lat, "lon_deg": lon, "horizontal_m": 1.3}
        there = GnssReading(t_ns=t_ns, receiver=0, fix_type=3, speed_mps=SPEED_EAST, satellites=14, **place)
        said.add(judge.take(there, vision, step_m).state)
    return said


def test_when_it_was_we_who_moved_it_is_learnt_anew() -> None:
    """A map is left for another one: all is 26 m elsewhere from one estimate to the next, within the claims."""
    judge = SpoofingDetector()
    judged(judge, 0.0, 900.0, 1.0, 0.0)
    moved = judged(judge, 900.0, 910.0, 1.0, 27.0, step_m=27.0) | judged(judge, 910.0, 1000.0, 1.0, 27.0)
    assert moved == {GnssState.TRUSTED}
    without = SpoofingDetector()
    judged(without, 0.0, 900.0, 1.0, 0.0)
    assert GnssState.SPOOFED in judged(without, 900.0, 910.0, 27.0, 0.0)  # the same, and it was not we
