"""Prediction of a receiver's offset: p-values, learning of a constant offset, drag-off, steps of our own estimate."""

import math

import numpy as np
import pytest

from link_rig import LAT, LON, MS, SPEED_EAST, S, estimate
from terrafix.link.gnss.offset_predictor import HORIZON_S, OffsetPredictor
from terrafix.link.gnss.predictor_noise import MIN_POSITION_SCALE, PRIOR_SAMPLES, PredictionErrors, PredictorNoise
from terrafix.link.gnss.spoofing_detector import DRAG_P_VALUE, GNSS_JUMP_SIGMAS, SpoofingDetector
from terrafix.link.integrity.output_predictor import InertialBuffer, offset, predict_to
from terrafix.messages import GnssReading, GnssState

DT_S = 0.2
MAP_M = (-9.0, 4.0)  # error of the map, constant over the flight


NO_DRIFT_SIGMA_M = 1e6  # 1-sigma of a drift without information


def p_values(
    predictor: OffsetPredictor,
    offsets: list[complex],
    sigma_m: float = 6.0,
    drifts: list[complex] | None = None,
    drift_sigma_m: float = NO_DRIFT_SIGMA_M,
) -> list[float]:
    moved = drifts or [0j] * len(offsets)
    return [
        predictor.update(offset, sigma_m, drift, drift_sigma_m, DT_S, learn=True)[0]
        for offset, drift in zip(offsets, moved, strict=True)
    ]


def seconds(value_s: float) -> int:
    return round(value_s / DT_S)


def quiet_predictor(drift_sigma_m: float = NO_DRIFT_SIGMA_M) -> OffsetPredictor:
    """-> a predictor after ten minutes without an offset."""
    predictor = OffsetPredictor()
    p_values(predictor, [0j] * seconds(600.0), drift_sigma_m=drift_sigma_m)
    return predictor


def test_the_p_value_is_that_of_a_bivariate_student_t() -> None:
    """Compared with drawn numbers. With the prior alone there are two degrees of freedom for each of its samples."""
    predictor = OffsetPredictor()
    p_values(predictor, [0j] * seconds(HORIZON_S + 2.0), sigma_m=1.0)  # a mean, and no prediction error yet
    rng, freedom = np.random.default_rng(1), 2.0 * PRIOR_SAMPLES
    drawn = rng.normal(size=(400_000, 2)) / np.sqrt(rng.chisquare(freedom, 400_000) / freedom)[:, None]
    distances_m = np.hypot(*drawn.T)
    for limit in (1.0, 2.0, 4.0):
        fresh = OffsetPredictor()
        p_values(fresh, [0j] * seconds(HORIZON_S + 2.0), sigma_m=1.0)
        fresh.clear_pending()
        p_value, error_m = fresh.update(complex(limit, 0.0), 1.0, 0j, NO_DRIFT_SIGMA_M, DT_S, learn=False)
        assert error_m == pytest.approx(limit)
        assert p_value == pytest.approx(float((distances_m > limit).mean()), rel=0.05)


def test_a_constant_offset_is_learnt_and_a_change_of_it_is_detected() -> None:
    predictor, steady = OffsetPredictor(), complex(*MAP_M)
    assert min(p_values(predictor, [steady] * seconds(600.0))) > 0.05  # no alarm
    walking = p_values(predictor, [steady + 1.0 * DT_S * k for k in range(seconds(40.0))])
    detected_s = next(k for k, p_value in enumerate(walking) if p_value < DRAG_P_VALUE) * DT_S
    assert detected_s < 29.0
    distance_m = abs(steady + detected_s)
    assert distance_m < GNSS_JUMP_SIGMAS * 6.0  # the distance test gives no alarm yet


def test_the_drift_against_our_velocity_detects_a_drag_off_earlier() -> None:
    drag = 1.0 * DT_S
    walking, drifts = [drag * k + 0j for k in range(seconds(40.0))], [drag + 0j] * seconds(40.0)
    detected_s = []
    for drift_sigma_m in (NO_DRIFT_SIGMA_M, 18.0):
        predictor = quiet_predictor(drift_sigma_m)
        values = p_values(predictor, walking, drifts=drifts, drift_sigma_m=drift_sigma_m)
        detected_s.append(next(k for k, p_value in enumerate(values) if p_value < DRAG_P_VALUE) * DT_S)
    assert detected_s[1] < detected_s[0] - 2.0


def test_an_offset_without_drift_of_the_receiver_has_a_larger_p_value() -> None:
    """As with a map that is wrong in another place: the offset changes, the receiver has no drift."""
    walking = [0.6 * DT_S * k + 0j for k in range(seconds(40.0))]
    smallest = []
    for drift_sigma_m in (NO_DRIFT_SIGMA_M, 18.0):
        predictor = quiet_predictor(drift_sigma_m)
        smallest.append(min(p_values(predictor, walking, drift_sigma_m=drift_sigma_m)))
    assert smallest[1] > 5.0 * smallest[0]


