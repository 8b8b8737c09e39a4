"""The observer's log and the report from it, with constructed packets and trajectories."""

import contextlib
import json
import math
import socket
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix_lab.sim.sitl.firmware import Home
from terrafix_lab.sim.sitl.observer import (
    SO_TIMESTAMPNS,
    FlightLog,
    Observer,
    PositionRecord,
    StatusTextRecord,
    Truth,
    arrival_ns,
    interpolate,
    record,
)
from terrafix_lab.sim.sitl.report import (
    Figures,
    Interruption,
    Times,
    figures,
    verdicts,
    write_report,
    write_texts,
    write_truth,
)

EAST_DEG_PER_M = 1.0 / (111_319.49 * math.cos(math.radians(48.0)))  # WGS84's equatorial radius: good to 0.5 %
LAT_DEG, LON_DEG, HOME_AMSL_M = 48.0, 14.0, 320.0
S = 1_000_000_000
TIMES = Times(armed_ns=10 * S, lost_ns=60 * S, landed_ns=380 * S)


def state(t_s: float, east_m: float) -> Truth:
    up_m = HOME_AMSL_M + 120.0 if t_s < 360.0 else HOME_AMSL_M
    return Truth(round(t_s * S), LAT_DEG, LON_DEG + east_m * EAST_DEG_PER_M, up_m, (0.0, 20.0, 0.0), 0.0, 0.0, 1.57)


def good_flight() -> FlightLog:
    """20 m/s to the east from the loss at 60 s, for 300 s; position error 3 m; landing 10 m too far."""
    log = FlightLog()
    log.truth = [state(t, 20.0 * min(300.0, max(0.0, t - 60.0))) for t in range(381)]
    log.positions = [
        PositionRecord(t * S, LAT_DEG, LON_DEG + (20.0 * (t - 60) + 3.0) * EAST_DEG_PER_M) for t in range(61, 360)
    ]
    log.fix_types[0].extend((t * S, 6 if t < 60 else 1) for t in range(5, 360))
    log.fix_types[1].extend((t * S, 3) for t in range(30, 360))
    log.gps_healthy = [(t * S, True) for t in range(5, 360)]
    return log


def landing(error_m: float = 10.0) -> Home:
    return Home(LAT_DEG, LON_DEG + (6000.0 - error_m) * EAST_DEG_PER_M, HOME_AMSL_M, 90.0)


def test_a_good_flight_passes_all_verdicts() -> None:
    flown = figures(good_flight(), TIMES, landing())
    assert flown.flown_m == pytest.approx(6000.0, rel=0.006)
    assert flown.landing_error_m == pytest.approx(10.0, rel=0.01) and flown.touchdown_m == flown.landing_error_m
    assert flown.belief_touchdown_m == pytest.approx(3.0, rel=0.02)
    assert flown.belief_median_m == pytest.approx(3.0, rel=0.02) and flown.without_gnss_s == pytest.approx(300.0)
    assert flown.gps_input_fix_share == 1.0 and flown.gps_input_longest_gap_s == 0.0
    assert all(verdicts(flown, 5000.0).values())


def failing(log: FlightLog, times: Times = TIMES, error_m: float = 10.0) -> set[str]:
    return {what for what, good in verdicts(figures(log, times, landing(error_m)), 5000.0).items() if not good}


def test_each_failure_fails_its_verdict() -> None:
    flight_log = good_flight()
    flight_log.texts.append(StatusTextRecord(100 * S, 2, "PreArm: GPS 2: not healthy"))
    assert failing(flight_log) == {"no 'GPS not healthy'"}
    sick = good_flight()
    sick.gps_healthy[150] = (155 * S, False)
    assert failing(sick) == {"no 'GPS not healthy'"}
    led = good_flight()
    led.texts.append(StatusTextRecord(100 * S, 1, "EKF Failsafe: changed to LAND Mode"))
    assert failing(led) == {"no EKF failsafe"}
    cheated = good_flight()
    cheated.fix_types[0].append((200 * S, 3))
    assert failing(cheated) == {"5 km on GPS_INPUT alone"}
    blind = good_flight()
    blind.fix_types[0][10] = (15 * S, 1)
    assert failing(blind) == {"take-off on GNSS"}
    assert failing(good_flight(), error_m=31.0) == {"landing within 30 m"}
    assert failing(good_flight(), replace(TIMES, landed_ns=None)) == {"landed", "landing within 30 m"}
    rolling = good_flight()
    rolling.truth.append(state(400.0, 6050.0))
    assert failing(rolling, replace(TIMES, landed_ns=400 * S)) == {"landing within 30 m"}
    aloft = good_flight()
    aloft.truth = [one for one in aloft.truth if one.t_ns < 360 * S]
    no_touchdown = "own position within 20 m at touchdown"
    assert failing(aloft, replace(TIMES, landed_ns=None)) == {"landed", "landing within 30 m", no_touchdown}


