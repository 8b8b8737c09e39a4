"""Bandwidth of a serial line (limited rates, reports of overload), and TIMESYNC through outliers, reboot and wrap."""

import os
import pty
import random
import time

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import MS, TICK_NS, S, estimate
from link_wire import WiredEdge, attitude, heartbeat, packed, states
from terrafix.core.config import LinkSection
from terrafix.link.edge import open_edge
from terrafix.link.mavlink.bandwidth import MIN_RATE_HZ, USABLE_SHARE_IN, LinkBandwidth
from terrafix.link.mavlink.message_rates import STREAMS_HZ
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.node import LinkNode

ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE


def packed_length(message_id: int, signed: bool = False) -> int:
    """-> packed bytes of a message whose fields have no trailing zero bytes, which MAVLink 2 would truncate."""
    kind = mavlink.mavlink_map[message_id]
    lengths = [kind.array_lengths[place] for place in kind.orders]  # they are in the order of the wire
    message = kind(*(_ones(t, n) for t, n in zip(kind.fieldtypes, lengths, strict=True)))
    mav = mavlink.MAVLink(None)
    if signed:
        mav.signing.secret_key, mav.signing.sign_outgoing = bytes(32), True
    return len(message.pack(mav))


def _ones(kind: str, count: int) -> object:
    if kind == "char":
        return b"x" * count
    value = {"float": 1.0e-30, "double": 1.0e-30}.get(kind, -1 if kind.startswith("int") else 1)
    if kind.startswith("uint"):
        value = 2 ** int(kind[4:].split("_")[0]) - 1
    return [value] * count if count else value


@pytest.mark.parametrize("signed", [False, True])
def test_message_sizes_equal_the_packed_lengths(signed: bool) -> None:
    for message_id in STREAMS_HZ:
        assert LinkBandwidth(57_600, signed=signed).bytes_per_second({message_id: 1.0}) == packed_length(
            message_id, signed
        )


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("baud", [38_400, 57_600, 115_200, 921_600])
def test_limited_rates_fit_the_bandwidth_and_stay_above_their_minimum(baud: int, signed: bool) -> None:
    bandwidth = LinkBandwidth(baud, signed=signed)
    rates = bandwidth.limit_rates(STREAMS_HZ)
    assert sum(rate * packed_length(i, signed) for i, rate in rates.items()) <= USABLE_SHARE_IN * baud / 10
    assert all(MIN_RATE_HZ.get(i, 1.0) <= rate <= STREAMS_HZ[i] for i, rate in rates.items())
    assert bandwidth.capacity_problem(rates, ("gps_input",), 10.0) == ""
    if baud >= 115_200 or (baud == 57_600 and not signed):
        assert rates == STREAMS_HZ


def test_a_baud_rate_that_is_too_low_is_reported_with_the_need() -> None:
    bandwidth = LinkBandwidth(9600, signed=False)
    published = bandwidth.capacity_problem(bandwidth.limit_rates(STREAMS_HZ), ("gps_input",), 10.0)
    assert published.startswith("9600 baud is too slow (in needs ")
    assert "out needs" in published
    assert LinkBandwidth(None, signed=False).capacity_problem(STREAMS_HZ, ("gps_input",), 10.0) == ""


@pytest.mark.parametrize(("baud", "slower"), [(38_400, True), (57_600, False), (921_600, False)])
def test_requested_and_sent_messages_fit_the_baud_rate_over_a_pty(baud: int, slower: bool) -> None:
    master, slave = pty.openpty()
    edge, node = open_edge(LinkSection(device=os.ttyname(slave), baud=baud)), LinkNode(10.0)
    autopilot, parser = mavlink.MAVLink(None, 7, 1), mavlink.MAVLink(None)
    parser.robust_parsing = True
    sent, requested = 0, {}
    os.set_blocking(master, False)
    for tick in range(10 * 50):
        now_ns = tick * TICK_NS
        if tick % 50 == 0:
            os.write(master, packed(heartbeat(), autopilot))
            time.sleep(0.002)
        list(edge.poll(now_ns))
        if tick % 20 == 0:
            node.on(estimate(now_ns))
        for published in node.tick(now_ns):
            edge.on_message(published)
        try:
            data = os.read(master, 65_536)
        except BlockingIOError:
            continue
        sent += len(data)
        for message in parser.parse_buffer(data) or []:
            if message.get_type() == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                requested[int(message.param1)] = 1e6 / message.param2
    edge.close()
    os.close(slave)
    os.close(master)
    assert set(requested) == set(STREAMS_HZ)
    assert sum(rate * packed_length(i) for i, rate in requested.items()) <= USABLE_SHARE_IN * baud / 10 * 1.001
    assert sent / 10 <= 0.9 * baud / 10
    assert (requested[ATTITUDE] < 25.0) == slower


