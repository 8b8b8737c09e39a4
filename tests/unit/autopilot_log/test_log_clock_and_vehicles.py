"""Telemetry logs as ground stations and boards without a clock write them: times, vehicles, damage. Packets are packed
by pymavlink, and mode names are those of its own table."""

import math
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.mavutil import AP_MAV_TYPE_MODE_MAP
from typer.testing import CliRunner

from source_folders import TOML, flight
from terrafix.core.errors import SourceError
from terrafix.core.mavlink.tlog import TelemetryLog, read_imu, read_tlog
from terrafix.core.mavlink.vehicles import ARDUPILOT_TYPES
from terrafix.vision.sources import open_source
from terrafix_lab.sim.autopilot.peer import telemetry_records
from terrafix_tools import cli
from terrafix_tools.autopilot_log.read import read_autopilot_log

T0_US = 1_717_236_000_000_000
DAY_US = 86_400_000_000
SECONDS, RATE_HZ, BOOT_MS = 60, 10, 20_000
Stamp = Callable[[float, int], int]  # (s of the flight, right stamp) -> stamp in the log


def record(t_us: int, message: Any, sender: mavlink.MAVLink) -> bytes:
    packet = message.pack(sender)
    sender.seq = (sender.seq + 1) % 256
    return t_us.to_bytes(8, "big") + packet


def swinging(t_s: float) -> tuple[float, ...]:
    return (0.1 * math.sin(t_s), 0.1 * math.cos(t_s), 0.5 * math.sin(0.7 * t_s), 0.0, 0.0, 0.0)


def log(
    path: Path,
    stamp: Stamp = lambda _, t_us: t_us,
    *,
    vehicle: int = 2,
    mode: int = 5,
    system: int = 1,
    inertial: bool = False,
) -> list[bytes]:
    """A flight of a minute: heartbeats at 1 Hz, attitude at 10 Hz, height at 2 Hz. -> its records, which are
    written."""
    sender, records = mavlink.MAVLink(None, srcSystem=system, srcComponent=1), []
    for k in range(SECONDS * RATE_HZ):
        t_s = k / RATE_HZ
        t_us, boot_ms = stamp(t_s, T0_US + round(t_s * 1e6)), BOOT_MS + round(t_s * 1e3)
        messages: list[Any] = []
        if k % RATE_HZ == 0:
            messages.append(mavlink.MAVLink_heartbeat_message(vehicle, 3, 81 | 128, mode, 4, 3))
        messages.append(mavlink.MAVLink_attitude_message(boot_ms, *swinging(t_s)))
        if k % 5 == 0:
            position = (473977000 + k, 85456000, 530_000, 30_000 + k, 0, 0, 0, 0)
            messages.append(mavlink.MAVLink_global_position_int_message(boot_ms, *position))
        if inertial:
            messages.append(mavlink.MAVLink_scaled_imu2_message(boot_ms, 0, 0, -1000, 1, 2, 3, 0, 0, 0))
        records += [record(t_us, message, sender) for message in messages]
    path.write_bytes(b"".join(records))
    return records


def steps(*jumps: tuple[float, int]) -> Stamp:
    """A clock that jumps by so many microseconds at so many seconds."""
    return lambda t_s, t_us: t_us + sum(size for at_s, size in jumps if t_s >= at_s)


