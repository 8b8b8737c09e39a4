"""Home is moved in flight: the heights that ArduPilot's firmware reports then."""

import socket
from pathlib import Path

import pytest
from pilot import HOVER_M, Pilot, kill_terrafix, start_terrafix, take_off
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stationary_copter import HOME, copter, free_port

from terrafix.core.mavlink.home_altitude import TakeOffHeight

pytestmark = pytest.mark.slow
LOWER_M = 30.0


def test_fact_moving_home_in_flight_changes_only_the_relative_height(tmp_path: Path) -> None:
    port, ground_port = free_port(), free_port()
    pilot, running, take_off_height = Pilot(ground_port), start_terrafix(port), TakeOffHeight()

    def reported_heights_m() -> tuple[float, float]:
        """Above home, above mean sea level."""
        position = pilot.newest["GLOBAL_POSITION_INT"]
        return position.relative_alt / 1e3, position.alt / 1e3

    try:
        with copter(tmp_path, {"GPS1_TYPE": 14, "GPS1_DELAY_MS": 5}, port, free_port(socket.SOCK_STREAM), ground_port):
            take_off(pilot)
            pilot.receive_for(3.0)
            before_m = take_off_height.update(*reported_heights_m(), armed=True)
            assert before_m == pytest.approx(HOVER_M, abs=2.0)
            new_home = (0.0, 0.0, 0.0, 0.0, HOME[0], HOME[1], HOME[2] - LOWER_M)
            pilot.wait_for(
                "new home",
                lambda: reported_heights_m()[0] > HOVER_M + 0.5 * LOWER_M,
                lambda: pilot.send_command(mavlink.MAV_CMD_DO_SET_HOME, *new_home),
            )
            assert reported_heights_m()[0] - before_m == pytest.approx(LOWER_M, abs=3.0)
            assert take_off_height.update(*reported_heights_m(), armed=True) == pytest.approx(before_m, abs=1.0)
    finally:
        kill_terrafix(running)
        pilot.close()
