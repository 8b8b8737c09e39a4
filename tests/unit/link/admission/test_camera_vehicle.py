"""Several vehicles on one link of which one carries the camera: none is served before it is known which one."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import GPS
from link_port import Port, Speaker, listening
from link_rig import MS, S, estimate, gps, texts
from link_wire import WiredEdge, armed, attitude, heartbeat, states
from terrafix import messages as m
from terrafix.link.admission.served_autopilot import (
    HEARTBEATS_ONLY_NS,
    LISTEN_NS,
    MAX_RIVALS,
    VEHICLE_CHANGE_TIMEOUT_NS,
    camera_texts,
    unclear_text,
)
from terrafix.link.autopilot.checkpoint import load_checkpoint
from terrafix.link.node import LinkNode

CAMERA_ON_9 = m.CameraVehicle(t_ns=0, sysid=9)
CAMERA_ON_7 = m.CameraVehicle(t_ns=0, sysid=7)


class VehicleWire(WiredEdge):
    """A wire with several vehicles behind it."""

    def sends(self, now_ns: int) -> int:
        """-> number of positions that leave for one GpsInput."""
        self.wire.take()
        self.edge.on_message(msgspec.structs.replace(GPS, t_ns=now_ns))
        return len(self.wire.take("GPS_INPUT"))

    def both(self, now_ns: int) -> list[m.Message]:
        """Heartbeats and attitudes of 7 and 9."""
        return [
            *self.receives(now_ns, armed(), attitude(now_ns // MS, yaw=1.0)),
            *self.receives(now_ns + MS, armed(), attitude(now_ns // MS, yaw=2.0), sysid=9),
        ]


@pytest.fixture
def router() -> VehicleWire:
    return VehicleWire()


def served(published: list[m.Message]) -> list[tuple[int, bool, list[int]]]:
    return [(x.sysid, x.confirmed, x.candidates) for x in published if isinstance(x, m.ServedVehicle)]


def test_no_position_leaves_and_no_telemetry_is_used_while_two_vehicles_may_carry_the_camera(
    router: VehicleWire,
) -> None:
    for second in range(1, 20):
        published = router.both(second * S)
        assert states(published) == [] or second == 1
        assert router.sends(second * S + 2 * MS) == 0
    assert served(published)[-1] == (7, False, [7, 9])


def test_the_vehicle_that_turns_as_the_camera_does_is_served(router: VehicleWire) -> None:
    router.both(1 * S)
    router.edge.on_message(CAMERA_ON_9)
    published = router.both(2 * S)
    assert [x.yaw_rad for x in states(published)] == pytest.approx([2.0])
    assert served(published)[-1] == (9, True, [])
    assert router.sends(2 * S + 2 * MS) == 1


def test_the_pilot_is_told_that_it_is_unclear_and_how_to_state_it(router: VehicleWire) -> None:
    for second in range(1, 35):
        router.both(second * S)
    assert router.texts() == ["Terrafix: no fix: camera on vehicle 7, 9?"] * 2  # every 30 s
    assert "vehicle 7, 9: no position is sent until" in router.status().detail
    router.edge.on_message(CAMERA_ON_9)
    assert texts(router.both(36 * S)) == [
        "Terrafix: vehicle 9 is served, 7 is not",
        "Terrafix: camera is on vehicle 9",
        "Terrafix: set link.autopilot_sysid = 9",
        "Terrafix: vehicle 7 on our link gets GPS_INPUT",
    ]


@pytest.mark.parametrize("sysids", [[255, 254], range(248, 256)])
def test_texts_about_the_camera_fit_into_statustext(sysids: list[int]) -> None:
    assert all(len(f"Terrafix: {text}") <= 50 for text in (unclear_text(sysids), *camera_texts(255)))


def test_the_turns_of_all_candidates_are_published_and_requested(router: VehicleWire) -> None:
    router.both(1 * S)
    published = router.both(2 * S)
    attitudes = [(x.sysid, round(x.yaw_rad, 3)) for x in published if isinstance(x, m.CandidateAttitude)]
    assert attitudes == [(7, 1.0), (9, 2.0)]
    requests = [x for x in router.wire.take("COMMAND_LONG") if x.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL]
    assert {x.param1 for x in requests if x.target_system == 9} == {float(mavlink.MAVLINK_MSG_ID_ATTITUDE)}
    assert len({x.param1 for x in requests if x.target_system == 7}) > 1


def test_a_configured_system_id_is_served_beside_others() -> None:
    router = VehicleWire(autopilot_sysid=9)
    router.both(1 * S)
    router.edge.on_message(CAMERA_ON_7)
    published = router.both(2 * S)
    assert served(published)[-1] == (9, True, [])
    assert router.sends(3 * S) == 1


# --- later in the flight ---


def test_a_vehicle_that_was_confirmed_alone_stays_served_whatever_comes_later(router: VehicleWire) -> None:
    for second in range(1, 100):
        router.receives(second * S, armed(), attitude(1000 * second))
    router.edge.on_message(CAMERA_ON_7)
    for second in range(100, 120):
        router.both(second * S)
        assert router.sends(second * S + 2 * MS) == 1
    assert router.texts() == ["Terrafix: vehicle 9 on our link gets GPS_INPUT"]


def test_heartbeats_of_many_forged_system_ids_do_not_silence_a_confirmed_vehicle(router: VehicleWire) -> None:
    router.receives(1 * S, armed(), attitude(1000))
    router.edge.on_message(CAMERA_ON_7)
    for sysid in range(100, 200):
        router.receives(2 * S + sysid * MS, armed(), attitude(1000), sysid=sysid)
        assert router.sends(2 * S + sysid * MS) == 1


def test_a_vehicle_that_was_not_confirmed_is_not_served_beside_a_second_one(router: VehicleWire) -> None:
    router.receives(1 * S, armed(), attitude(1000))
    assert router.sends(1 * S) == 1
    router.both(100 * S)
    assert router.sends(100 * S + 2 * MS) == 0


@pytest.mark.parametrize(
    ("last", "silent_ns", "sent"),
    [
        pytest.param([heartbeat(), attitude(1000)], VEHICLE_CHANGE_TIMEOUT_NS, [0, 1], id="one that was not armed"),
        pytest.param([armed(), attitude(1000)], VEHICLE_CHANGE_TIMEOUT_NS, [0, 0], id="one that was armed, for ever"),
        pytest.param([armed()], HEARTBEATS_ONLY_NS, [0, 1], id="a single forged heartbeat, for five seconds only"),
    ],
)
def test_a_vehicle_that_disappears_may_still_carry_the_camera_for_a_time(
    router: VehicleWire, last: list[Any], silent_ns: int, sent: list[int]
) -> None:
    router.receives(1 * S, armed(), attitude(1000))
    router.receives(1 * S, *last, sysid=9)
    found = []
    for at_ns in (S + silent_ns, S + silent_ns + MS):
        router.receives(at_ns, armed(), attitude(at_ns // MS))
        found.append(router.sends(at_ns))
    assert found == sent


def test_a_vehicle_that_follows_a_confirmed_one_must_be_confirmed_itself(router: VehicleWire) -> None:
    router.receives(1 * S, heartbeat(), attitude(1000))
    router.edge.on_message(CAMERA_ON_7)
    later_ns = 2 * S + VEHICLE_CHANGE_TIMEOUT_NS
    published = router.receives(later_ns, heartbeat(), attitude(1000), sysid=9)
    assert router.sends(later_ns) == 0 and served(published)[-1] == (9, False, [9])
    router.edge.on_message(CAMERA_ON_9)
    assert router.sends(later_ns + MS) == 1


def test_more_vehicles_than_are_compared_leave_it_unclear(router: VehicleWire) -> None:
    for sysid in range(1, MAX_RIVALS + 5):
        router.receives(sysid * MS, armed(), sysid=sysid)
    assert len(served(router.published)[-1][2]) == MAX_RIVALS + 1
    assert router.sends(S) == 0


def test_while_the_confirmed_vehicle_is_not_there_no_other_is_served(router: VehicleWire) -> None:
    router.receives(1 * S, armed(), attitude(1000))
    router.edge.on_message(CAMERA_ON_9)
    assert router.sends(1 * S) == 0
    router.both(2 * S)
    router.edge.on_message(CAMERA_ON_9)  # the estimator repeats it while the link does not serve that vehicle
    assert router.sends(2 * S + MS) == 1 and served(router.receives(3 * S, sysid=9))[-1] == (9, True, [])


# --- restart in flight ---


def test_a_link_that_restarts_while_it_is_unclear_sends_nothing_before_it_has_heard_the_others(tmp_path: Path) -> None:
    file = tmp_path / "link.checkpoint"
    before = VehicleWire(checkpoint=file)
    before.both(1 * S)
    before.both(2 * S)
    before.sends(2 * S + 2 * MS)
    found = load_checkpoint(file)
    assert found is not None and found.last is None
    after = VehicleWire(checkpoint=file)
    assert after.sends(10 * S) == 0
    after.receives(10 * S, armed(), attitude(1000))
    assert after.sends(10 * S) == 0
    after.receives(10 * S + LISTEN_NS - MS, armed(), attitude(1000), sysid=9)
    assert after.sends(11 * S + LISTEN_NS) == 0


def test_a_restarted_link_that_hears_no_other_vehicle_sends_after_a_heartbeat(tmp_path: Path) -> None:
    file = tmp_path / "link.checkpoint"
    VehicleWire(checkpoint=file).receives(1 * S, armed())
    after = VehicleWire(checkpoint=file)
    after.receives(10 * S, armed())
    assert [after.sends(10 * S + LISTEN_NS - MS), after.sends(10 * S + LISTEN_NS)] == [0, 1]


# --- one port, each vehicle with its own address ---


@pytest.fixture
def port() -> Iterator[Port]:
    port = listening()
    yield port
    port.edge.close()


@pytest.mark.real_time  # the packets go through the kernel
def test_the_confirmed_vehicle_at_its_own_address_gets_the_position_and_the_other_nothing(port: Port) -> None:
    with Speaker(7) as standing, Speaker(9) as flying:
        for second in range(1, 4):
            port.receives(second * S, standing, armed(), attitude(1000 * second))
            port.receives(second * S + MS, flying, armed(), attitude(1000 * second, yaw=2.0))
            port.edge.on_message(GPS)
        assert standing.received("GPS_INPUT") == [] and flying.received("GPS_INPUT") == []
        port.edge.on_message(CAMERA_ON_9)
        published = port.receives(5 * S, flying, armed(), attitude(5000, yaw=2.0))
        assert len(states(published)) == 1
        standing.received()
        port.receives(5 * S + MS, standing, armed(), attitude(5000))
        port.edge.on_message(GPS)
        assert len(flying.received("GPS_INPUT")) == 1 and standing.kinds() == set()
        assert "second sender" not in port.status().detail


# --- the node ---


def test_the_record_states_why_there_is_no_fix() -> None:
    node = LinkNode(10.0)
    node.on(m.VehicleState(t_ns=0, source="test", armed=False))
    for second in range(3):
        node.on(estimate(second * S))
    fixed = gps([*node.tick(2 * S + 200 * MS)])
    node.on(m.ServedVehicle(t_ns=3 * S, sysid=7, confirmed=False, candidates=[7, 9]))
    node.on(estimate(3 * S))
    silent = gps([*node.tick(3 * S + 200 * MS)])
    assert (fixed[0].fix_type, silent[0].fix_type) == (3, 1)
    assert silent[0].no_fix_reason == "the camera may be on vehicle 7, 9"
