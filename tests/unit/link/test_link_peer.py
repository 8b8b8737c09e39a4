"""The simulated autopilot follows the rules measured on the firmware, and the link complies with them end to end."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import GPS
from link_rig import ALT, MS, SPEED_EAST, S, estimate, every, fly, gps, live
from live_flight import LiveFlight, eastward
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError, SourceError
from terrafix.link.edge import open_edge
from terrafix.link.mavlink.message_rates import STREAMS_HZ
from terrafix.link.node import LinkNode
from terrafix.link.output import gps_input
from terrafix_lab.sim.autopilot.course import PeerState, read_course, write_course
from terrafix_lab.sim.autopilot.navigation.gps import GpsInputDriver, JitterCorrection
from terrafix_lab.sim.autopilot.parameters import BESIDE_A_RECEIVER, FIRMWARE, GPS_INPUT_ALONE, NO_DCM
from terrafix_lab.sim.autopilot.peer import AutopilotPeer

pytestmark = pytest.mark.real_time

CONFIG = Path(__file__).resolve().parents[3] / "config"


def message(**changes: Any) -> Any:
    """A valid GPS_INPUT without GPS time, with other fields."""
    sent = gps_input.encode(msgspec.structs.replace(GPS, time_week=0), 0)
    vars(sent).update(changes)
    return sent


def fed(driver: GpsInputDriver, period_s: float, count: int, start_s: float = 0.0, **changes: Any) -> float:
    for i in range(count):
        driver.on_report(message(**changes), start_s + i * period_s)
    return start_s + (count - 1) * period_s


# --- facts: rate health ---


@pytest.mark.parametrize(("rate_hz", "healthy"), [(10, True), (5, True), (4, False), (3, False), (1, False)])
def test_fact_needs_a_mean_interval_below_215_ms(rate_hz: float, healthy: bool) -> None:
    driver = GpsInputDriver(0, 5.0)
    assert driver.healthy(fed(driver, 1 / rate_hz, 300)) is healthy


def test_fact_one_gap_over_245_ms_is_forgiven_two_in_a_row_are_not() -> None:
    driver = GpsInputDriver(0, 5.0)
    now = fed(driver, 0.1, 100)
    driver.on_report(message(), now + 0.3)
    assert driver.healthy(now + 0.3)
    driver.on_report(message(), now + 0.6)
    assert not driver.healthy(now + 0.6)


def test_fact_silence_of_a_minute_spoils_the_mean_for_half_a_minute_at_5_hz_a_quarter_of_it_at_10() -> None:
    def recovery_s(rate_hz: float) -> float:
        driver = GpsInputDriver(0, 5.0)
        start = fed(driver, 1 / rate_hz, 100) + 60.0
        driver.check_timeout(start - 1.0)
        for i in range(1000):
            driver.on_report(message(), start + i / rate_hz)
            if driver.healthy(start + i / rate_hz):
                return i / rate_hz
        return math.inf

    assert 30.0 < recovery_s(5.0) < 50.0
    assert recovery_s(10.0) < recovery_s(5.0) / 2.5


def test_fact_after_4_s_of_silence_the_receiver_is_gone() -> None:
    driver = GpsInputDriver(0, 5.0)
    now = fed(driver, 0.1, 50)
    driver.check_timeout(now + 3.9)
    assert (driver.fix_type, driver.satellites) == (3, 6)
    driver.check_timeout(now + 4.1)
    assert (driver.fix_type, driver.satellites, driver.healthy(now + 4.1)) == (1, 0, False)


# --- facts: fields ---


@pytest.mark.parametrize("fix_type", [0, 1, 2])
def test_fact_below_3d_nothing_reaches_the_ekf(fix_type: int) -> None:
    assert GpsInputDriver(0, 5.0).on_report(message(fix_type=fix_type), 0.0) is None


def test_fact_the_driver_assumes_a_delay_of_200_ms_unless_configured() -> None:
    for delay_ms, lag_s in ((0.0, 0.2), (5.0, 0.005), (100.0, 0.1), (900.0, 0.25)):
        fix = GpsInputDriver(0, delay_ms).on_report(message(), 10.0)
        assert fix is not None
        assert 10.0 - fix.t_s == pytest.approx(lag_s)


def test_fact_the_gps_week_removes_latency_variations_and_not_the_mean() -> None:
    jitter = JitterCorrection()
    late = [0.02, 0.05, 0.13, 0.02, 0.08] * 40
    corrected = [jitter.correct(1e9 + i * 0.1, 5.0 + i * 0.1 + late[i]) - i * 0.1 - 5.0 for i in range(200)]
    assert all(c == pytest.approx(0.02, abs=1e-6) for c in corrected[1:])


def test_a_course_is_unchanged_after_write_and_read(tmp_path: Path) -> None:
    rows = [
        (t / 2, PeerState(48 + t * 1e-5, 11.0, 600, 100, 3.1 if t % 2 else -3.1, 0, 0.1, 1.0, 2, 0, 9.0))
        for t in range(9)
    ]
    write_course(tmp_path / "course.csv", rows)
    course = read_course(tmp_path / "course.csv")
    assert course(1.5) == rows[3][1]
    assert abs(math.remainder(course(1.75).yaw_rad - math.pi, math.tau)) < 1e-9  # interpolates across +-pi
    assert course(99.0).lat_deg == rows[-1][1].lat_deg
    assert course(99.0).vn_mps == 0.0
    (tmp_path / "bad.csv").write_text("t_s,lat\n1,2\n")
    for name in ("bad.csv", "none.csv"):
        with pytest.raises(SourceError, match=name):
            read_course(tmp_path / name)


def in_file(name: str) -> dict[str, float]:
    lines = (CONFIG / "vehicles" / f"{name}.param").read_text().splitlines()
    rows = (line.split(",") for line in lines if line and not line.startswith("#"))
    return {key: float(value) for key, value in rows}


def test_parameters_of_the_simulated_autopilot_are_those_of_the_vehicle_files() -> None:
    """Other parameters of the files do not affect GPS and are not simulated."""

    def simulated(name: str) -> dict[str, float]:
        return {key: value for key, value in in_file(name).items() if key in FIRMWARE}

    assert simulated("copter") == GPS_INPUT_ALONE
    assert simulated("plane") == GPS_INPUT_ALONE | NO_DCM
    assert simulated("second-gps") == BESIDE_A_RECEIVER | NO_DCM


# --- facts: GPS_INPUT of the link ---


def everything_sent() -> list[m.GpsInput]:
    """-> GPS_INPUT of a flight with good, bad, stale, jumping and missing estimates."""

    def make(t: int) -> m.NavEstimate:
        second = t // S
        return estimate(
            t,
            sigma_m=90.0 if 20 <= second < 25 else 3.0 + second % 9,
            east_m=400.0 if second == 30 else 0.0,
            velocity_sigma=2.0 if 40 <= second < 45 else 0.6,
        )

    def feed(now: int) -> list[m.Message]:
        return [] if 50 * S < now < 100 * S or now < 3 * S else every(300 * MS, make)(now)

    node = LinkNode(10.0)
    node.on(m.WallClock(t_ns=0, unix_ns=1_795_262_400 * S, source="system"))
    return gps(fly(node, 0, 110 * S, feed))


def test_fact_fix_type_is_3_or_1_and_never_0() -> None:
    assert {g.fix_type for g in everything_sent()} == {1, 3}


def test_fact_what_is_sent_as_3d_passes_every_check_of_the_autopilot_but_honest_accuracy() -> None:
    good = [g for g in everything_sent() if g.fix_type == 3]
    assert all(6 <= g.satellites_visible <= 10 for g in good)
    assert all(g.hdop <= 1.4 and g.vdop <= 1.4 for g in good)
    assert all(g.speed_accuracy_mps < 1.5 for g in good)
    assert all(0.5 <= g.horiz_accuracy_m <= 100.0 for g in good)
    assert all(g.time_week > 0 and g.alt_amsl_m == ALT and g.ve_mps == SPEED_EAST for g in good)


def test_fact_all_fields_are_sent_and_yaw_is_none() -> None:
    for g in everything_sent():
        sent = gps_input.encode(g, 0)
        assert (sent.ignore_flags, sent.yaw) == (0, 0)


def test_fact_gps_input_has_no_gap_over_245_ms_except_silence() -> None:
    times = [g.t_ns for g in everything_sent()]
    gaps = [b - a for a, b in pairwise(times)]
    assert sorted(gaps)[-2] <= 245 * MS  # except the one silence
    assert max(gaps) > 4 * S


def test_fact_no_single_report_has_a_bad_accuracy() -> None:
    sent = [g for g in everything_sent() if g.fix_type == 3]
    assert all(b.horiz_accuracy_m < max(15.1, 3.1 * a.horiz_accuracy_m) for a, b in pairwise(sent))


# --- end to end ---


@pytest.mark.slow
def test_the_simulated_autopilot_navigates_on_the_gps_input_of_the_link(tmp_path: Path) -> None:
    flight, peer = LiveFlight(), AutopilotPeer(seed=3)
    port = peer.start(0, eastward, flight.clock)
    edge = open_edge(LinkSection(device=f"udpout:127.0.0.1:{port}"))
    published = live(LinkNode(10.0), edge, 3.0, flight.feed)
    report = peer.stop()
    edge.close()
    assert 20 <= report.gps_input_received <= 32
    assert report.accepted == report.gps_input_received - report.no_fix
    assert (report.rejected, report.resets, report.other_instance, report.bad_packets) == (0, 0, 0, 0)
    assert report.fix3_share > 0.7
    assert report.interval_median_ms == pytest.approx(100.0, abs=20.0)
    assert report.gps_error_median_m is not None
    assert report.gps_error_median_m < 1.0
    assert report.fixes_beyond_3_sigma == 0
    assert report.position_error_median_m is not None
    assert report.position_error_median_m < 1.0
    assert report.message_intervals_set >= len(STREAMS_HZ)  # that of a gimbal, which it has not, is asked for again
    assert report.timesync_requests >= 5
    assert report.companion_heartbeats in (3, 4)
    assert "Terrafix: 3D fix" in report.status_texts
    report.write(tmp_path / "peer.json")
    assert json.loads((tmp_path / "peer.json").read_text())["accepted"] == report.accepted
    states = [x for x in published if isinstance(x, m.VehicleState)]
    assert len(states) > 20  # 25 Hz requested
    assert states[-1].agl_m == pytest.approx(120.0, abs=2.0)
    assert states[-1].yaw_rad == pytest.approx(math.pi / 2, abs=0.1)
    status = [x for x in published if isinstance(x, m.LinkStatus)][-1]
    assert (status.connected, status.autopilot) == (True, "ardupilot")
    assert status.time_offset_ms is not None


@pytest.mark.slow
def test_gps_input_keeps_its_interval_for_20_s_with_one_wrong_estimate(stall_ms: Callable[[], float]) -> None:
    """AC-14 and AC-3, with the scheduling delay of this machine added."""
    flight, peer = LiveFlight(), AutopilotPeer(seed=4)
    edge = open_edge(LinkSection(device=f"udpout:127.0.0.1:{peer.start(0, eastward, flight.clock)}"))
    node = LinkNode(10.0)

    def feed(now_ns: int) -> list[m.Message]:
        flight.east_m = 350.0 if 10.0 <= flight.clock() < 10.25 else 0.0
        return flight.feed(now_ns)

    live(node, edge, 20.0, feed)
    report = peer.stop()
    edge.close()
    delay_ms = stall_ms()
    assert report.healthy_share > 0.99
    assert report.longest_gap_ms is not None
    assert report.longest_gap_ms < 245.0 + delay_ms
    assert report.interval_p99_ms is not None
    assert report.interval_p99_ms <= 120.0 + delay_ms
    assert 1 <= report.no_fix <= 6
    assert report.gps_error_p95_m is not None
    assert report.gps_error_p95_m < 1.0
    assert report.position_error_max_m is not None
    assert report.position_error_max_m < 1.0


def test_the_simulated_autopilot_answers_parameters_and_rejects_other_commands() -> None:
    peer = AutopilotPeer()
    port = peer.start(0, eastward)
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.settimeout(2.0)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)

    def ask(packet: Any, kind: str) -> list[Any]:
        wire.sendto(packet.pack(mav), ("127.0.0.1", port))
        found: list[Any] = []
        until = time.monotonic() + 0.15
        while time.monotonic() < until:
            found += mav.parse_buffer(wire.recv(4096)) or []
        return [x for x in found if x.get_type() == kind]

    assert len(ask(mavlink.MAVLink_param_request_list_message(1, 1), "PARAM_VALUE")) == len(FIRMWARE)
    (value,) = ask(mavlink.MAVLink_param_request_read_message(1, 1, b"GPS1_TYPE", -1), "PARAM_VALUE")
    assert (value.param_id, value.param_value) == ("GPS1_TYPE", 14.0)
    (ack,) = ask(mavlink.MAVLink_command_long_message(1, 1, 400, 0, *(0.0,) * 7), "COMMAND_ACK")
    assert ack.result == mavlink.MAV_RESULT_UNSUPPORTED
    wire.close()
    peer.stop()


def test_a_used_port_of_the_simulated_autopilot_raises_one_line() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(LinkError, match="cannot be used"):
            AutopilotPeer().start(taken.getsockname()[1], eastward)


def test_the_simulated_autopilot_runs_in_its_own_process(tmp_path: Path) -> None:
    write_course(tmp_path / "course.csv", [(t / 2, eastward(t / 2)) for t in range(60)])
    out = tmp_path / "peer.json"
    zero_ns = time.monotonic_ns()
    options = ["--port", "0", "--out", str(out), "--start-ns", str(zero_ns)]
    command = [sys.executable, "-m", "terrafix_lab.sim.autopilot.process", str(tmp_path / "course.csv"), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline().rsplit(":", 1)[1])
        flight = LiveFlight(zero_ns)
        edge = open_edge(LinkSection(device=f"udpout:127.0.0.1:{port}"))
        live(LinkNode(10.0), edge, 1.5, flight.feed)
        os.kill(process.pid, signal.SIGTERM)
        assert process.wait(10) == 0
        edge.close()
    report = json.loads(out.read_text())
    assert report["gps_input_received"] >= 5
    assert report["gps_error_median_m"] < 2.0
