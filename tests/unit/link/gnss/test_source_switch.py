"""Switch of the autopilot's source of position: it is confirmed, undone in every case, and survives a loss of power."""

import json
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from autopilot_rig import FRAME, HEIGHT_M, Rig, at_5_hz, real_fix
from companion_rig import Companion
from link_rig import S
from link_wire import WiredEdge, heartbeat
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.gnss.previous_source import FILE_NAME, PreviousSource, PreviousSourceFile
from terrafix.link.gnss.source_switch import SourceSwitch
from terrafix_lab.sim.autopilot.parameters import BESIDE_A_RECEIVER, Kind

BEFORE = {"GPS_AUTO_SWITCH": 4.0, "GPS_PRIMARY": 0.0}
SPOOFED_S = 15.0
ACT = LinkSection(gps_id=1, gnss="act")


class SpoofedFlight(Companion):
    """A copter that hovers on a receiver (GPS1), which is ``spoofed_m`` off between SPOOFED_S and ``honest_s``.
    GPS_INPUT is GPS2."""

    def __init__(self, folder: Path, parameters: dict[str, float] | None = None, spoofed_m: float = 20.0) -> None:
        self.honest_s = float("inf")
        spoofed = FRAME.to_wgs84(0.0, spoofed_m)

        def receiver(t_s: float) -> Any:
            return real_fix(*spoofed) if SPOOFED_S < t_s < self.honest_s else real_fix()

        values = BESIDE_A_RECEIVER | {"GPS1_TYPE": 1.0, "GPS1_DELAY_MS": 5.0} | (parameters or {})
        super().__init__(Rig(Kind.COPTER, parameters=values, real_gps=at_5_hz(receiver)), ACT, folder)

    def disarm(self) -> None:
        """The vehicle stands on the ground at its present height."""
        autopilot = self.rig.autopilot
        autopilot._home_amsl_m = HEIGHT_M
        autopilot.flying = autopilot.armed = False

    @property
    def parameters(self) -> dict[str, float]:
        return {name: self.rig.autopilot.parameters[name] for name in BEFORE}

    def sources(self) -> list[tuple[bool, bool]]:
        return [(x.vision, x.fallback) for x in self.published if isinstance(x, m.PositionSource)]


@pytest.fixture
def switched(tmp_path: Path) -> SpoofedFlight:
    """A flight that the link has switched to vision."""
    flight = SpoofedFlight(tmp_path)
    flight.fly(20.0)
    assert flight.rig.autopilot.used_gps == 1
    return flight


def switch_to_vision(file: PreviousSourceFile | None = None) -> SourceSwitch:
    switch = SourceSwitch(1, file)
    switch.set_target(m.PositionSource(t_ns=0, vision=True, receiver=0), ("gps_input",))
    return switch


def no_images(_t_s: float) -> None:
    return None


def test_an_autopilot_with_a_spoofed_receiver_is_switched_to_gps_input(tmp_path: Path) -> None:
    flight = SpoofedFlight(tmp_path)
    flight.fly(22.0)
    assert flight.rig.autopilot.used_gps == 1
    assert flight.parameters == {"GPS_AUTO_SWITCH": 4.0, "GPS_PRIMARY": 1.0}
    assert flight.rig.error_m() < 8.0
    assert flight.sources() == [(True, True)]
    assert json.loads((tmp_path / FILE_NAME).read_text())["parameters"] == BEFORE


def test_after_the_spoofing_the_autopilot_has_the_parameters_that_it_had_before(tmp_path: Path) -> None:
    blend = {"GPS_AUTO_SWITCH": 2.0, "GPS_PRIMARY": 0.0}
    flight = SpoofedFlight(tmp_path, blend)
    flight.fly(25.0)
    assert flight.parameters["GPS_PRIMARY"] == 1.0
    flight.honest_s = 25.0
    flight.fly(120.0)
    assert flight.parameters == blend
    assert not (tmp_path / FILE_NAME).exists()


def test_the_parameters_are_on_the_disk_before_they_are_changed(tmp_path: Path) -> None:
    switch = switch_to_vision(PreviousSourceFile(tmp_path))
    reads = list(switch.requests(1, 0))
    assert {x.get_type() for x in reads} == {"PARAM_REQUEST_READ"}
    assert not (tmp_path / FILE_NAME).exists()
    for name, value in BEFORE.items():
        switch.on_message(mavlink.MAVLink_param_value_message(name.encode(), value, 2, 2, 0))
        assert not (tmp_path / FILE_NAME).exists()
    sets = list(switch.requests(1, 1))
    assert {(x.get_type(), x.param_id, x.param_value) for x in sets} == {
        ("PARAM_SET", "GPS_AUTO_SWITCH", 4.0),
        ("PARAM_SET", "GPS_PRIMARY", 1.0),
    }
    assert PreviousSourceFile(tmp_path).load() == PreviousSource(1, BEFORE)


def test_a_killed_terrafix_leaves_the_receiver_to_the_autopilot(switched: SpoofedFlight) -> None:
    switched.rig.fly(6.0)  # nothing is sent any more
    assert switched.rig.autopilot.used_gps == 0


