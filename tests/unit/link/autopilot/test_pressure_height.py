"""Height from barometric pressure: independent of our velocity, which the autopilot's EKF fuses into its height."""

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import NO_FIX
from link_wire import WiredEdge, armed, attitude, heartbeat, states
from terrafix.link.autopilot.pressure_height import PRESSURE_TIMEOUT_NS, PressureHeight, isa_height_m
from terrafix.link.mavlink.message_rates import streams_of_firmware

S, MS = 1_000_000_000, 1_000_000
FIELD_HPA = 955.0  # about 500 m above mean sea level


def pressure_at(above_m: float) -> float:
    """-> pressure [hPa] at a height above the field: the inverse barometric formula of the standard atmosphere."""
    return float(1013.25 * (1.0 - (isa_height_m(FIELD_HPA) + above_m) / 44_330.77) ** (1.0 / 0.190263))


@pytest.mark.parametrize(
    ("hpa", "height_m"),
    [(1013.25, 0.0), (954.61, 500.0), (898.75, 1000.0), (701.08, 3000.0)],  # ICAO Doc 7488, table of the atmosphere
)
def test_pressure_altitudes_are_those_of_the_standard_atmosphere(hpa: float, height_m: float) -> None:
    assert isa_height_m(hpa) == pytest.approx(height_m, abs=0.6)


class TwoHeightsAutopilot:
    """An autopilot on a connection in memory, with separate heights of its EKF and its barometer."""

    def __init__(self, checkpoint_file: Path | None = None) -> None:
        self.checkpoint_file, self.seconds, self.booted_s = checkpoint_file, 100.0, 0.0
        self.restart()

    def restart(self) -> None:
        """Starts a new link process."""
        self.link = WiredEdge(checkpoint=self.checkpoint_file)

    def receive(
        self, ekf_height_m: float | None, above_m: float | None, *, flies: bool = True, seconds: float = 1.0
    ) -> float | None:
        """The link receives these heights at 5 Hz; None: not sent. -> the last published height."""
        for _ in range(round(seconds * 5)):
            self.seconds += 0.2
            boot_ms = round((self.seconds - self.booted_s) * 1e3)
            packets: list[Any] = [armed() if flies else heartbeat()]
            if above_m is not None:
                packets.append(mavlink.MAVLink_scaled_pressure_message(boot_ms, pressure_at(above_m), 0.0, 3500))
            if ekf_height_m is not None:
                heights = (round(500e3 + ekf_height_m * 1e3), round(ekf_height_m * 1e3))
                packets.append(mavlink.MAVLink_global_position_int_message(boot_ms, 1, 2, *heights, 0, 0, 0, 0))
            published = self.link.receives(round(self.seconds * S), *packets, attitude(boot_ms))
        return states(published)[-1].agl_m


GROUND = [(0.0, 0.0, 1.0)]


@pytest.mark.parametrize(
    ("on_ground", "flight"),
    [
        pytest.param(
            [(0.0, 0.0, 10.0)],
            [(50.0 + ekf_error_m, 50.0, 1.0, 50.0) for ekf_error_m in range(20)],
            id="an EKF height that our velocity displaces does not change it",
        ),
        pytest.param(
            GROUND,
            [(60.0, 50.0, 1.0, 50.0), (60.0, None, 2.0, 60.0), (60.0, 50.0, 1.0, 50.0)],
            id="without pressure it is the EKF's, exactly",
        ),
        pytest.param(
            GROUND,
            [(50.0, 50.0, 1.0, 50.0), (None, 60.0, 3.0, 60.0)],
            id="without EKF heights it continues by pressure",
        ),
        pytest.param(
            [*GROUND, (0.0, 8.0, 60.0)],  # the pressure has fallen by 1 hPa
            [(50.0, 58.0, 1.0, 50.0)],
            id="on the ground the zero follows the air pressure",
        ),
        pytest.param(
            [],
            [(53.0, 50.0, 1.0, 53.0), (80.0, 60.0, 1.0, 63.0)],
            id="a link that starts in the air takes the zero from the EKF once",
        ),
    ],
)
def test_the_height_is_that_above_take_off_by_pressure(
    on_ground: list[tuple[float, float, float]], flight: list[tuple[float | None, float | None, float, float]]
) -> None:
    """Steps: height of the EKF, height by pressure [m], duration [s], and in flight the published height."""
    vehicle = TwoHeightsAutopilot()
    for ekf_m, above_m, seconds in on_ground:
        vehicle.receive(ekf_m, above_m, flies=False, seconds=seconds)
    for ekf, above, seconds, height_m in flight:
        published_m = vehicle.receive(ekf, above, seconds=seconds)
        assert published_m == (height_m if above is None else pytest.approx(height_m, abs=0.1))


def test_one_bad_reading_on_the_ground_changes_the_zero_by_a_tenth() -> None:
    height = PressureHeight()
    for i in range(100):
        height.on_pressure(pressure_at(20.0 if i == 99 else 0.0), i * 200 * MS)
        height.align_zero(0.0, False, i * 200 * MS)
    height.on_pressure(pressure_at(50.0), 21 * S)
    assert height.height_m(21 * S) == pytest.approx(48.0, abs=0.1)  # a tenth of it


def test_a_rebooted_autopilot_gets_a_new_zero() -> None:
    vehicle = TwoHeightsAutopilot()
    vehicle.receive(0.0, 0.0, flies=False)
    assert vehicle.receive(50.0, 50.0) == pytest.approx(50.0, abs=0.1)
    vehicle.booted_s = vehicle.seconds
    assert vehicle.receive(3.0, 50.0, seconds=3.0) == pytest.approx(3.0, abs=0.1)


def test_a_restarted_link_restores_the_zero_from_the_checkpoint(tmp_path: Path) -> None:
    vehicle = TwoHeightsAutopilot(tmp_path / "link.checkpoint")
    vehicle.receive(0.0, 0.0, flies=False)
    vehicle.receive(55.0, 50.0)
    vehicle.link.edge.on_message(NO_FIX)
    vehicle.restart()
    assert vehicle.receive(55.0, 50.0) == pytest.approx(50.0, abs=0.1)


@pytest.mark.parametrize("armed", [True, None])
def test_the_zero_does_not_change_while_armed_or_unknown(armed: bool | None) -> None:
    height = PressureHeight(zero_m=100.0)
    height.on_pressure(1000.0, 0)
    height.align_zero(5.0, armed, 0)
    assert height.zero_m == 100.0


@pytest.mark.parametrize("hpa", [0.0, -3.0, 199.0, 1101.0, float("nan"), float("inf")])
def test_an_implausible_pressure_is_ignored(hpa: float) -> None:
    height = PressureHeight(zero_m=0.0)
    height.on_pressure(hpa, 0)
    assert height.height_m(0) is None


def test_an_old_pressure_is_not_used() -> None:
    height = PressureHeight(zero_m=0.0)
    height.on_pressure(1000.0, 0)
    assert height.height_m(PRESSURE_TIMEOUT_NS) is not None and height.height_m(PRESSURE_TIMEOUT_NS + 1) is None
    height.align_zero(5.0, False, PRESSURE_TIMEOUT_NS + 1)
    assert height.zero_m == 0.0


def test_pressure_is_requested_from_ardupilot_only() -> None:
    pressure = mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE
    assert streams_of_firmware("ardupilot")[pressure] == 5.0 and pressure not in streams_of_firmware("px4")
