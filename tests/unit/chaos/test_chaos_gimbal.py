"""What the rig of the fault matrix gives a camera on a gimbal: its description, and the reports of the autopilot."""

from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.geodesy import LocalFrame
from terrafix.core.mavlink.gimbal import GimbalReader
from terrafix.messages import Gimbal
from terrafix.vision.sources.description import camera_of, read_description
from terrafix_lab.chaos.camera import camera_toml
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.camera.mount import mount_of
from terrafix_lab.sim.flights.folder import CAMERA, ON_GIMBAL
from terrafix_lab.sim.interfaces import State, navigation_of
from terrafix_lab.sim.sensors.suite import VehicleSensors

PLACE = LocalFrame(48.0, 11.0)
STILL = np.zeros(3)
BANKED = State(0.0, np.array([0.0, 0.0, 620.0]), STILL, 0.5, 0.1, -0.4, 100.0, STILL, STILL, 12.0)


def test_a_camera_on_a_gimbal_is_described_as_on_one_and_a_fixed_one_as_fixed(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(camera_toml(ON_GIMBAL))
    held = camera_of(path, read_description(path)).gimbal
    assert isinstance(held, Gimbal) and held.required
    path.write_text(camera_toml(CAMERA))
    assert not isinstance(camera_of(path, read_description(path)).gimbal, Gimbal)


def test_the_simulated_autopilot_reports_a_gimbal_that_looks_down_while_the_vehicle_banks() -> None:
    sensors = VehicleSensors(PLACE, mount=mount_of(ON_GIMBAL))
    autopilot = SimAutopilot(PLACE, Kind.COPTER, start=navigation_of(BANKED), home_amsl_m=520.0)
    sender, reader = mavlink.MAVLink(None, srcSystem=255, srcComponent=190), GimbalReader()
    asked = mavlink.MAVLink_command_long_message(
        1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS, 2e5,
        0, 0, 0, 0, 0,
    )  # fmt: skip
    autopilot.receive(bytes(asked.pack(sender)), 0.0)
    autopilot.step(0.0, sensors.read(BANKED))
    sent = mavlink.MAVLink(None).parse_buffer(autopilot.transmit()) or []
    (found,) = [held for message in sent if (held := reader.take(message, 0)) is not None]
    w, x, y, z = found.q
    assert found.from_north and 2.0 * (x * z - w * y) == pytest.approx(1.0, abs=1e-3)  # its view is straight down
