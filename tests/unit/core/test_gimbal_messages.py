"""Attitudes of gimbals in MAVLink messages, against the quaternions and Euler angles of pymavlink."""

import math
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.quaternion import QuaternionBase

from terrafix.core.geodesy import rot_from_quat
from terrafix.core.mavlink.gimbal import ATTITUDE_MESSAGES, MANAGER_MESSAGE, GimbalReader, yaw_is_from_north
from terrafix.core.mavlink.tlog import TelemetryLog, record
from terrafix.messages import GimbalAttitude

VEHICLE, EARTH = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME, mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
LOCK = mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK
# Roll, pitch, yaw [degrees], straight down and beyond among them
ANGLES = [(0, -90, 0), (0, -90, 130), (3, -88, -170), (-20, -45, 10), (0, 0, 90), (180, -89, 179), (5, -60, -91)]


def on_wire(message: mavlink.MAVLink_message, component: int = 1) -> mavlink.MAVLink_message:
    """``message`` as a peer decodes it."""
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=component)
    return mavlink.MAVLink(None).decode(bytearray(message.pack(sender)))


def device_status(
    q: QuaternionBase, flags: int = EARTH, *, component: int = 1, device: int = 0, failure: int = 0
) -> mavlink.MAVLink_message:
    numbers = [float(value) for value in q]
    message = mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, 1000, flags, numbers, 0, 0, 0, failure, math.nan, math.nan, device
    )
    return on_wire(message, component)


def of_angles(roll: float, pitch: float, yaw: float) -> QuaternionBase:
    return QuaternionBase(np.radians([roll, pitch, yaw]))


def read(*messages: mavlink.MAVLink_message) -> GimbalAttitude | None:
    reader, found = GimbalReader(), None
    for message in messages:
        found = reader.take(message, 7)
    return found


def orientation(roll: float, pitch: float, yaw: float) -> mavlink.MAVLink_message:
    return on_wire(mavlink.MAVLink_mount_orientation_message(0, roll, pitch, yaw, 0.0))


def status(roll: float, pitch: float, yaw: float) -> mavlink.MAVLink_message:
    hundredths = (round(100 * angle) for angle in (pitch, roll, yaw))
    return on_wire(mavlink.MAVLink_mount_status_message(0, 0, *hundredths))


@pytest.mark.parametrize("angles", ANGLES)
def test_an_attitude_is_the_rotation_of_pymavlinks_quaternion(angles: tuple[float, float, float]) -> None:
    q = of_angles(*angles)
    for message, tolerance in ((device_status(q), 1e-6), (orientation(*angles), 1e-6), (status(*angles), 2e-4)):
        found = read(message)
        assert found is not None and found.t_ns == 7
        np.testing.assert_allclose(rot_from_quat(found.q), np.array(q.dcm), atol=tolerance)


def test_the_flags_say_from_where_yaw_counts() -> None:
    from_north = {EARTH: True, VEHICLE: False, LOCK: True, 0: False, VEHICLE | LOCK: False, EARTH | LOCK: True}
    assert {flags: yaw_is_from_north(flags) for flags in from_north} == from_north
    assert [found.from_north for f in from_north if (found := read(device_status(of_angles(0, -90, 0), f)))] == [
        *from_north.values()
    ]


def test_a_failed_gimbal_and_an_impossible_attitude_report_nothing() -> None:
    q = of_angles(0, -90, 0)
    assert read(device_status(q, failure=mavlink.GIMBAL_DEVICE_ERROR_FLAGS_ENCODER_ERROR)) is None
    assert read(device_status(q, failure=mavlink.GIMBAL_DEVICE_ERROR_FLAGS_AT_PITCH_LIMIT)) is not None
    assert (
        read(on_wire(mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, EARTH, [0] * 4, 0, 0, 0, 0)))
        is None
    )
    nan = [math.nan] * 4
    assert read(on_wire(mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, EARTH, nan, 0, 0, 0, 0))) is None
    assert read(orientation(0, math.nan, 0)) is None


def test_the_message_that_says_most_counts() -> None:
    q = of_angles(0, -90, 40)
    assert read(device_status(q), orientation(0, -80, 0)) is None
    assert read(orientation(0, -80, 0), status(0, -70, 0)) is None
    assert read(status(0, -70, 0), orientation(0, -80, 0), device_status(q)) is not None


def test_a_device_is_named_by_number_or_component_and_the_managers_one_counts() -> None:
    q = of_angles(0, -90, 0)
    manager = on_wire(mavlink.MAVLink_gimbal_manager_status_message(0, 0, 171, 0, 0, 0, 0))
    assert [
        found.device for m in (device_status(q, device=2), device_status(q, component=154)) if (found := read(m))
    ] == [
        2,
        154,
    ]
    both = (device_status(q, component=154), device_status(q, component=171))
    assert read(manager, *both) is not None
    assert read(manager, *reversed(both)) is None
    assert read(manager, both[0]) is not None  # the one that it names was never heard


def test_message_ids_are_those_of_the_dialect() -> None:
    assert {name: mavlink.mavlink_map[number].msgname for name, number in ATTITUDE_MESSAGES.items()} == {
        name: name for name in ATTITUDE_MESSAGES
    }
    assert mavlink.mavlink_map[MANAGER_MESSAGE].msgname == "GIMBAL_MANAGER_STATUS"


def test_a_log_gives_the_gimbal_of_its_vehicle_and_no_other(tmp_path: Path) -> None:
    def packet(message: mavlink.MAVLink_message, system: int, component: int) -> bytes:
        return bytes(message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component)))

    beat = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3
    )
    attitude = mavlink.MAVLink_attitude_message(1000, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
    down, up = device_status(of_angles(0, -90, 20)), device_status(of_angles(0, 0, 0))
    sent = [(beat, 1, 1), (attitude, 1, 1), (down, 1, 154), (up, 1, 100), (up, 2, 154), (down, 1, 154)]
    log = tmp_path / "telemetry.tlog"
    log.write_bytes(b"".join(record(10**15 + i * 100_000, packet(*one)) for i, one in enumerate(sent)))
    found = TelemetryLog(log).gimbal
    assert [attitude.t_ns for attitude in found] == [200_000_000, 500_000_000]
    np.testing.assert_allclose(rot_from_quat(found[0].q), np.array(of_angles(0, -90, 20).dcm), atol=1e-6)