def moved(log: FlightLog, from_s: int, to_s: int, east_m: float) -> FlightLog:
    """The autopilot's own position is ``east_m`` farther off, for this time."""
    log.positions = [
        replace(one, lon_deg=one.lon_deg + east_m * EAST_DEG_PER_M) if from_s * S <= one.t_ns < to_s * S else one
        for one in log.positions
    ]
    return log


def without_fix(log: FlightLog, from_s: int, to_s: int, *, unhealthy: bool = False) -> FlightLog:
    """GPS_INPUT has no 3D fix for this time, and the firmware reports that no GPS is healthy."""
    log.fix_types[1][:] = [(t, 1 if from_s * S <= t < to_s * S else fix) for t, fix in log.fix_types[1]]
    if unhealthy:
        log.gps_healthy = [(t, good and not from_s * S <= t < to_s * S) for t, good in log.gps_healthy]
    return log


def test_the_share_of_the_time_with_a_fix_and_its_longest_gap_are_judged() -> None:
    share, gap = "3D fix for 95% of the time", "never 7 s without a 3D fix"
    assert failing(without_fix(good_flight(), 100, 107)) == set(), "reports a second apart: a gap of 6 s"
    assert failing(without_fix(good_flight(), 100, 108)) == {gap}
    often = good_flight()
    for at_s in range(100, 260, 10):
        without_fix(often, at_s, at_s + 1)
    assert failing(often) == {share}, "16 of 300 reports"


def test_unhealthy_reports_without_a_fix_count_towards_the_share_of_healthy_ones() -> None:
    health = "GPS healthy in 95% of the reports"
    assert failing(without_fix(good_flight(), 100, 104, unhealthy=True)) == set()
    sick = good_flight()
    for at_s in range(100, 260, 10):
        without_fix(sick, at_s, at_s + 1, unhealthy=True)
    assert failing(sick) == {"3D fix for 95% of the time", health}
    silent = good_flight()
    silent.gps_healthy.clear()
    assert failing(silent) == {health}, "no report is no good report"


def test_a_restart_is_left_out_of_the_share_and_of_the_gap_until_the_fix_is_back() -> None:
    killed = Interruption(100 * S, 118 * S, 120 * S, 121 * S)
    log = without_fix(good_flight(), 100, 120, unhealthy=True)
    flown = figures(log, replace(TIMES, interruptions=(killed,)), landing())
    assert flown.gps_input_longest_gap_s == 19.0 and flown.gps_input_fix_share < 0.95
    assert (flown.undisturbed_longest_gap_s, flown.undisturbed_fix_share, flown.undisturbed_healthy_share) == (0, 1, 1)
    assert failing(log, replace(TIMES, interruptions=(killed,))) == set()
    after = without_fix(log, 120, 130)
    assert "never 7 s without a 3D fix" in failing(after, replace(TIMES, interruptions=(killed,)))


def test_the_error_of_the_autopilots_own_position_is_judged() -> None:
    p95, most = "own position within 20 m for 95 % of the time", "own position within 50 m always"
    touchdown = "own position within 20 m at touchdown"
    assert failing(moved(good_flight(), 100, 110, 30.0)) == set(), "3 % of the time"
    assert failing(moved(good_flight(), 100, 130, 30.0)) == {p95}
    assert failing(moved(good_flight(), 100, 101, 60.0)) == {most}
    assert failing(moved(good_flight(), 358, 360, 18.0)) == {touchdown}
    unknown = good_flight()
    unknown.positions.clear()
    assert failing(unknown) == {p95, most, touchdown}


