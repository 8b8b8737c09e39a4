"""A user fix as a position of the vehicle."""

import math

import msgspec
import numpy as np
import pytest

from flight_records import ORIGIN, estimate
from terrafix.anchor.relocalization.position_prior import SIGMAS_95
from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.geodesy import quat_from_rot, rot_from_quat, rot_w_b
from terrafix.messages import Camera, NavEstimate
from terrafix_tools.console.compute.steering import fix_message, hint_message
from terrafix_tools.console.payloads import Hint, PixelPoint, UserFix

CAMERA = Camera(width=800, height=600, fx=700.0, fy=710.0, cx=390.0, cy=310.0, mount_yaw_deg=20.0)
FIX_SIGMA_M = 5.0  # of the service contract, RS-11
TRUE_M = np.array([300.0, -120.0])  # where the vehicle is


def turned(found: NavEstimate) -> NavEstimate:
    """With a heading and some tilt."""
    return msgspec.structs.replace(found, q_w_b=quat_from_rot(rot_w_b(math.radians(130.0), 0.1, -0.15)), fragment_id=0)


def pixel_of(found: NavEstimate, place_m: np.ndarray) -> tuple[float, float]:
    """Where the camera of a vehicle at TRUE_M, 100 m above ground, sees a place on the ground."""
    r_w_c = rot_from_quat(found.q_w_b) @ Mount.of(CAMERA).r_b_c()
    u, v = CameraCalibration.of(CAMERA).project((r_w_c.T @ np.array([*(place_m - TRUE_M), -100.0]))[None])[0]
    return float(u), float(v)


def fix(place_m: np.ndarray, frame_id: int = 0) -> UserFix:
    lat, lon = ORIGIN.to_wgs84(*place_m)
    return UserFix(frame_id=frame_id, pixel=PixelPoint(u=1.0, v=1.0), lat=lat, lon=lon)


def test_the_vehicle_is_where_its_camera_sees_the_place_at_the_pixel() -> None:
    seen = turned(estimate(0, 5000.0, 5000.0))  # it believes to be elsewhere
    place_m = TRUE_M + np.array([35.0, 20.0])
    message = fix_message(fix(place_m), pixel_of(seen, place_m), CAMERA, {0: seen}, 7)
    assert message is not None
    assert ORIGIN.to_local(message.lat_deg, message.lon_deg) == pytest.approx(TRUE_M, abs=0.05)
    assert message.t_ns == 7 and message.radius_m > SIGMAS_95 * FIX_SIGMA_M
    assert message.frame_id == 0 and message.sigma_m == pytest.approx(message.radius_m / SIGMAS_95)


def test_a_fix_is_carried_on_by_odometry_within_a_fragment_and_grows_old_without() -> None:
    seen, newest = turned(estimate(0, 0.0, 0.0)), turned(estimate(9, 80.0, 60.0))
    at = pixel_of(seen, TRUE_M)
    carried = fix_message(fix(TRUE_M), at, CAMERA, {0: seen, 9: newest}, 123)
    assert carried is not None and (carried.t_ns, carried.frame_id) == (123, 9)
    assert ORIGIN.to_local(carried.lat_deg, carried.lon_deg) == pytest.approx(TRUE_M + np.array([80.0, 60.0]), abs=0.1)
    elsewhere = msgspec.structs.replace(newest, fragment_id=1)
    left = fix_message(fix(TRUE_M), at, CAMERA, {0: seen, 9: elsewhere}, 123)
    assert left is not None and left.t_ns == seen.t_ns and left.radius_m < carried.radius_m
    assert ORIGIN.to_local(left.lat_deg, left.lon_deg) == pytest.approx(TRUE_M, abs=0.05)


def test_an_error_of_the_tilt_moves_the_place_by_the_height_and_one_of_the_heading_by_the_distance() -> None:
    level = msgspec.structs.replace(estimate(0, 0.0, 0.0), q_w_b=quat_from_rot(rot_w_b(0.0, 0.0, 0.0)))
    place_m = TRUE_M + np.array([60.0, 80.0])
    for update, v, moved_m in (
        ({}, (0, 0, 0), 0.0),
        ({"sigma_m": 2.0}, (1e-4, 4e-4, 0), 4.0),
        ({}, (0, 0, 1e-4), 1.0),
    ):
        seen = msgspec.structs.replace(level, cov=tuple(np.diag([0.0, 0.0, 0.0, *v]).ravel().tolist()))
        given = fix(place_m).model_copy(update=update)
        message = fix_message(given, pixel_of(seen, place_m), CAMERA, {0: seen}, 0)
        expected_m = math.hypot(update.get("sigma_m", FIX_SIGMA_M), moved_m)
        assert message is not None and message.sigma_m == pytest.approx(expected_m, rel=1e-3)


def test_a_frame_without_attitude_and_a_pixel_of_the_sky_give_no_position() -> None:
    level = msgspec.structs.replace(turned(estimate(0, 0.0, 0.0)), q_w_b=quat_from_rot(rot_w_b(0.0, math.pi / 2, 0.0)))
    assert fix_message(fix(TRUE_M, frame_id=3), (400.0, 300.0), CAMERA, {0: level}, 0) is None
    assert fix_message(fix(TRUE_M), (400.0, 300.0), CAMERA, {0: level}, 0) is None


def test_a_hint_keeps_its_radius() -> None:
    message = hint_message(Hint(lat=1.0, lon=2.0, radius_m=300.0), 5)
    assert (message.t_ns, message.lat_deg, message.lon_deg, message.radius_m) == (5, 1.0, 2.0, 300.0)