def test_the_combined_prediction_has_the_variance_of_drawn_errors() -> None:
    """Correlated errors, after many samples: 5 % of the p-values are below 0.05."""
    rng = np.random.default_rng(3)
    mixed = rng.normal(size=(4000, 2)) @ np.array([1.0, 1j])
    position_m = 6.0 * mixed
    drift_m = 12.0 * (0.4 * mixed + math.sqrt(1.0 - 0.4**2) * rng.normal(size=(4000, 2)) @ np.array([1.0, 1j]))
    noise, values = PredictorNoise(), []
    for k, (position, drift) in enumerate(zip(position_m, drift_m, strict=True)):
        errors = PredictionErrors(complex(position), 6.0, complex(drift), 12.0)
        if k >= 2000:
            values.append(noise.p_value(errors)[0])
        noise.update(errors, gain=1.0, keep=1.0)
    for share in (0.05, 0.3):
        assert float(np.mean(np.array(values) < share)) == pytest.approx(share, rel=0.25)


def test_a_drag_off_is_not_learnt_within_the_horizon() -> None:
    predictor = quiet_predictor()
    _, before_m = predictor.update(10.0 + 0j, 6.0, 0j, NO_DRIFT_SIGMA_M, DT_S, learn=True)
    p_values(predictor, [10.0 + 0j] * seconds(HORIZON_S - 5.0))
    _, after_m = predictor.update(10.0 + 0j, 6.0, 0j, NO_DRIFT_SIGMA_M, DT_S, learn=True)
    assert before_m is not None and after_m is not None
    assert after_m == pytest.approx(10.0, abs=0.1) and before_m < after_m  # first after the low-pass, then in full


def test_after_a_flight_with_small_errors_the_claimed_error_is_still_no_alarm() -> None:
    """Three times the claimed sigma is no drag-off, however small the errors were before."""
    predictor = OffsetPredictor()
    p_values(predictor, [0j] * seconds(3000.0))
    values = p_values(predictor, [complex(3.0 * 6.0, 0.0)] * seconds(10.0))
    assert min(values) > DRAG_P_VALUE
    # The lower limit of the scale ensures this for any number of samples.
    assert MIN_POSITION_SCALE * math.sqrt(-2.0 * math.log(DRAG_P_VALUE)) > 3.0


def test_after_an_interval_with_a_large_sigma_there_is_no_false_alarm() -> None:
    predictor = quiet_predictor()
    drift = [complex(0.5 * DT_S * k, 0.0) for k in range(seconds(60.0))]
    blind = [predictor.update(x, math.hypot(6.0, abs(x)), 0j, NO_DRIFT_SIGMA_M, DT_S, learn=True)[0] for x in drift]
    back = p_values(predictor, [0j] * seconds(120.0))
    assert min(blind + back) > 0.01


def detector_states(
    detector: SpoofingDetector, begin_s: float, end_s: float, east_m: float, ours_m: float, step_m: float = 0.0
) -> set[GnssState]:
    """-> states of the detector over readings at 5 Hz with an error of ``east_m``. Each reading has a new estimate with
    an error of ``ours_m``, a sigma of 6 m and a recent step of ``step_m``."""
    states = set()
    for k in range(seconds(begin_s), seconds(end_s)):
        t_ns = round(k * DT_S * S)
        vision = predict_to(estimate(t_ns - 50 * MS, sigma_m=6.0, east_m=ours_m), t_ns, InertialBuffer())
        lat, lon = offset(LAT, LON, SPEED_EAST * t_ns / S + east_m, 0.0)
        place = {"lat_deg": lat, "lon_deg": lon, "horizontal_m": 1.3}
        reading = GnssReading(t_ns=t_ns, receiver=0, fix_type=3, speed_mps=SPEED_EAST, satellites=14, **place)
        states.add(detector.update(reading, vision, step_m).state)
    return states


def test_after_a_step_of_the_estimate_the_offset_is_learnt_again() -> None:
    """As at the border of two maps: the estimate steps by 26 m, within its claim."""
    detector = SpoofingDetector()
    detector_states(detector, 0.0, 900.0, 1.0, 0.0)
    moved = detector_states(detector, 900.0, 910.0, 1.0, 27.0, step_m=27.0) | detector_states(
        detector, 910.0, 1000.0, 1.0, 27.0
    )
    assert moved == {GnssState.TRUSTED}
    without_step = SpoofingDetector()  # the same distance, without a step of the estimate
    detector_states(without_step, 0.0, 900.0, 1.0, 0.0)
    assert GnssState.SPOOFED in detector_states(without_step, 900.0, 910.0, 27.0, 0.0)
