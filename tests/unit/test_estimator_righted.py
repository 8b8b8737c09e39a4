"""An autopilot that puts its attitude right: seen by its gyroscopes, and not believed as one that does not."""

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from inertial_flight import InertialFlight, flown

from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import log_so3
from terrafix.estimator.righted import GYROSCOPE_RADPS, Righted
from terrafix.estimator.telemetry import Telemetry
from terrafix.estimator.velocity import TILT_S
from terrafix.messages import Imu, VehicleState

S = 1_000_000_000
HZ = 50
SIGMA_RAD = math.radians(0.7)


def flew(seconds: float, off: Callable[[float], float], imu_from_s: float = 0.0) -> Telemetry:
    """A plane that rolls into turns, with true gyroscopes and an attitude whose roll is ``off`` [rad]."""

    def angles(t: float) -> tuple[float, float, float]:
        return 1.0 + 0.4 * t, 0.05 * math.sin(t), 0.6 * math.sin(0.8 * t)

    telemetry, step_s = Telemetry(), 1.0 / HZ
    for i in range(round(seconds * HZ) + 1):
        t = i * step_s
        yaw, pitch, roll = angles(t)
        heard = VehicleState(
            t_ns=round(t * S),
            source="test",
            yaw_rad=math.remainder(yaw, math.tau),
            pitch_rad=pitch,
            roll_rad=roll + off(t),
        )
        telemetry.add(heard)
        before, after = rot_w_b(*angles(t - step_s)), rot_w_b(*angles(t + step_s))
        rates = log_so3(before.T @ after) / (2 * step_s)
        if t >= imu_from_s:
            sample = (0, 0.0, 0.0, -9.81, *(float(rate) for rate in rates))
            telemetry.add_imu(Imu(t_ns=round(t * S), source="test", samples=[sample]))
    return telemetry


def test_what_gyroscopes_felt_is_no_correction() -> None:
    telemetry = flew(10.0, lambda t: 0.0)
    turned = [telemetry.turned_otherwise(round(t * S), round((t + 0.5) * S)) for t in np.arange(0.0, 9.5, 0.37)]
    assert max(float(np.hypot(*way)) for way in turned if way is not None) < math.radians(0.05)
    assert all(way is not None for way in turned)


def test_what_they_did_not_is_one() -> None:
    telemetry = flew(6.0, lambda t: math.radians(2.0) * max(0.0, t - 3.0))
    assert np.hypot(*telemetry.turned_otherwise(S, 3 * S)) < math.radians(0.05)  # type: ignore[misc]
    way = telemetry.turned_otherwise(3 * S, 4 * S)
    assert way is not None and math.degrees(np.hypot(*way)) == pytest.approx(2.0, abs=0.1)
    ahead = 1.0 + 0.4 * 3.5  # it rolls about where it heads; what it is off by then turns with it
    assert math.sin(ahead) * way[0] + math.cos(ahead) * way[1] > 0.95 * np.hypot(*way)


def test_who_did_not_hear_all_of_it_does_not_know() -> None:
    telemetry = flew(6.0, lambda t: 0.0, imu_from_s=3.0)
    assert telemetry.turned_otherwise(2 * S, 4 * S) is None
    assert telemetry.turned_otherwise(4 * S, 9 * S) is None
    assert telemetry.turned_otherwise(4 * S, 4 * S) is None
    assert telemetry.turned_otherwise(4 * S, 5 * S) is not None


def farthest_deg(seconds: float, off: Callable[[float], float]) -> list[float]:
    telemetry, righted = flew(seconds, off), Righted()
    return [math.degrees(righted.rad(round(t * S), telemetry, SIGMA_RAD)) for t in np.arange(0.0, 7.9, 0.5)]


def test_a_correction_counts_when_it_is_more_than_the_claim_and_the_gyroscopes_explain() -> None:
    assert max(farthest_deg(8.0, lambda t: 0.9 * GYROSCOPE_RADPS * t)) == 0.0
    assert max(farthest_deg(8.0, lambda t: 0.9 * 2.0 * SIGMA_RAD * math.sin(min(t, 1.5)))) == 0.0
    moved = farthest_deg(8.0, lambda t: math.radians(6.0) * min(max(t - 3.0, 0.0), 1.0))
    assert max(moved[:7]) == 0.0 and moved[8] == pytest.approx(5.6, abs=0.3)
    there_and_back = farthest_deg(8.0, lambda t: math.radians(6.0) * math.sin(min(max(t - 3.0, 0.0), math.pi)))
    assert there_and_back[-1] == pytest.approx(max(there_and_back), rel=0.2), "it was wrong a moment ago"


def test_it_is_forgotten() -> None:
    telemetry = flew(7.9, lambda t: math.radians(6.0) * math.sin(min(max(t - 1.0, 0.0), math.pi)))
    righted = Righted()
    for t in np.arange(0.0, 7.9, 0.5):
        last = righted.rad(round(t * S), telemetry, SIGMA_RAD)
    assert last > math.radians(4.0)
    assert righted.rad(round((4.6 + TILT_S) * S), telemetry, SIGMA_RAD) == 0.0


def swaying(flight: InertialFlight, sway_deg: float) -> InertialFlight:
    """From 20 s on its attitude rolls to and fro every 8 s, and it does not."""
    for said in flight.said:
        for i, message in enumerate(said):
            since_s = message.t_ns / S - 20.0
            if isinstance(message, VehicleState) and message.roll_rad is not None and since_s > 0.0:
                off_rad = math.radians(sway_deg) * math.sin(math.tau * since_s / 8.0)
                said[i] = msgspec.structs.replace(message, roll_rad=message.roll_rad + off_rad)
    return flight


@pytest.mark.slow
@pytest.mark.parametrize("sway_deg", [5.0, 10.0])
def test_velocity_from_an_attitude_that_sways_claims_no_more_than_it_knows(sway_deg: float) -> None:
    seen = flown(swaying(InertialFlight(1), sway_deg), imu=True)
    error_mps, sigma_mps = np.hypot(*seen.velocity_error_mps[22:, :2].T), seen.velocity_sigma_mps[22:]
    assert np.mean(error_mps > 3.0 * sigma_mps) < 0.05  # 30 to 50 % for who believes the attitude
    assert np.mean(np.square(error_mps / sigma_mps)) < 2.0 * 1.5


@pytest.mark.slow
def test_who_is_not_put_right_is_believed_as_before() -> None:
    seen = flown(InertialFlight(1), imu=True)
    assert float(np.median(seen.velocity_sigma_mps[22:])) < 0.4
