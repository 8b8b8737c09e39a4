"""Message rates: asked for, measured, asked for again, and the old request where the new one is not known."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import MemoryWire, heartbeat, packed
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.edge import MavlinkEdge
from terrafix.link.mavlink.diagnosis import Heard, why_no_autopilot
from terrafix.link.mavlink.message_rates import OPTIONAL_ON_PX4, PATIENCE, Streams, wanted_of

S = 1_000_000_000
ATTITUDE, HEIGHT = mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
AIRSPEED = mavlink.MAVLINK_MSG_ID_AIRSPEED
WANTED = {ATTITUDE: 25.0, HEIGHT: 5.0}


def run(streams: Streams, seconds: range, rates_hz: dict[int, int]) -> dict[str, list[tuple[int, int]]]:
    """-> for each kind of request (second, message or group)."""
    asked: dict[str, list[tuple[int, int]]] = {"COMMAND_LONG": [], "REQUEST_DATA_STREAM": []}
    for second in seconds:
        for message_id, rate_hz in rates_hz.items():
            for _ in range(rate_hz):
                streams.heard(message_id)
        for request in streams.requests(7, 1, second * S):
            what = request.param1 if request.get_type() == "COMMAND_LONG" else request.req_stream_id
            asked[request.get_type()].append((second, int(what)))
    return asked


def test_what_comes_as_wanted_is_asked_for_once() -> None:
    streams = Streams(WANTED)
    asked = run(streams, range(60), {ATTITUDE: 24, HEIGHT: 5})  # 24: ArduPilot rounds to its loop
    assert asked == {"COMMAND_LONG": [(0, ATTITUDE), (0, HEIGHT)], "REQUEST_DATA_STREAM": []}
    assert streams.problem() == ""


def test_what_comes_once_a_second_may_miss_a_window_of_three() -> None:
    streams = Streams({mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0})
    run(streams, range(4), {mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1})
    run(streams, range(4, 5), {})
    run(streams, range(5, 7), {mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1})
    assert streams.rates_hz[mavlink.MAVLINK_MSG_ID_SYSTEM_TIME] == pytest.approx(0.67, abs=0.01)
    assert streams.problem() == ""
    run(streams, range(7, 13), {})
    assert streams.problem() == "too slow: SYSTEM_TIME 0.0 of 1 Hz"


def test_after_a_reboot_of_the_autopilot_the_rates_are_set_again() -> None:
    streams = Streams(WANTED)
    run(streams, range(30), {ATTITUDE: 25, HEIGHT: 5})
    asked = run(streams, range(30, 36), {ATTITUDE: 4, HEIGHT: 5})["COMMAND_LONG"]
    assert asked[0][0] - 30 <= 4
    assert {what for _, what in asked} == {ATTITUDE}
    assert streams.problem() == "too slow: ATTITUDE 4.0 of 25 Hz"


def test_a_firmware_that_does_not_know_the_command_is_asked_by_group() -> None:
    streams = Streams(WANTED)
    run(streams, range(1), {})
    streams.answered(mavlink.MAV_RESULT_UNSUPPORTED)
    asked = run(streams, range(1, 5), {})["REQUEST_DATA_STREAM"]
    assert {what for _, what in asked} == {mavlink.MAV_DATA_STREAM_EXTRA1, mavlink.MAV_DATA_STREAM_POSITION}


def test_without_an_answer_both_ways_are_tried_and_then_seldom() -> None:
    streams = Streams(WANTED)
    asked = run(streams, range(120), {})
    assert asked["REQUEST_DATA_STREAM"][0][0] <= 10
    attitude = [second for second, what in asked["COMMAND_LONG"] if what == ATTITUDE]
    assert PATIENCE < len(attitude) <= PATIENCE + 4


def test_a_refusal_is_said_where_something_comes_too_slowly() -> None:
    streams = Streams(WANTED)
    streams.answered(mavlink.MAV_RESULT_DENIED)
    run(streams, range(5), {ATTITUDE: 25, HEIGHT: 5})
    assert streams.problem() == ""
    run(streams, range(5, 10), {ATTITUDE: 4, HEIGHT: 5})
    assert "message rates refused (MAV_RESULT 2)" in streams.problem()


def test_airspeed_is_asked_for_twice_and_again_only_where_it_has_come() -> None:
    """ArduPilot 4.5 shows its pilot a line for every request of it."""
    without, with_one = Streams({AIRSPEED: 5.0}), Streams({AIRSPEED: 5.0})
    assert len(run(without, range(600), {})["COMMAND_LONG"]) == 2
    assert without.problem() == ""
    run(with_one, range(60), {AIRSPEED: 5})
    assert len(run(with_one, range(60, 90), {})["COMMAND_LONG"]) > 2  # the autopilot was started again


def test_px4_without_a_receiver_or_a_position_is_nothing_to_complain_of() -> None:
    streams = Streams(WANTED)
    wanted = wanted_of("px4")
    streams.serve("px4", wanted)
    came = {i: round(hz) for i, hz in wanted.items() if i not in OPTIONAL_ON_PX4}
    assert mavlink.MAVLINK_MSG_ID_ALTITUDE in came
    run(streams, range(10), came)
    streams.serve("px4", dict(wanted))  # with every heartbeat: the counts stay
    assert streams.problem() == "" and streams.rates_hz
    run(streams, range(10, 20), {i: n for i, n in came.items() if i != mavlink.MAVLINK_MSG_ID_HIGHRES_IMU})
    assert streams.problem() == "too slow: HIGHRES_IMU 0.0 of 33 Hz"


# --- who is heard ---


def edge_on(wire: MemoryWire, **changes: int) -> MavlinkEdge:
    return MavlinkEdge(LinkSection(**changes), wire, lambda: 0)  # type: ignore[arg-type]


def status_of(edge: MavlinkEdge, now_ns: int) -> m.LinkStatus:
    (status,) = [x for x in edge.poll(now_ns) if isinstance(x, m.LinkStatus)]
    return status


def test_two_autopilots_are_told_and_one_is_served() -> None:
    wire = MemoryWire()
    edge = edge_on(wire)
    wire.arrive(packed(heartbeat(), mavlink.MAVLink(None, 7, 1)), packed(heartbeat(), mavlink.MAVLink(None, 9, 1)))
    status = status_of(edge, 0)
    assert status.sysid == 7
    assert "more than one autopilot: 7 is served, 9 is not" in status.detail


def test_the_one_that_is_named_is_served() -> None:
    wire = MemoryWire()
    edge = edge_on(wire, autopilot_sysid=9)
    wire.arrive(packed(heartbeat(), mavlink.MAVLink(None, 7, 1)))
    status = status_of(edge, 0)
    assert not status.connected
    assert "has system id 7, not 9" in status.detail
    wire.arrive(packed(heartbeat(), mavlink.MAVLink(None, 9, 1)))
    assert status_of(edge, S).sysid == 9


GCS = {(255, 190): mavlink.MAV_AUTOPILOT_INVALID}
OTHER = {(4, 1): mavlink.MAV_AUTOPILOT_PX4}


@pytest.mark.parametrize(
    ("heard", "device", "says"),
    [
        (Heard(), "/dev/ttyTHS1", "nothing heard on /dev/ttyTHS1; are RX and TX crossed"),
        (Heard(), "udpin:0.0.0.0:14550", "address and port"),
        (Heard(bytes=4000), "/dev/ttyTHS1", "link.baud is 57600: is that the speed of SERIALn_BAUD"),
        (Heard(bytes=4000), "tcp:fc:5760", "bytes but no MAVLink on tcp:fc:5760; its SERIALn_PROTOCOL"),
        (Heard(bytes=4000, packets=9), "tcp:fc:5760", "no heartbeat"),
        (Heard(bytes=4000, packets=9, heartbeats=GCS), "tcp:fc:5760", "only system 255 component 190"),
        (Heard(bytes=4000, packets=9, heartbeats=OTHER), "tcp:fc:5760", "has system id 4, not 3"),
        (Heard(bytes=4000, refused=9), "tcp:fc:5760", "not signed with link.signing_key"),
    ],
)
def test_every_reason_for_silence_is_one_line_that_says_what_to_do(heard: Heard, device: str, says: str) -> None:
    why = why_no_autopilot(heard, device, 57_600, 3)
    assert says in why
    assert "\n" not in why
    assert "; " in why