def test_a_glitch_and_a_crash_that_is_noticed_on_the_ground_fail() -> None:
    led = good_flight()
    led.texts.append(StatusTextRecord(100 * S, 2, "GPS Glitch or Compass error"))
    assert failing(led) == {"no GPS glitch"}
    broken = good_flight()
    broken.texts.append(StatusTextRecord(362 * S, 2, "Crash: Disarming: AngErr=71>30, Accel=0.3<3.0"))
    assert failing(broken) == {"no crash"}


def test_every_restart_is_timed_and_the_slowest_decides() -> None:
    def flown_with(*back_s: float | None) -> tuple[Figures, bool]:
        log, kills = good_flight(), []
        for at_s, after_s in zip((100, 140, 180), back_s, strict=False):
            until_s = 20.0 if after_s is None else 5.0 + after_s
            gone = [(t_ns, fix) for t_ns, fix in log.fix_types[1] if at_s * S + 4 * S <= t_ns < (at_s + until_s) * S]
            for t_ns, fix in gone:
                log.fix_types[1][log.fix_types[1].index((t_ns, fix))] = (t_ns, 1)
            recovered_ns = None if after_s is None else round((at_s + 5.0 + after_s) * S)
            kills.append(Interruption(at_s * S, (at_s + 5) * S, recovered_ns))
        flown = figures(log, replace(TIMES, interruptions=tuple(kills)), landing())
        return flown, verdicts(flown, 5000.0)["3D fix again within 2 s of each interruption"]

    flown, quick = flown_with(1.0, 1.5)
    assert flown.back_s == pytest.approx([1.0, 1.5]) and flown.seen_lost_s == pytest.approx([4.0, 4.0]) and quick
    assert flown_with(1.0, 2.5, 1.0)[1] is False
    late = Interruption(100 * S, 105 * S, 106 * S, 109 * S)
    assert "used by the EKF within 2 s of this fix" in failing(good_flight(), replace(TIMES, interruptions=(late,)))
    never, quick = flown_with(1.0, None)
    assert never.back_s == [1.0, None] and not quick


def test_events_before_arming_or_before_the_loss_do_not_count() -> None:
    log = good_flight()
    log.texts += [
        StatusTextRecord(5 * S, 2, "PreArm: GPS 2: not healthy"),
        StatusTextRecord(6 * S, 6, "AHRS: DCM active"),
    ]
    log.gps_healthy[0] = (5 * S, False)
    assert failing(log) == set()


def test_a_gps_without_a_fix_or_on_the_ground_is_not_unhealthy() -> None:
    log = good_flight()
    log.gps_healthy[150] = (155 * S, False)
    fixes = log.fix_types[1]
    fixes[fixes.index((155 * S, 3))] = (155 * S, 1)
    log.gps_healthy.append((370 * S, False))
    assert failing(log) == set()


def test_a_failsafe_on_the_ground_is_counted_separately_and_one_that_is_cleared_once() -> None:
    log = good_flight()
    log.texts += [
        StatusTextRecord(90 * S, 1, "EKF Failsafe: changed to LAND Mode"),
        StatusTextRecord(95 * S, 1, "EKF Failsafe Cleared"),
        StatusTextRecord(361 * S, 2, "EKF variance"),
        StatusTextRecord(390 * S, 2, "EKF variance"),
    ]
    flown = figures(log, TIMES, landing())
    assert (flown.ekf_failsafes, flown.ekf_failsafes_on_ground) == (1, 1)


def test_gaps_of_gps_input_are_measured() -> None:
    log = good_flight()
    fixes = log.fix_types[1]
    for i, (t_ns, _) in enumerate(fixes):
        if 100 * S <= t_ns <= 104 * S:
            fixes[i] = (t_ns, 1)
    flown = figures(log, TIMES, landing())
    assert flown.gps_input_longest_gap_s == 4.0
    assert flown.gps_input_fix_share == pytest.approx(1.0 - 5 / 300, abs=1e-3)


