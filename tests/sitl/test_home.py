"""Home is moved in flight: what ArduPilot's own firmware says of its height then."""

import socket
from pathlib import Path

import pytest
from pilot import HOVER_M, Pilot, end, fly_up, terrafix
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from standing_copter import HOME, copter, free_port

from terrafix.core.mavlink.home_altitude import TakeOffHeight

pytestmark = pytest.mark.slow
LOWER_M = 30.0


def test_fact_home_that_is_moved_in_flight_moves_the_relative_height_alone(tmp_path: Path) -> None:
    port, ground_port = free_port(), free_port()
    pilot, running, above = Pilot(ground_port), terrafix(port), TakeOffHeight()

    def said() -> tuple[float, float]:
        position = pilot.newest["GLOBAL_POSITION_INT"]
        return position.relative_alt / 1e3, position.alt / 1e3

    try:
        with copter(tmp_path, {"GPS1_TYPE": 14, "GPS1_DELAY_MS": 5}, port, free_port(socket.SOCK_STREAM), ground_port):
            fly_up(pilot)
            pilot.listen(3.0)
            before_m = above.above(*said(), armed=True)
            assert before_m == pytest.approx(HOVER_M, abs=2.0)
            boat = (0.0, 0.0, 0.0, 0.0, HOME[0], HOME[1], HOME[2] - LOWER_M)
            pilot.until(
                "another home",
                lambda: said()[0] > HOVER_M + 0.5 * LOWER_M,
                lambda: pilot.order(mavlink.MAV_CMD_DO_SET_HOME, *boat),
            )
            assert said()[0] - before_m == pytest.approx(LOWER_M, abs=3.0)
            assert above.above(*said(), armed=True) == pytest.approx(before_m, abs=1.0)
    finally:
        end(running)
        pilot.close()