CLOCKS: dict[str, Stamp] = {
    "1970": steps((0.0, 47_000_000 - T0_US)),
    "set by NTP from three months ago": steps((10.0, 90 * DAY_US)),
    "set back by NTP": steps((10.0, -40 * DAY_US)),
    "1970, then set by NTP": steps((0.0, 47_000_000 - T0_US), (10.0, T0_US - 47_000_000)),
    "set by NTP, then 1970 after a restart": steps((20.0, 1_000_000 - T0_US)),
    "summer time": steps((10.0, 3_600_000_000)),
    "winter time": steps((10.0, -3_600_000_000)),
    "a small correction": steps((30.0, 2_500_000)),
    "a small correction back": steps((30.0, -2_500_000)),
    "twice": steps((10.0, 3_600_000_000), (30.0, -7_200_000_000)),
    "at the second record": steps((0.05, DAY_US * 400)),
    "a far future": steps((25.0, 3650 * DAY_US)),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_a_jump_of_the_logs_clock_is_repaired_by_the_autopilots_own_time_and_said(name: str, tmp_path: Path) -> None:
    log(tmp_path / "right.tlog", inertial=True)
    log(tmp_path / "a.tlog", CLOCKS[name], inertial=True)
    found, right = (TelemetryLog(tmp_path / f"{which}.tlog") for which in ("a", "right"))
    assert len(found.states) == len(right.states) == 600 + 120
    assert [s.t_ns for s in found.states] == pytest.approx([s.t_ns for s in right.states], abs=1000)
    assert [batch.t_ns for batch in found.imu] == pytest.approx([batch.t_ns for batch in right.imu], abs=1000)
    jumps = sum("clock of the log jumps" in note for note in found.notes())
    assert jumps == {"1970": 0, "1970, then set by NTP": 1, "twice": 2}.get(name, 1)
    assert right.notes() == [] and right.skipped_bytes == 0


def test_the_zero_that_a_flight_states_is_that_of_the_clock_that_was_right(tmp_path: Path) -> None:
    log(tmp_path / "a.tlog", CLOCKS["1970, then set by NTP"])
    assert read_tlog(tmp_path / "a.tlog", T0_US + 5_000_000)[0].t_ns == pytest.approx(-5e9, abs=1000)


@pytest.mark.parametrize("index", [0, 1, 2, 300, 301, -1])
@pytest.mark.parametrize("bit", [30, 35, 44, 51, 60])
def test_one_damaged_bit_of_a_time_stamp_costs_nothing(index: int, bit: int, tmp_path: Path) -> None:
    records = log(tmp_path / "a.tlog")
    right = [s.t_ns for s in read_tlog(tmp_path / "a.tlog")]
    stamp = int.from_bytes(records[index][:8], "big") ^ (1 << bit)
    records[index] = stamp.to_bytes(8, "big") + records[index][8:]
    (tmp_path / "a.tlog").write_bytes(b"".join(records))
    found = TelemetryLog(tmp_path / "a.tlog")
    assert [s.t_ns for s in found.states] == pytest.approx(right, abs=200_000_000)
    assert found.damaged_stamps == 1 and found.jumps == []


def test_packets_that_the_link_held_back_keep_their_time_of_arrival(tmp_path: Path) -> None:
    """Three seconds without reception, then all packets of that time at once: no jump of the clock."""
    log(tmp_path / "a.tlog", lambda t_s, t_us: t_us + (round((23.0 - t_s) * 1e6) if 20.0 <= t_s < 23.0 else 0))
    found = TelemetryLog(tmp_path / "a.tlog")
    assert found.jumps == []
    held = [s.t_ns for s in found.states if s.yaw_rad is not None][200:230]
    assert held == [23_000_000_000] * 30


def test_a_restart_of_the_autopilot_is_no_jump_of_the_clock(tmp_path: Path) -> None:
    first = log(tmp_path / "a.tlog")
    second = log(tmp_path / "b.tlog", lambda _, t_us: t_us + 90_000_000)
    (tmp_path / "a.tlog").write_bytes(b"".join(first + second))
    found = TelemetryLog(tmp_path / "a.tlog")
    assert found.jumps == [] and found.states[-1].t_ns == pytest.approx(149.9e9, abs=1000)


def test_without_the_autopilots_time_a_jump_is_taken_for_no_gap_and_said(tmp_path: Path) -> None:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    hud = [mavlink.MAVLink_vfr_hud_message(0, 0, k % 360, 0, 300.0, 0) for k in range(100)]
    stamps = [T0_US + k * 100_000 - (400 * DAY_US if k < 50 else 0) for k in range(100)]
    (tmp_path / "a.tlog").write_bytes(b"".join(record(t, m, sender) for t, m in zip(stamps, hud, strict=True)))
    found = TelemetryLog(tmp_path / "a.tlog")
    times_s = sorted({s.t_ns / 1e9 for s in found.states if s.yaw_rad is not None})
    assert len(times_s) == 99 and times_s[-1] == pytest.approx(9.8)  # the two beside the jump have one time
    assert ["no packet says the true time" in note for note in found.notes()] == [True]


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("torn", [5, 20, 33])
def test_a_log_whose_front_is_torn_off_is_read_by_its_content(version: int, torn: int, tmp_path: Path) -> None:
    records = log(tmp_path / "a.tlog")
    if version == 1:
        sender, records = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), []
        for k in range(100):
            message = mavlink.MAVLink_attitude_message(BOOT_MS + 100 * k, *swinging(k / 10))
            records.append((T0_US + 100_000 * k).to_bytes(8, "big") + message.pack(sender, force_mavlink1=True))
    path = tmp_path / "without_a_suffix.dat"
    path.write_bytes(b"".join(records)[torn:])
    read = read_autopilot_log(path)
    assert read.skipped_bytes == len(records[0]) - torn if torn < len(records[0]) else read.skipped_bytes > 0
    assert len(read.attitude.t_s) >= (600 if version == 2 else 99) - 1


