"""Time offset between frames and telemetry, from turns that both observe."""

import math

import msgspec
import numpy as np
import pytest

from simulated_flight import ORIGIN, EstimatorRun, Flight, blind, cov_of, t_ns
from terrafix.core.geodesy import yaw_of
from terrafix.estimator.integrity.time_offset import GRID_S, MAX_SLEW, PRIOR_SIGMA_S, TimeOffset, Turn
from terrafix.estimator.measurements.telemetry_buffer import Telemetry
from terrafix.estimator.pose_estimator import EstimatedFlight
from terrafix.messages import Odometry, Prediction, VehicleState

FRAME_S, TELEMETRY_S = 0.5, 0.1


def heading_rad(t_s: np.ndarray, turns: bool) -> np.ndarray:
    """A course with turns of 30 degrees/s for two seconds, every nine; or none."""
    return np.asarray(math.radians(30.0) * (2.0 * (t_s // 9.0) + np.clip(t_s % 9.0, 0.0, 2.0)) * turns)


SECONDS = 60.0


def attitude(t_s: float, yaw_rad: float) -> VehicleState:
    yaw_rad = math.remainder(yaw_rad, math.tau)
    return VehicleState(t_ns=round(t_s * 1e9), source="test", yaw_rad=yaw_rad, pitch_rad=0.0, roll_rad=0.0)


def flown(
    late_s: float, *, turns: bool = True, noise_deg: float = 0.3, seed: int = 1, every_s: float = FRAME_S
) -> TimeOffset:
    """Frames with time stamps ``late_s`` after the exposure."""
    rng = np.random.default_rng(seed)
    telemetry, offset = Telemetry(), TimeOffset()
    reported_s, frame_s = np.arange(0.0, SECONDS, TELEMETRY_S), np.arange(3.0, SECONDS, every_s)
    yaw = heading_rad(reported_s, turns) + np.radians(noise_deg) * rng.normal(size=len(reported_s))
    seen = np.unwrap(heading_rad(frame_s - late_s, turns)) + np.radians(0.1) * rng.normal(size=len(frame_s))
    at = 0
    for i, t_s in enumerate(frame_s):
        while at < len(reported_s) and reported_s[at] <= t_s:
            telemetry.add(attitude(float(reported_s[at]), float(yaw[at])))
            at += 1
        if i:
            turn_rad = math.remainder(float(seen[i] - seen[i - 1]), math.tau)
            offset.add(Turn(round(frame_s[i - 1] * 1e9), round(t_s * 1e9), turn_rad), telemetry)
        offset.step(every_s)
    return offset


@pytest.mark.parametrize("late_s", [1.0, 0.4, -0.5])
@pytest.mark.parametrize("noise_deg", [0.3, 2.0])
def test_a_time_offset_is_estimated_and_applied(late_s: float, noise_deg: float) -> None:
    offset = flown(late_s, noise_deg=noise_deg)
    mean_s, sigma_s = offset.estimate
    assert mean_s == pytest.approx(late_s, abs=max(3.0 * sigma_s, 0.06))
    assert offset.applied_s == pytest.approx(late_s, abs=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_an_insignificant_time_offset_is_not_applied(seed: int) -> None:
    offset = flown(0.02, seed=seed)
    assert offset.applied_s == 0.0 and abs(offset.estimate[0]) < 3.0 * PRIOR_SIGMA_S


def test_a_straight_flight_gives_no_time_offset() -> None:
    offset = flown(1.0, turns=False)
    assert offset.applied_s == 0.0 and offset.sigma_s == pytest.approx(PRIOR_SIGMA_S)


def test_compass_noise_without_turns_gives_no_time_offset() -> None:
    assert flown(0.0, turns=False, noise_deg=5.0).applied_s == 0.0


def test_the_slew_rate_of_the_applied_offset_is_limited() -> None:
    offset = flown(1.0)
    before_s = offset.applied_s
    offset._residual2, offset._count = np.zeros_like(offset._residual2), 0.0  # clears the evidence
    offset.step(FRAME_S)
    assert offset.applied_s == pytest.approx(before_s - MAX_SLEW * FRAME_S)


def test_pending_turns_are_dropped_if_no_heading_is_reported() -> None:
    telemetry, offset = Telemetry(), TimeOffset()
    for i in range(1000):
        offset.add(Turn(i * 10**9, (i + 1) * 10**9, 0.5), telemetry)
    assert offset.applied_s == 0.0 and len(offset._pending) < 6


def test_a_time_offset_is_estimated_at_60_frames_per_second() -> None:
    assert flown(1.0, every_s=1.0 / 60.0).applied_s == pytest.approx(1.0, abs=0.1)


class LateCamera(TimeOffset):
    """Estimates an offset of a second with certainty, and stores the added turns."""

    def __init__(self) -> None:
        super().__init__()
        self.turns: list[Turn] = []

    @property
    def estimate(self) -> tuple[float, float]:
        return 1.0, 0.01

    def add(self, turn: Turn, telemetry: Telemetry) -> None:
        self.turns.append(turn)


def flight_of(run: EstimatorRun) -> EstimatedFlight:
    flight = run.node._flight
    assert flight is not None
    return flight


def test_the_node_shifts_frame_times_by_the_slew_limited_offset_and_adds_turns_at_the_stamps() -> None:
    flight, late = Flight(30, seed=3), LateCamera()
    listener = EstimatorRun().fly(flight, 0, 10)
    flight_of(listener).time_offset = late
    listener.fly(flight, 10, 30)
    shifted_s = [(t_ns(i) - listener.estimate(i).t_ns) * 1e-9 for i in range(10, 30)]
    assert shifted_s == pytest.approx([min(MAX_SLEW * 0.5 * (i + 1), 1.0) for i in range(20)])
    assert [(turn.t0_ns, turn.t1_ns) for turn in late.turns] == [(t_ns(i - 1), t_ns(i)) for i in range(10, 30)]


def test_the_node_adds_the_turns_of_the_camera_except_beside_untracked_frames() -> None:
    """Between and within keyframes, across north; none beside a frame without tracking."""
    flight, late, dark = Flight(50, seed=3, turn_rad=-4.0), LateCamera(), 25
    listener = EstimatorRun().fly(flight, 0, 10)
    flight_of(listener).time_offset = late
    for i in range(10, 50):
        listener.feed([blind(m) if isinstance(m, Odometry) and i == dark else m for m in flight.messages(i)])
    heading_rad = {t_ns(i): yaw_of(r) for i, r in enumerate(flight.r_w_b)}
    off_rad = [
        math.remainder(turn.yaw_rad - heading_rad[turn.t1_ns] + heading_rad[turn.t0_ns], math.tau)
        for turn in late.turns
    ]
    assert np.abs(off_rad).max() < 0.05
    assert max(abs(turn.yaw_rad) for turn in late.turns) > 0.9
    assert {turn.t1_ns for turn in late.turns} == {t_ns(i) for i in range(10, 50) if i not in (dark, dark + 1)}


class KnownTo(TimeOffset):
    """An offset of zero with ``one_sigma_s``; ``unstamped``: probability of a camera that does not stamp its frames."""

    def __init__(self, one_sigma_s: float, unstamped: float) -> None:
        super().__init__()
        self._known = one_sigma_s, unstamped

    @property
    def density(self) -> tuple[np.ndarray, float]:
        one_sigma_s, unstamped = self._known
        density = np.exp(-0.5 * (GRID_S / one_sigma_s) ** 2)
        return density / density.sum(), unstamped


@pytest.mark.parametrize(("unstamped", "sigma_s"), [(0.01, PRIOR_SIGMA_S), (0.2, 0.3)])
def test_the_uncertainty_of_the_time_offset_inflates_the_covariance_along_the_velocity(
    unstamped: float, sigma_s: float
) -> None:
    flight, covs_m2 = Flight(12, seed=3), []
    for offset in (KnownTo(0.3, unstamped), KnownTo(0.03, 0.0)):
        listener = EstimatorRun().fly(flight, 0, 11)
        flight_of(listener).time_offset = offset
        covs_m2.append(cov_of(listener.fly(flight, 11, 12).estimate(11))[:2, :2])
        left_s2 = offset.sigma_s**2
    way_m = (flight.p_m[11] - flight.p_m[10])[:2]
    along = way_m / np.linalg.norm(way_m)
    across = np.array([along[1], -along[0]])
    grown_m2 = covs_m2[0] - covs_m2[1]
    assert along @ grown_m2 @ along == pytest.approx((sigma_s**2 - left_s2) * 12.0**2, rel=0.1, abs=0.01)
    assert across @ grown_m2 @ across == pytest.approx(0.0, abs=0.05)


def test_a_new_origin_resets_the_time_offset() -> None:
    flight, late = Flight(12, seed=3), LateCamera()
    listener = EstimatorRun().fly(flight, 0, 2)
    flight_of(listener).time_offset = late
    listener.fly(flight, 2, 12)
    assert late.applied_s > 0.5
    listener.feed([msgspec.structs.replace(ORIGIN, start_sigma_m=20.0)])
    listener.fly(flight, 10, 12)
    assert listener.estimate(11).t_ns == t_ns(11)
    first = [m for m in listener.published if isinstance(m, Prediction) and m.frame_id == 10][-1]
    assert np.hypot(*first.step_m) < 1e-9


def test_a_mount_pitch_error_is_not_taken_for_a_time_offset() -> None:
    """A mount pitch error of 4 degrees changes the visual turn of a plane by -2.3 degrees when it rolls into a turn,
    and by +2.3 degrees when it rolls out."""

    rng, telemetry, offset = np.random.default_rng(5), Telemetry(), TimeOffset()
    t_s = np.arange(0.0, 120.0, TELEMETRY_S)
    rate = np.interp(t_s % 12.0, [0.0, 1.0, 5.0, 6.0], [0.0, math.radians(12.0), math.radians(12.0), 0.0])
    yaw, roll = np.cumsum(rate) * TELEMETRY_S, np.arctan(22.0 * rate / 9.81)
    noise = np.radians(0.3) * rng.normal(size=len(t_s))
    for at, reported, rolled in zip(t_s, yaw + noise, roll, strict=True):
        state = attitude(float(at), float(reported))
        telemetry.add(msgspec.structs.replace(state, roll_rad=float(rolled)))
        if round(at * 10) % 10 == 5 and at > 1.0:
            i, j = round((at - 1.0) * 10), round(at * 10)
            seen = yaw[j] - yaw[i] - math.radians(4.0) * (math.sin(roll[j]) - math.sin(roll[i]))
            offset.add(Turn(round((at - 1.0) * 1e9), round(at * 1e9), float(seen)), telemetry)
            offset.step(1.0)
    assert offset.applied_s == 0.0 and offset.sigma_s < 0.1
