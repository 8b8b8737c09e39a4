"""Message rates: requests, measurement, repeated requests, and REQUEST_DATA_STREAM for older firmware; diagnosis."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import WiredEdge, heartbeat
from terrafix import messages as m
from terrafix.link.mavlink.diagnosis import ReceivedTraffic, no_autopilot_reason
from terrafix.link.mavlink.message_rates import MAX_QUICK_REQUESTS, OPTIONAL_ON_PX4, Streams, streams_of_firmware

S = 1_000_000_000
ATTITUDE, HEIGHT = mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
AIRSPEED = mavlink.MAVLINK_MSG_ID_AIRSPEED
WANTED = {ATTITUDE: 25.0, HEIGHT: 5.0}


def run(streams: Streams, seconds: range, rates_hz: dict[int, int]) -> dict[str, list[tuple[int, int]]]:
    """Receives messages at ``rates_hz`` -> by kind of request: (second, message id or group)."""
    requested: dict[str, list[tuple[int, int]]] = {"COMMAND_LONG": [], "REQUEST_DATA_STREAM": []}
    for second in seconds:
        for message_id, rate_hz in rates_hz.items():
            for _ in range(rate_hz):
                streams.on_message(message_id)
        for request in streams.requests(7, 1, second * S):
            what = request.param1 if request.get_type() == "COMMAND_LONG" else request.req_stream_id
            requested[request.get_type()].append((second, int(what)))
    return requested


def test_a_stream_at_its_wanted_rate_is_requested_once() -> None:
    streams = Streams(WANTED)
    requested = run(streams, range(60), {ATTITUDE: 24, HEIGHT: 5})  # 24: ArduPilot rounds to its loop
    assert requested == {"COMMAND_LONG": [(0, ATTITUDE), (0, HEIGHT)], "REQUEST_DATA_STREAM": []}
    assert streams.problem() == ""


def test_a_1_hz_stream_may_miss_one_message_in_a_window() -> None:
    streams = Streams({mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0})
    run(streams, range(4), {mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1})
    run(streams, range(4, 5), {})
    run(streams, range(5, 7), {mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1})
    assert streams.rates_hz[mavlink.MAVLINK_MSG_ID_SYSTEM_TIME] == pytest.approx(0.67, abs=0.01)
    assert streams.problem() == ""
    run(streams, range(7, 13), {})
    assert streams.problem() == "too slow: SYSTEM_TIME 0.0 of 1 Hz"


def test_after_a_reboot_of_the_autopilot_slow_streams_are_requested_again() -> None:
    streams = Streams(WANTED)
    run(streams, range(30), {ATTITUDE: 25, HEIGHT: 5})
    requested = run(streams, range(30, 36), {ATTITUDE: 4, HEIGHT: 5})["COMMAND_LONG"]
    assert requested[0][0] - 30 <= 4
    assert {what for _, what in requested} == {ATTITUDE}
    assert streams.problem() == "too slow: ATTITUDE 4.0 of 25 Hz"


def test_a_firmware_without_set_message_interval_gets_request_data_stream() -> None:
    streams = Streams(WANTED)
    run(streams, range(1), {})
    streams.on_command_ack(mavlink.MAV_RESULT_UNSUPPORTED)
    requested = run(streams, range(1, 5), {})["REQUEST_DATA_STREAM"]
    assert {what for _, what in requested} == {mavlink.MAV_DATA_STREAM_EXTRA1, mavlink.MAV_DATA_STREAM_POSITION}


def test_without_an_answer_both_requests_are_sent_and_then_slowly() -> None:
    streams = Streams(WANTED)
    requested = run(streams, range(120), {})
    assert requested["REQUEST_DATA_STREAM"][0][0] <= 10
    attitude = [second for second, what in requested["COMMAND_LONG"] if what == ATTITUDE]
    assert MAX_QUICK_REQUESTS < len(attitude) <= MAX_QUICK_REQUESTS + 4


def test_a_rejected_request_is_reported_if_a_stream_is_too_slow() -> None:
    streams = Streams(WANTED)
    streams.on_command_ack(mavlink.MAV_RESULT_DENIED)
    run(streams, range(5), {ATTITUDE: 25, HEIGHT: 5})
    assert streams.problem() == ""
    run(streams, range(5, 10), {ATTITUDE: 4, HEIGHT: 5})
    assert "message rates refused (MAV_RESULT 2)" in streams.problem()


def test_airspeed_is_requested_twice_and_again_only_if_it_was_received() -> None:
    """ArduPilot 4.5 sends the pilot a text for every request of it."""
    without, with_one = Streams({AIRSPEED: 5.0}), Streams({AIRSPEED: 5.0})
    assert len(run(without, range(600), {})["COMMAND_LONG"]) == 2
    assert without.problem() == ""
    run(with_one, range(60), {AIRSPEED: 5})
    assert len(run(with_one, range(60, 90), {})["COMMAND_LONG"]) > 2  # the autopilot has rebooted


def test_px4_without_a_receiver_or_a_position_reports_no_problem() -> None:
    streams = Streams(WANTED)
    wanted = streams_of_firmware("px4")
    streams.set_firmware("px4", wanted)
    received = {i: round(hz) for i, hz in wanted.items() if i not in OPTIONAL_ON_PX4}
    assert mavlink.MAVLINK_MSG_ID_ALTITUDE in received
    run(streams, range(10), received)
    streams.set_firmware("px4", dict(wanted))  # repeated with every heartbeat: keeps the counts
    assert streams.problem() == "" and streams.rates_hz
    run(streams, range(10, 20), {i: n for i, n in received.items() if i != mavlink.MAVLINK_MSG_ID_HIGHRES_IMU})
    assert streams.problem() == "too slow: HIGHRES_IMU 0.0 of 33 Hz"


# --- autopilots on the link ---


def test_two_autopilots_are_reported_and_the_confirmed_one_is_served() -> None:
    link = WiredEdge()
    link.edge.on_message(m.CameraVehicle(t_ns=0, sysid=7))
    link.receives(0, heartbeat())
    link.receives(S, heartbeat(), sysid=9)
    assert link.status().sysid == 7
    assert "more than one autopilot: 7 is served, 9 is not" in link.status().detail


GCS = {(255, 190): mavlink.MAV_AUTOPILOT_INVALID}
OTHER = {(4, 1): mavlink.MAV_AUTOPILOT_PX4}


@pytest.mark.parametrize(
    ("traffic", "device", "expected"),
    [
        (ReceivedTraffic(), "/dev/ttyTHS1", "nothing heard on /dev/ttyTHS1; are RX and TX crossed"),
        (ReceivedTraffic(), "udpin:0.0.0.0:14550", "address and port"),
        (ReceivedTraffic(bytes=4000), "/dev/ttyTHS1", "link.baud is 57600: is that the speed of SERIALn_BAUD"),
        (ReceivedTraffic(bytes=4000), "tcp:fc:5760", "bytes but no MAVLink on tcp:fc:5760; its SERIALn_PROTOCOL"),
        (ReceivedTraffic(bytes=4000, packets=9), "tcp:fc:5760", "no heartbeat"),
        (ReceivedTraffic(bytes=4000, packets=9, heartbeats=GCS), "tcp:fc:5760", "only system 255 component 190"),
        (ReceivedTraffic(bytes=4000, packets=9, heartbeats=OTHER), "tcp:fc:5760", "has system id 4, not 3"),
        (ReceivedTraffic(bytes=4000, refused=9), "tcp:fc:5760", "not signed with link.signing_key"),
    ],
)
def test_every_diagnosis_is_one_line_with_advice(traffic: ReceivedTraffic, device: str, expected: str) -> None:
    why = no_autopilot_reason(traffic, device, 57_600, 3)
    assert expected in why
    assert "\n" not in why
    assert "; " in why
