"""Height from the barometer's pressure: our velocity, which moves the autopilot's filter, does not come back in it."""

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import NO_FIX
from link_wire import MemoryWire, attitude, packed, states
from terrafix.core.config import LinkSection
from terrafix.link.autopilot.checkpoint import CheckpointWriter
from terrafix.link.autopilot.pressure_height import FRESH_NS, PressureHeight, isa_height_m
from terrafix.link.edge import MavlinkEdge
from terrafix.link.mavlink.message_rates import wanted_of

S, MS = 1_000_000_000, 1_000_000
FIELD_HPA = 955.0  # some 500 m above the sea


def pressure_at(above_m: float) -> float:
    """By the barometric formula of the standard atmosphere, the other way round."""
    return float(1013.25 * (1.0 - (isa_height_m(FIELD_HPA) + above_m) / 44_330.77) ** (1.0 / 0.190263))


@pytest.mark.parametrize(
    ("hpa", "height_m"),
    [(1013.25, 0.0), (954.61, 500.0), (898.75, 1000.0), (701.08, 3000.0)],  # ICAO Doc 7488, table of the atmosphere
)
def test_heights_are_those_of_the_standard_atmosphere(hpa: float, height_m: float) -> None:
    assert isa_height_m(hpa) == pytest.approx(height_m, abs=0.6)


class Vehicle:
    """An autopilot on a wire in memory, with a height of its filter and one of its barometer."""

    def __init__(self, kept: Path | None = None) -> None:
        self.wire, self.mav = MemoryWire(), mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        self.kept, self.seconds, self.booted_s = kept, 100.0, 0.0
        self.restart()

    def restart(self) -> None:
        """Of the link."""
        self.edge = MavlinkEdge(LinkSection(), self.wire, lambda: 0, keeper=CheckpointWriter(self.kept))

    def sends(
        self, filter_m: float | None, above_m: float | None, *, armed: bool, seconds: float = 1.0
    ) -> float | None:
        """-> the height that comes of it, at the end."""
        said: list[Any] = []
        for _ in range(round(seconds * 5)):
            self.seconds += 0.2
            boot_ms, ardupilot = round((self.seconds - self.booted_s) * 1e3), mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
            said = [mavlink.MAVLink_heartbeat_message(2, ardupilot, 128 if armed else 0, 0, 4, 3)]
            if above_m is not None:
                said.append(mavlink.MAVLink_scaled_pressure_message(boot_ms, pressure_at(above_m), 0.0, 3500))
            if filter_m is not None:
                heights = (round(500e3 + filter_m * 1e3), round(filter_m * 1e3))
                said.append(mavlink.MAVLink_global_position_int_message(boot_ms, 1, 2, *heights, 0, 0, 0, 0))
            self.wire.arrive(*(packed(x, self.mav) for x in (*said, attitude(boot_ms))))
            heights = [state.agl_m for state in states(self.edge.poll(round(self.seconds * S)))]
        return heights[-1]


def test_a_filter_that_is_led_astray_by_our_velocity_does_not_move_the_height() -> None:
    vehicle = Vehicle()
    vehicle.sends(0.0, 0.0, armed=False, seconds=10.0)
    assert vehicle.sends(50.0, 50.0, armed=True) == pytest.approx(50.0, abs=0.1)
    for astray_m in range(1, 20):
        assert vehicle.sends(50.0 + astray_m, 50.0, armed=True) == pytest.approx(50.0, abs=0.1)


def test_without_pressure_it_is_the_height_of_the_filter() -> None:
    vehicle = Vehicle()
    vehicle.sends(0.0, 0.0, armed=False)
    assert vehicle.sends(60.0, 50.0, armed=True) == pytest.approx(50.0, abs=0.1)
    assert vehicle.sends(60.0, None, armed=True, seconds=2.0) == 60.0
    assert vehicle.sends(60.0, 50.0, armed=True) == pytest.approx(50.0, abs=0.1)


def test_without_the_filter_it_goes_on_by_pressure() -> None:
    vehicle = Vehicle()
    vehicle.sends(0.0, 0.0, armed=False)
    vehicle.sends(50.0, 50.0, armed=True)
    assert vehicle.sends(None, 60.0, armed=True, seconds=3.0) == pytest.approx(60.0, abs=0.1)


def test_on_the_ground_the_zero_follows_the_weather() -> None:
    vehicle = Vehicle()
    vehicle.sends(0.0, 0.0, armed=False)
    vehicle.sends(0.0, 8.0, armed=False, seconds=60.0)  # the pressure has fallen by 1 hPa
    assert vehicle.sends(50.0, 58.0, armed=True) == pytest.approx(50.0, abs=0.1)


def test_one_bad_reading_on_the_ground_does_not_become_the_zero() -> None:
    height = PressureHeight()
    for i in range(100):
        height.read(pressure_at(20.0 if i == 99 else 0.0), i * 200 * MS)
        height.align(0.0, False, i * 200 * MS)
    height.read(pressure_at(50.0), 21 * S)
    assert height.height_m(21 * S) == pytest.approx(48.0, abs=0.1)  # a tenth of it


def test_a_link_that_is_started_in_the_air_takes_its_zero_from_the_filter_once() -> None:
    vehicle = Vehicle()
    assert vehicle.sends(53.0, 50.0, armed=True) == pytest.approx(53.0, abs=0.1)
    assert vehicle.sends(80.0, 60.0, armed=True) == pytest.approx(63.0, abs=0.1)


def test_an_autopilot_that_has_rebooted_has_heights_of_its_own() -> None:
    vehicle = Vehicle()
    vehicle.sends(0.0, 0.0, armed=False)
    assert vehicle.sends(50.0, 50.0, armed=True) == pytest.approx(50.0, abs=0.1)
    vehicle.booted_s = vehicle.seconds
    assert vehicle.sends(3.0, 50.0, armed=True, seconds=3.0) == pytest.approx(3.0, abs=0.1)


def test_a_link_that_is_started_again_keeps_the_zero_of_the_ground(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "link.checkpoint")
    vehicle.sends(0.0, 0.0, armed=False)
    vehicle.sends(55.0, 50.0, armed=True)
    vehicle.edge.heard(NO_FIX)
    vehicle.restart()
    assert vehicle.sends(55.0, 50.0, armed=True) == pytest.approx(50.0, abs=0.1)


@pytest.mark.parametrize("armed", [True, None])
def test_the_zero_stays_while_it_flies_or_may_fly(armed: bool | None) -> None:
    height = PressureHeight(zero_m=100.0)
    height.read(1000.0, 0)
    height.align(5.0, armed, 0)
    assert height.zero_m == 100.0


@pytest.mark.parametrize("hpa", [0.0, -3.0, 199.0, 1101.0, float("nan"), float("inf")])
def test_a_pressure_that_cannot_be_is_left_out(hpa: float) -> None:
    height = PressureHeight(zero_m=0.0)
    height.read(hpa, 0)
    assert height.height_m(0) is None


def test_an_old_pressure_is_none() -> None:
    height = PressureHeight(zero_m=0.0)
    height.read(1000.0, 0)
    assert height.height_m(FRESH_NS) is not None and height.height_m(FRESH_NS + 1) is None
    height.align(5.0, False, FRESH_NS + 1)
    assert height.zero_m == 0.0


def test_it_is_asked_for_where_it_is_taken() -> None:
    pressure = mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE
    assert wanted_of("ardupilot")[pressure] == 5.0 and pressure not in wanted_of("px4")