def test_a_restarted_link_restores_the_receiver_when_it_is_trusted_again(switched: SpoofedFlight) -> None:
    switched.honest_s = 20.0
    switched.start(ACT)  # the earlier process was killed, and closed nothing
    switched.fly(22.0)
    assert switched.parameters["GPS_PRIMARY"] == 1.0, "what it has restored is not yet known to be right"
    switched.fly(60.0)
    assert switched.parameters == BEFORE
    assert switched.rig.autopilot.used_gps == 0


@pytest.mark.parametrize("restarted", [False, True])
def test_a_vehicle_that_lands_during_the_spoofing_gets_its_parameters_back(
    switched: SpoofedFlight, tmp_path: Path, restarted: bool
) -> None:
    if restarted:
        switched.start(ACT)
    switched.disarm()
    switched.fly(25.0)
    assert switched.parameters == BEFORE
    assert not (tmp_path / FILE_NAME).exists()


def test_an_ordered_stop_restores_the_parameters(switched: SpoofedFlight, tmp_path: Path) -> None:
    switched.edge.close()
    assert switched.parameters == BEFORE
    assert not (tmp_path / FILE_NAME).exists()


def test_after_a_loss_of_power_the_next_start_restores_the_parameters(switched: SpoofedFlight, tmp_path: Path) -> None:
    left = switched.parameters
    next_day = SpoofedFlight(tmp_path, left, spoofed_m=0.0)  # the autopilot saves its parameters
    next_day.disarm()
    next_day.rig.fly(5.0)
    assert next_day.rig.autopilot.used_gps == 0, "the receiver is used without Terrafix, too"
    next_day.fly(10.0, no_images)
    assert next_day.parameters == BEFORE
    assert not (tmp_path / FILE_NAME).exists()


def test_a_link_that_no_longer_switches_restores_what_an_earlier_one_has_switched(switched: SpoofedFlight) -> None:
    switched.start(LinkSection(gps_id=1, gnss="off"))
    switched.fly(22.0)
    assert switched.parameters == BEFORE


def test_without_a_fix_of_ours_the_autopilot_is_kept_off_a_spoofed_receiver_for_35_seconds(tmp_path: Path) -> None:
    flight = SpoofedFlight(tmp_path, spoofed_m=300.0)
    flight.fly(20.0)
    flight.fly(30.0, no_images)
    assert flight.parameters == {"GPS_AUTO_SWITCH": 0.0, "GPS_PRIMARY": 1.0}
    assert flight.rig.autopilot.used_gps == 1
    flight.fly(36.0)
    assert flight.parameters["GPS_AUTO_SWITCH"] == 4.0, "with a fix the firmware may fall back by itself again"
    flight.fly(80.0, no_images)
    assert flight.parameters["GPS_AUTO_SWITCH"] == 4.0, "a receiver that may be spoofed is better than none"
    assert flight.sources() == [(True, True), (True, False), (True, True), (True, False), (True, True)]


def test_what_another_vehicle_had_before_is_not_restored_on_this_one() -> None:
    switch = switch_to_vision()
    list(switch.requests(1, 0))
    for name, value in BEFORE.items():
        switch.on_message(mavlink.MAVLink_param_value_message(name.encode(), value, 2, 2, 0))
    list(switch.requests(1, 1))
    switch.set_target(m.PositionSource(t_ns=2 * S, vision=False, receiver=0), ("gps_input",))
    assert list(switch.requests(2, 2 * S)) == []
    assert len(list(switch.requests(1, 2 * S))) == 2


def test_an_unwritable_disk_does_not_keep_a_spoofed_vehicle_on_its_receiver(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    flight = SpoofedFlight(blocked / "state")
    flight.fly(22.0)
    assert flight.parameters["GPS_PRIMARY"] == 1.0
    flight.disarm()
    flight.fly(25.0)
    assert flight.parameters == BEFORE


def test_a_source_set_is_requested_until_the_autopilot_confirms_it(tmp_path: Path) -> None:
    link = WiredEdge(outputs=["odometry"], previous_source=PreviousSourceFile(tmp_path))
    link.receives(0, heartbeat())
    link.edge.on_message(m.PositionSource(t_ns=0, vision=True, receiver=0))

    def requested(second: int) -> list[float]:
        link.receives(second * S, heartbeat())
        command = mavlink.MAV_CMD_SET_EKF_SOURCE_SET
        return [x.param1 for x in link.wire.take("COMMAND_LONG") if x.command == command]

    assert [requested(1), requested(2)] == [[2.0], [2.0]]
    confirmed = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 0)
    link.receives(2 * S + 1, confirmed)
    assert [requested(3), requested(4)] == [[], []]
    assert PreviousSourceFile(tmp_path).load() == PreviousSource(7, source_set=1)
    link.edge.on_message(m.PositionSource(t_ns=0, vision=False, receiver=0))
    assert [requested(second)[:1] for second in range(5, 11)] == [[1.0]] * 6  # without an answer, without a limit
    link.receives(11 * S, heartbeat())
    assert "did not switch" in link.status().detail
    link.receives(12 * S, confirmed)
    assert not (tmp_path / FILE_NAME).exists()


def test_the_switch_to_an_autopilot_that_does_not_answer_is_given_up_and_reported() -> None:
    switch = switch_to_vision()
    asked = [len(list(switch.requests(1, second * S))) for second in range(8)]
    assert asked == [2, 2, 2, 2, 2, 0, 0, 0]
    assert "did not switch" in switch.problem
    assert not switch.switched