def test_a_saturated_line_is_reported_once_a_second() -> None:
    link = WiredEdge(device="/dev/ttyTHS1", baud=57_600)

    def second(number: int, packets: int) -> str:
        link.receives(number * S, heartbeat(), *(attitude(i) for i in range(packets)))
        return link.status().detail

    second(0, 0)
    assert "the line is full" not in second(1, 60)
    size = len(packed(attitude(255), mavlink.MAVLink(None)))
    assert "the line is full (in 9" in second(2, 5700 // size)  # of 5760 bytes
    assert "the line is full" not in second(3, 20)


# --- the autopilot's clock ---


def exchange(sync: TimeSync, seconds: range, offset_ns: int, draw: random.Random, jitter_ms: float = 1.0) -> None:
    for second in seconds:
        sent = sync.request(second * S)
        there, back = (round(draw.uniform(0.5, 0.5 + jitter_ms) * MS) for _ in range(2))
        sync.on_response(sent + there + offset_ns, sent, sent + there + back)


def test_many_inconsistent_timesync_outliers_do_not_change_the_offset() -> None:
    draw, sync = random.Random(2), TimeSync()
    exchange(sync, range(30), 5 * S, draw)
    for second in range(30, 90):
        wrong = draw.choice((-1, 1)) * draw.randint(50, 4000) * MS if second % 3 else 0
        exchange(sync, range(second, second + 1), 5 * S + wrong, draw)
        assert sync.offset_at_ns(second * S) == pytest.approx(5 * S, abs=3 * MS)
    assert sync.resets == 0


@pytest.mark.parametrize("tc1", [2**63 - 1, 1, -(2**63)])
def test_impossible_timesync_times_are_outliers(tc1: int) -> None:
    draw, sync = random.Random(3), TimeSync()
    exchange(sync, range(20), 5 * S, draw)
    for second in (20, 21):
        sync.on_response(tc1, sync.request(second * S), second * S + MS)
    assert sync.offset_at_ns(21 * S) == pytest.approx(5 * S, abs=2 * MS)


def test_duplicate_and_late_timesync_responses_are_ignored() -> None:
    sync = TimeSync()
    sent = sync.request(S)
    sync.on_response(sent + 9 * S, sent, S + 2 * MS)
    sync.on_response(sent + 99 * S, sent, S + 3 * MS)  # a second response to the same request, with another time
    late = sync.request(2 * S)
    sync.on_response(late + 99 * S, late, 3 * S)  # round trip of one second
    assert sync.offset_at_ns(S) == pytest.approx(9 * S, abs=2 * MS)


def synced_edge(offset_ns: int) -> WiredEdge:
    """-> an edge after 20 s of round trips with an autopilot whose clock is ``offset_ns`` ahead."""
    link = WiredEdge()
    for tenth in range(200):
        now_ns = tenth * 100 * MS
        link.receives(now_ns, *([heartbeat()] if tenth % 10 == 0 else []))
        times = [request.ts1 for request in link.wire.take("TIMESYNC")]
        link.receives(now_ns + 2 * MS, *(mavlink.MAVLink_timesync_message(t + MS + offset_ns, t) for t in times))
    return link


@pytest.mark.parametrize("days", [1, 49.7, 50, 120])
def test_measurement_times_are_correct_when_the_boot_time_wraps(days: float) -> None:
    """time_boot_ms has 32 bits, 49.7 days; TIMESYNC has 64."""
    offset_ns = round(days * 86_400) * S
    boot_ms = (20_000 + offset_ns // MS) % 2**32  # measured at local time 20.000 s, arrives 30 ms later
    (state,) = states(synced_edge(offset_ns).receives(20_030 * MS, heartbeat(), attitude(boot_ms)))
    assert state.t_ns == pytest.approx(20 * S, abs=2 * MS)


def test_after_an_autopilot_reboot_measurements_have_their_arrival_time() -> None:
    (state,) = states(synced_edge(1000 * S).receives(21 * S, heartbeat(), attitude(500)))
    assert state.t_ns == 21 * S
