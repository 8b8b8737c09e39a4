"""Clock of an autopilot's log against that of a record: offset and drift by the attitude in both, refusals."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from autopilot_logs import DRIFT, OFFSET_S, flight, part, telemetry
from terrafix.core.autopilot_log.alignment import align, body_rates
from terrafix.core.autopilot_log.attitude import AttitudeSeries
from terrafix.core.autopilot_log.correlation import LagPeak, correlate, needed_height, needed_lead
from terrafix.core.errors import EvaluationError
from terrafix_tools.autopilot_log.ardupilot import read_ardupilot

LIMIT_S = 0.020  # error over the whole flight


def worst_error_s(record: AttitudeSeries, log: AttitudeSeries, true_s: Callable[[np.ndarray], np.ndarray]) -> float:
    at_s = np.linspace(record.t_s[0], record.t_s[-1], 50)
    return float(np.abs(align(record, log).to_log(at_s) - true_s(at_s)).max())


@pytest.mark.parametrize("rate_hz", [4.0, 10.0, 25.0, 50.0])
@pytest.mark.parametrize("log_hz", [10.0, 25.0])
def test_a_shift_of_3_s_and_a_drift_of_50_ppm_are_found_within_20_ms(rate_hz: float, log_hz: float) -> None:
    log = flight(seed=int(rate_hz), rate_hz=log_hz)
    record, true_s = telemetry(log, seed=1, rate_hz=rate_hz)
    assert worst_error_s(record, log, true_s) < LIMIT_S


def test_without_latency_offset_and_drift_are_right_within_three_standard_errors() -> None:
    offsets, drifts = [], []
    for seed in range(8):
        log = flight(seed=seed, duration_s=300.0)
        record, true_s = telemetry(log, seed=seed, rate_hz=25.0, jitter_s=0.0)
        noise = np.random.default_rng(seed).normal(0.0, 2e-3, (3, record.t_s.size))
        noisy = AttitudeSeries(
            record.t_s, record.roll_rad + noise[0], record.pitch_rad + noise[1], record.yaw_rad + noise[2]
        )
        found = align(noisy, log)
        true_offset_s = true_s(np.array([found.middle_s]))[0] - found.middle_s
        offsets.append((found.offset_s - true_offset_s) / found.offset_sigma_s)
        drifts.append((found.drift - DRIFT) / found.drift_sigma)
        assert found.offset_s == pytest.approx(OFFSET_S, abs=1e-3) and found.drift == pytest.approx(DRIFT, abs=10e-6)
    assert np.abs(offsets).max() < 3.5 and np.abs(drifts).max() < 3.5
    assert 0.3 < np.sqrt(np.mean(np.square(offsets))) < 1.8


def test_times_are_mapped_both_ways() -> None:
    log = flight(seed=3)
    record, _ = telemetry(log, seed=3)
    found = align(record, log)
    at_s = np.array([20.0, 70.0, 130.0])
    assert found.to_record(found.to_log(at_s)) == pytest.approx(at_s, abs=1e-9)


def test_a_heading_that_is_wrong_and_a_trim_do_not_move_the_clock() -> None:
    log = flight(seed=4)
    record, true_s = telemetry(log, seed=4, rate_hz=25.0)
    turned = AttitudeSeries(record.t_s, record.roll_rad + 0.03, record.pitch_rad - 0.02, record.yaw_rad + 0.5)
    assert worst_error_s(turned, log, true_s) < LIMIT_S


def test_a_log_that_covers_only_the_middle_of_the_record_is_aligned() -> None:
    log = flight(seed=5, duration_s=240.0)
    record, true_s = telemetry(log, seed=5, rate_hz=25.0)
    assert worst_error_s(record, part(log, 90.0, 190.0), true_s) < LIMIT_S


def test_the_log_of_another_flight_is_refused_in_one_line_that_says_so() -> None:
    record, _ = telemetry(flight(seed=6), seed=6)
    with pytest.raises(
        EvaluationError, match=r"^the log is of another flight than the record: .* give the log of this flight$"
    ):
        align(record, flight(seed=7))


def test_another_part_of_the_same_flight_is_refused() -> None:
    log = flight(seed=8, duration_s=240.0)
    record, _ = telemetry(part(log, 20.0, 130.0), seed=8)
    with pytest.raises(EvaluationError, match="another flight"):
        align(record, part(log, 150.0, 260.0))


def test_a_flight_of_the_same_manoeuvres_at_slightly_other_times_is_refused() -> None:
    """The same mission flown again: its rates correlate, and its time scatters."""
    log = flight(seed=11, duration_s=240.0)
    record, _ = telemetry(log, seed=11, rate_hz=25.0)
    again_s = log.t_s + 0.15 * np.sin(log.t_s / 15.0)
    with pytest.raises(EvaluationError, match=r"rates correlate by 0\.\d+ .* and its time scatters by 1\d\d ms"):
        align(record, AttitudeSeries(again_s, log.roll_rad, log.pitch_rad, log.yaw_rad))


def test_a_log_that_explains_half_of_the_motion_is_refused_though_its_time_is_steady() -> None:
    log = flight(seed=12, duration_s=240.0)
    record, _ = telemetry(log, seed=12, rate_hz=25.0)
    vibration = 0.06 * np.sin(2 * np.pi * 1.3 * log.t_s)
    with pytest.raises(EvaluationError, match=r"rates correlate by 0\.[67]\d \(0\.80 .* scatters by \d ms"):
        align(record, AttitudeSeries(log.t_s, log.roll_rad + vibration, log.pitch_rad - vibration, log.yaw_rad))


@pytest.mark.parametrize(
    ("correlation", "second", "sigma", "distinct"),
    [
        (0.90, 0.10, 0.05, True),
        (0.90, 0.885, 0.05, False),  # does not lead
        (0.50, 0.00, 0.15, False),  # not high enough
        (0.99, 0.30, 0.25, True),  # 0.86 is needed, as correlations end at 1
    ],
)
def test_a_peak_must_be_high_and_lead(correlation: float, second: float, sigma: float, distinct: bool) -> None:
    peak = LagPeak(0.0, 0.0, correlation, second, sigma, lags=1000)
    assert peak.distinct is distinct and peak.needed < 1.0


def test_without_motion_the_refusal_is_about_motion() -> None:
    t_s = np.arange(0.0, 60.0, 0.1)
    noise = np.random.default_rng(0).normal(0.0, 1e-5, (3, t_s.size))
    with pytest.raises(EvaluationError, match=r"^too little motion to align the clocks: the record has"):
        align(AttitudeSeries(t_s, *noise), flight(seed=9))


def test_a_few_seconds_of_attitude_are_too_little() -> None:
    with pytest.raises(EvaluationError, match="the record has 4 s of attitude, and 10 s are needed"):
        align(part(flight(seed=10), 20.0, 24.1), flight(seed=10))


def test_a_motion_that_only_repeats_itself_is_refused_as_uniform() -> None:
    """A circle of 10 s swung for two minutes has a best lag at every turn."""
    t_s = np.arange(0.0, 120.0, 0.04)
    roll = 0.3 * np.sin(2 * np.pi * t_s / 10.0)
    swinging = AttitudeSeries(t_s, roll, 0.5 * roll, np.zeros(t_s.size))
    with pytest.raises(EvaluationError, match="too short or too uniform"):
        align(AttitudeSeries(t_s + 5.0, roll, 0.5 * roll, np.zeros(t_s.size)), swinging)


def test_needed_height_and_lead_hold_for_noise() -> None:
    """Of 60 pairs of unrelated noise no best lag passes, and it is as high as the best of 600 lags should be."""
    rng = np.random.default_rng(1)
    heights = []
    for _ in range(60):
        pair = [(0.0, rng.normal(0.0, 1.0, (600, 3)), np.ones(600, dtype=bool)) for _ in range(2)]
        peak = correlate(*pair, cell_s=0.1)
        assert not peak.distinct and peak.correlation < peak.needed
        heights.append(peak.correlation / peak.sigma)
    assert np.mean(heights) == pytest.approx(3.1, abs=0.3)  # the expected maximum of 600 Gaussian values
    assert needed_height(1.0, 1000) == pytest.approx(np.sqrt(2 * np.log(1e6)))
    assert needed_lead(1.0, 1000) == pytest.approx(np.log(1e3) / np.sqrt(2 * np.log(1e3)))


def test_body_rates_are_those_of_the_rotation_between_grid_points() -> None:
    """A turn at 0.2 rad/s with 0.5 rad of roll has pitch and yaw rates in body axes, and a gap has none."""
    t_s = np.concatenate([np.arange(0.0, 5.0, 0.05), np.arange(8.0, 12.0, 0.05)])
    turning = AttitudeSeries(t_s, np.full(t_s.size, 0.5), np.zeros(t_s.size), 0.2 * t_s)
    _, rates, known = body_rates(turning, 0.1)
    assert rates[known] == pytest.approx(
        np.tile([0.0, 0.2 * np.sin(0.5), 0.2 * np.cos(0.5)], (int(known.sum()), 1)), abs=1e-6
    )
    assert not known[50:79].any() and known[:49].all()


def test_the_attitude_of_a_real_flight_is_aligned_with_itself_shifted_and_refused_with_another_part(
    data_set: Callable[[str], Path],
) -> None:
    log = read_ardupilot(data_set("logs/log171.bin")).attitude
    for rate_hz in (4.0, 10.0, 50.0):
        record, true_s = telemetry(log, seed=int(rate_hz), rate_hz=rate_hz)
        assert worst_error_s(record, log, true_s) < LIMIT_S
    with pytest.raises(EvaluationError, match="another flight"):
        align(part(log, 75.0, 130.0), part(log, 140.0, 215.0))