def test_damaged_packets_and_foreign_bytes_are_skipped_by_the_checksum(tmp_path: Path) -> None:
    records = log(tmp_path / "a.tlog")
    damaged = bytearray(records[100])
    damaged[20] ^= 0x10
    records[100] = bytes(damaged)
    records.insert(300, b"\xfd" * 57 + bytes(40))
    (tmp_path / "a.tlog").write_bytes(b"".join(records))
    found = TelemetryLog(tmp_path / "a.tlog")
    assert len(found.states) == 720 - 1 and found.skipped_bytes == len(damaged) + 97


def test_a_stream_of_packets_without_time_stamps_is_no_log(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").write_bytes(b"".join(r[8:] for r in log(tmp_path / "b.tlog")))
    with pytest.raises(SourceError, match="holds no MAVLink record"):
        read_tlog(tmp_path / "a.tlog")


def two(path: Path, *, both_fly: bool = False, tracker: bool = False) -> None:
    """Vehicle 2 stands and is heard first, vehicle 1 flies; or both fly; or 2 is an antenna tracker that turns."""
    senders = {i: mavlink.MAVLink(None, srcSystem=i, srcComponent=1) for i in (1, 2)}
    records = []
    for k in range(300):
        for system in (2, 1):
            if system == 2 and k % 10 and not (both_fly or tracker):
                continue
            moves = system == 1 or both_fly or tracker
            angles = swinging(k / 10) if moves else (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
            # vehicle 2 has run for longer
            boot_ms = BOOT_MS + 100 * k + (500_000 if system == 2 else 0)
            if k % 10 == 0:
                kind = 5 if tracker and system == 2 else 2
                armed = 128 if moves else 0
                beat = mavlink.MAVLink_heartbeat_message(kind, 3, 81 | armed, 5, 4, 3)
                records.append(record(T0_US + 100_000 * k, beat, senders[system]))
            attitude = mavlink.MAVLink_attitude_message(boot_ms, *angles)
            records.append(record(T0_US + 100_000 * k, attitude, senders[system]))
    path.write_bytes(b"".join(records))


def test_of_two_vehicles_the_one_that_moves_is_read_and_both_are_named(tmp_path: Path) -> None:
    two(tmp_path / "a.tlog")
    found = read_autopilot_log(tmp_path / "a.tlog")
    assert len(found.attitude.t_s) == 300
    (note,) = found.notes
    assert note.startswith("vehicles heard: 2 (ArduCopter, 30 attitudes, stands), 1 (ArduCopter, 300 attitudes, moves")
    assert note.endswith("vehicle 1 is read, the only one that moves")


def test_the_vehicle_of_a_log_is_chosen_by_system_and_by_system_id(tmp_path: Path) -> None:
    two(tmp_path / "a.tlog")
    assert len(read_imu(tmp_path / "a.tlog", system_id=2)) == 0
    shown = CliRunner().invoke(cli.app, ["log", "info", str(tmp_path / "a.tlog"), "--system", "2"]).output
    assert "attitude 30," in shown and "vehicle 2 is read, as chosen" in shown
    folder = flight(
        tmp_path / "f", csv="file,t_s\n" + "".join(f"{i:04}.jpg,{i}\n" for i in range(5)),
        toml=TOML.replace("yaw_sigma_deg = 3.0", "yaw_sigma_deg = 3.0\nsystem_id = 2"),
    )  # fmt: skip
    two(folder / "telemetry.tlog")
    states = [state for shot in open_source(str(folder)).shots() for state in shot.states]
    assert {state.yaw_rad for state in states} == {1.0}
    with pytest.raises(SourceError, match=r"has no vehicle 7; heard: 2 \(ArduCopter.*1 \(ArduCopter"):
        read_tlog(tmp_path / "a.tlog", system_id=7)


def test_of_two_vehicles_that_fly_none_is_guessed(tmp_path: Path) -> None:
    two(tmp_path / "a.tlog", both_fly=True)
    with pytest.raises(
        SourceError, match=r"several vehicles could be meant: 2 .*1 .*--system, or \[telemetry\] system_id"
    ):
        read_tlog(tmp_path / "a.tlog")
    assert len(read_tlog(tmp_path / "a.tlog", system_id=1)) == 300


def test_an_antenna_tracker_that_turns_is_no_vehicle(tmp_path: Path) -> None:
    two(tmp_path / "a.tlog", tracker=True)
    log_of_vehicle = TelemetryLog(tmp_path / "a.tlog")
    assert log_of_vehicle.system_id == 1 and "the only vehicle with telemetry" in log_of_vehicle.notes()[0]


@pytest.mark.parametrize("kind", sorted(mavlink.enums["MAV_TYPE"]))
def test_modes_are_named_by_the_type_of_the_vehicle_and_unknown_types_have_no_names(kind: int, tmp_path: Path) -> None:
    """The reference is pymavlink's table; types that it lacks and MAVLink calls VTOLs run ArduPlane."""
    table = AP_MAV_TYPE_MODE_MAP.get(kind, AP_MAV_TYPE_MODE_MAP[1] if kind in range(19, 26) else {})
    for mode in sorted(table) or [5]:
        log(tmp_path / "a.tlog", vehicle=kind, mode=mode)
        read = read_autopilot_log(tmp_path / "a.tlog")
        (text,) = [event.text for event in read.events if event.kind == "mode"]
        if not table:
            assert text == f"mode {mode}" and read.firmware == ""
        elif text != f"mode {mode}":  # pymavlink's table may be newer than its enumeration
            assert text.replace(" ", "")[:4] == table[mode].lower().replace("_", "")[:4] or "fly" in text
        break


def test_every_type_has_one_firmware() -> None:
    types = [kind for kinds in ARDUPILOT_TYPES.values() for kind in kinds]
    assert len(types) == len(set(types))


def test_the_banner_of_a_quadplane_that_states_a_quadrotor_names_its_modes(tmp_path: Path) -> None:
    records = log(tmp_path / "a.tlog", vehicle=2, mode=19)
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    banner = record(T0_US, mavlink.MAVLink_statustext_message(6, b"ArduPlane V4.5.7 (0358a9c2)"), sender)
    (tmp_path / "a.tlog").write_bytes(records[0] + banner + b"".join(records[1:]))
    read = read_autopilot_log(tmp_path / "a.tlog")
    assert read.firmware == "ArduPlane V4.5.7 (0358a9c2)"
    assert [event.text for event in read.events if event.kind == "mode"] == ["qloiter"]


@pytest.mark.parametrize("autopilot", [0, 4, 8])
def test_a_firmware_that_is_neither_ardupilot_nor_px4_has_no_mode_names(autopilot: int, tmp_path: Path) -> None:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = record(T0_US, mavlink.MAVLink_heartbeat_message(2, autopilot, 81, 5, 4, 3), sender)
    attitude = record(T0_US, mavlink.MAVLink_attitude_message(1, *swinging(0.0)), sender)
    (tmp_path / "a.tlog").write_bytes(beat + attitude)
    assert read_autopilot_log(tmp_path / "a.tlog").events[0].text == "mode 5"


@pytest.mark.parametrize(
    ("name", "attitudes", "mode"),
    [
        ("normal", 600, "ArduCopter loiter"),
        ("1970", 600, "ArduCopter loiter"),
        ("ntp_ahead", 600, "ArduCopter loiter"),
        ("hour_ahead", 600, "ArduCopter loiter"),
        ("first_bad", 600, "ArduCopter loiter"),
        ("middle_bad", 600, "ArduCopter loiter"),
        ("dodeca", 600, "ArduCopter loiter"),
        ("sub", 600, "ArduSub manual"),
        ("two_vehicles", 600, "ArduCopter loiter"),
    ],
)
def test_logs_of_the_field_are_read_as_they_were_flown(
    name: str, attitudes: int, mode: str, data_set: Callable[[str], Path]
) -> None:
    read = read_autopilot_log(data_set("field") / "tlog-clock" / f"{name}.tlog")
    assert len(read.attitude.t_s) == attitudes
    assert read.span_s[1] - read.span_s[0] == pytest.approx(59.9, abs=1e-3)
    assert f"{read.firmware} {next(e.text for e in read.events if e.kind == 'mode')}" == mode
    assert np.all(np.diff(read.attitude.t_s) > 0.0)


def test_a_simulated_autopilot_leaves_the_log_that_a_ground_station_would(tmp_path: Path) -> None:
    records = log(tmp_path / "right.tlog")
    signer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    signer.signing.sign_outgoing, signer.signing.secret_key, signer.signing.timestamp = True, bytes(32), 1
    signed = signer.heartbeat_encode(2, 3, 209, 5, 4, 3).pack(signer)
    last_us = int.from_bytes(records[-1][:8], "big")
    written = [(stamp, b"".join(r[8:] for r in group)) for stamp, group in groupby(records, lambda r: r[:8])]
    data = b"".join(telemetry_records(packets, int.from_bytes(stamp, "big")) for stamp, packets in written)
    assert data == b"".join(records)
    both = telemetry_records(signed + records[0][8:], last_us)
    assert both == last_us.to_bytes(8, "big") + signed + last_us.to_bytes(8, "big") + records[0][8:]
    (tmp_path / "left.tlog").write_bytes(data)
    assert len(read_autopilot_log(tmp_path / "left.tlog").attitude.t_s) == SECONDS * RATE_HZ