def test_a_flight_that_was_not_started_fails() -> None:
    flown = figures(FlightLog(), Times(), landing())
    assert flown.flown_m == 0.0 and flown.landing_error_m is None
    held = verdicts(flown, 5000.0)
    assert not held["take-off on GNSS"] and not held["5 km on GPS_INPUT alone"] and not held["landed"]


def test_report_texts_and_truth_are_written(tmp_path: Path) -> None:
    log = good_flight()
    log.texts.append(StatusTextRecord(100 * S, 6, "EKF3 IMU0 is using GPS"))
    flown = figures(log, TIMES, landing())
    write_report(tmp_path / "a.json", {"vehicle": "plane"}, flown, 5000.0)
    write_texts(tmp_path / "texts.log", log)
    write_truth(tmp_path / "truth.csv", log)
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["passed"] is True and report["vehicle"] == "plane"
    assert report["figures"]["landing_error_m"] == flown.landing_error_m
    assert (tmp_path / "texts.log").read_text() == "   100.00 INFO      EKF3 IMU0 is using GPS\n"
    rows = (tmp_path / "truth.csv").read_text().splitlines()
    assert len(rows) == 382 and rows[-1].startswith("380000000000,48.0000000,14.08")


def test_packets_are_recorded_in_the_log() -> None:
    """Through the wire format: the log has the values that were packed."""
    sender, receiver = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), mavlink.MAVLink(None)
    zeros = [0.0] * 6
    sent = [
        mavlink.MAVLink_system_time_message(0, 0),
        mavlink.MAVLink_sim_state_message(
            1, 0, 0, 0, 0.1, -0.2, 1.5, *zeros, 0, 0, 412.5, 0, 0, 3, -4, 0.5, 481234567, 141234567
        ),
        mavlink.MAVLink_gps_raw_int_message(0, 1, 481234567, 141234567, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_sys_status_message(0, 0, mavlink.MAV_SYS_STATUS_SENSOR_GPS, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_statustext_message(4, b"GPS Glitch"),
        mavlink.MAVLink_autopilot_version_message(0, 0x040603FF, 0, 0, 0, list(b"3fc7011a"), [0] * 8, [0] * 8, 0, 0, 0),
        mavlink.MAVLink_heartbeat_message(1, 3, mavlink.MAV_MODE_FLAG_SAFETY_ARMED, 0, 0, 3),
    ]
    log = FlightLog()
    for message in receiver.parse_buffer(b"".join(one.pack(sender) for one in sent)) or []:
        record(log, message, 7)
    truth = log.truth[0]
    assert (truth.lat_deg, truth.lon_deg) == pytest.approx((48.1234567, 14.1234567), abs=1e-9)
    assert truth.amsl_m == 412.5 and truth.velocity_ned_mps == (3.0, -4.0, 0.5)
    assert (truth.roll_rad, truth.pitch_rad, truth.yaw_rad) == pytest.approx((0.1, -0.2, 1.5), abs=1e-6)
    assert log.fix_types[0] == [(7, 1)] and log.gps_healthy == [(7, True)] and log.armed == [(7, True)]
    assert log.texts == [StatusTextRecord(7, 4, "GPS Glitch")] and log.version == "4.6.3 (3fc7011a)"


def test_the_truth_has_the_firmware_time_regardless_of_its_arrival() -> None:
    """Bursts, a busy machine, a state of another cycle than the time before it, a clock that lost 50 ms."""
    rng = np.random.default_rng(3)
    log, apart_ns = FlightLog(), 1000 * S

    def send(boot_ms: int, late_ms: float, turn_ms: float = 0.05) -> None:
        arrival_ns = boot_ms * 1_000_000 + apart_ns + round(late_ms * 1e6)
        record(log, mavlink.MAVLink_system_time_message(0, boot_ms), arrival_ns)
        record(log, mavlink.MAVLink_global_position_int_message(boot_ms, 0, boot_ms, 0, 0, 0, 0, 0, 0), arrival_ns)
        state = mavlink.MAVLink_sim_state_message(*[0.0] * 15, boot_ms * 0.02, *[0.0] * 5, 0, 0)
        record(log, state, arrival_ns + round(turn_ms * 1e6))

    late_ms = rng.uniform(-3.0, 3.0, 200) + np.where(rng.random(200) < 0.2, 20.0, 0.0)
    for i, late in enumerate(late_ms):
        send(25 * i, late, turn_ms=5.0 if i % 10 == 9 else 0.05)
    assert len(log.truth) == 180, "of a state from another turn nobody knows when it was"
    settled = [one for one in log.truth if one.t_ns > apart_ns + 2 * S]
    true_ns = [one.amsl_m / 0.02 * 1e6 + apart_ns for one in settled]
    off_ms = (np.array([one.t_ns for one in settled]) - true_ns) / 1e6
    assert abs(off_ms.mean()) < 2.0 and np.ptp(off_ms) < 2.0
    assert log.positions[-1].t_ns - log.positions[-2].t_ns == pytest.approx(25e6, abs=1e6)
    apart_ns += 50_000_000
    for i in range(200, 300):
        send(25 * i, 0.0)
    assert all(b.t_ns > a.t_ns for a, b in pairwise(log.truth))
    assert log.truth[-1].t_ns == 25 * 299 * 1_000_000 + apart_ns


def test_after_a_reboot_of_the_firmware_the_truth_has_the_time_of_arrival_again() -> None:
    log = FlightLog()

    def send(boot_ms: int, arrival_ns: int) -> None:
        record(log, mavlink.MAVLink_system_time_message(0, boot_ms), arrival_ns)
        record(log, mavlink.MAVLink_sim_state_message(*[0.0] * 21, 0, 0), arrival_ns)

    for i in range(100):
        send(60_000 + 25 * i, 100 * S + i * 25_000_000)
    send(4_000, 110 * S)
    assert log.truth[-1].t_ns == 110 * S


def test_streams_that_a_rebooted_firmware_no_longer_sends_are_requested_again() -> None:
    observer = Observer(0)
    with observer, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as firmware:
        firmware.settimeout(0.2)
        mav, requested, until_s = mavlink.MAVLink(None, 1, 1), [], time.monotonic() + 8.0
        packets = [mavlink.MAVLink_system_time_message(0, 1), mavlink.MAVLink_gps_raw_int_message(0, 3, *[0] * 8)]
        began_s = time.monotonic()
        while time.monotonic() < until_s and mavlink.MAVLINK_MSG_ID_GPS_RAW_INT not in requested:
            for packet in packets[: 2 if time.monotonic() - began_s < 1.0 else 1]:
                firmware.sendto(packet.pack(mav), observer.address)
            with contextlib.suppress(TimeoutError):
                requested += [int(x.param1) for x in mav.parse_buffer(firmware.recv(4096)) or []]
    assert mavlink.MAVLINK_MSG_ID_GPS_RAW_INT in requested


def test_truth_is_interpolated_between_two_states() -> None:
    before, after = replace(state(1.0, 0.0), yaw_rad=3.1), replace(state(2.0, 20.0), yaw_rad=-3.1, roll_rad=0.4)
    middle = interpolate(before, after, 1_500_000_000)
    assert middle.lon_deg == pytest.approx(LON_DEG + 10.0 * EAST_DEG_PER_M, abs=1e-12)
    assert math.cos(middle.yaw_rad) == pytest.approx(-1.0) and middle.roll_rad == pytest.approx(0.2)


def test_truth_is_not_extrapolated() -> None:
    observer = Observer(0)
    observer.log.truth = [state(1.0, 0.0), state(2.0, 20.0)]
    assert observer.truth_at(S - 1) is None and observer.truth_at(2 * S + 1) is None
    assert observer.truth_at(S) == state(1.0, 0.0)
    with observer:
        pass  # closes the port


def test_a_late_reader_does_not_delay_the_truth() -> None:
    """The kernel's time stamp is that of the arrival, not of the read."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to,
    ):
        ours.bind(("127.0.0.1", 0))
        ours.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        before_ns = time.monotonic_ns()
        to.sendto(b"x", ours.getsockname())
        after_ns = time.monotonic_ns()
        time.sleep(0.2)
        extra = ours.recvmsg(16, 256)[1]
    assert before_ns - 5_000_000 <= arrival_ns(extra) <= after_ns + 5_000_000
    assert arrival_ns([]) >= after_ns + 200_000_000
