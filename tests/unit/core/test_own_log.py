"""An autopilot's own log beside a flight: ArduPilot's .bin and PX4's .ulg, on the clock of the frames."""

import math
from pathlib import Path

import numpy as np
import pytest
from pymavlink.quaternion import QuaternionBase

from autopilot_logs import (
    FORMATS,
    OFFSET_S,
    Row,
    Topic,
    attitude_rows,
    attitude_topic,
    flight,
    telemetry,
    write_dataflash,
    write_ulog,
)
from source_folders import flight as write_folder
from terrafix.core.autopilot_log.attitude import AttitudeSeries
from terrafix.core.autopilot_log.own_log import OwnLog
from terrafix.core.errors import SourceError
from terrafix.core.geodesy import rot_from_quat
from terrafix.messages import VehicleState
from terrafix.vision.sources.facts import facts_of
from terrafix.vision.sources.flight_folder import FlightFolder

MOUNT = {"MNT": ("QBfffffffff", "TimeUS,I,DesRoll,Roll,DesPitch,Pitch,DesYawB,YawB,DesYawE,YawE,Dist")}
HELD_DEG = (3.0, -80.0, 20.0)  # roll, pitch, yaw of the gimbal
LOG = flight(7, duration_s=40.0)
FORCE, TURN = (0.1, 0.2, -9.8), (0.01, 0.02, 0.03)


def ardupilot(path: Path) -> Path:
    rows = attitude_rows(LOG)
    roll, pitch, yaw = HELD_DEG
    for t_s in LOG.t_s.tolist():
        us = round(t_s * 1e6)
        imu = dict(zip(("AccX", "AccY", "AccZ", "GyrX", "GyrY", "GyrZ"), (*FORCE, *TURN), strict=True))
        rows += [("IMU", {"TimeUS": us, "I": 0, **imu}), ("POS", {"TimeUS": us, "RelHomeAlt": 2.0 * t_s})]
        rows.append(("MNT", {"TimeUS": us, "I": 0, "Roll": roll, "Pitch": pitch, "YawB": yaw, "YawE": 77.0}))
    rows.append(("EV", {"TimeUS": round((LOG.t_s[0] + 5.0) * 1e6), "Id": 10}))
    ordered: list[Row] = sorted(rows, key=lambda row: float(row[1]["TimeUS"]))
    return write_dataflash(path, ordered, FORMATS | MOUNT)


def px4(path: Path) -> Path:
    q = [float(value) for value in QuaternionBase(np.radians(HELD_DEG))]
    device = "float[4] q;uint32_t device_flags;uint32_t failure_flags;"
    times = LOG.t_s.tolist()
    topics: list[Topic] = [
        attitude_topic(LOG),
        ("vehicle_local_position", 0, "float z;", [(t, 10.0 - 2.0 * t) for t in times]),
        ("vehicle_status", 0, "uint8_t arming_state;", [(times[0], 1), (times[0] + 5.0, 2)]),
        ("sensor_combined", 0, "float[3] gyro_rad;float[3] accelerometer_m_s2;", [(t, *TURN, *FORCE) for t in times]),
        ("gimbal_device_attitude_status", 0, device, [(t, *q, 32, 0) for t in times]),
    ]
    return write_ulog(path, topics)


def stated(attitude: AttitudeSeries) -> list[VehicleState]:
    columns = (attitude.t_s, attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    return [
        VehicleState(t_ns=round(t * 1e9), source="frames.csv", roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
        for t, roll, pitch, yaw in zip(*(column.tolist() for column in columns), strict=True)
    ]


@pytest.mark.parametrize("write", [ardupilot, px4])
def test_an_own_log_gives_attitude_height_inertial_readings_and_gimbal(write, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    log = OwnLog(write(tmp_path / "telemetry.log"), zero_s=float(LOG.t_s[0]))
    attitudes = [state for state in log.states if state.yaw_rad is not None]
    assert [round(state.t_ns * 1e-9, 3) for state in attitudes[:3]] == [0.0, 0.04, 0.08]
    assert attitudes[100].roll_rad == pytest.approx(float(LOG.roll_rad[100]), abs=1e-5)
    assert math.remainder(attitudes[100].yaw_rad - float(LOG.yaw_rad[100]), math.tau) == pytest.approx(0.0, abs=1e-5)  # type: ignore[operator]
    heights = {round(state.t_ns * 1e-9, 2): state.agl_m for state in log.states if state.agl_m is not None}
    assert heights[10.0] - heights[8.0] == pytest.approx(4.0, abs=1e-3)
    assert attitudes[50].armed is not True and attitudes[-1].armed is True
    samples = [sample for imu in log.imu for sample in imu.samples]
    assert samples[10][1:] == pytest.approx((*FORCE, *TURN), abs=1e-6) and len(samples) == len(LOG.t_s)
    held = log.gimbal[5]
    assert (held.t_ns, held.from_north, held.device) == (200_000_000, False, 1)
    np.testing.assert_allclose(rot_from_quat(held.q), np.array(QuaternionBase(np.radians(HELD_DEG)).dcm), atol=1e-5)


def test_the_log_is_aligned_by_the_attitude_that_the_frames_have(tmp_path: Path) -> None:
    received, true_s = telemetry(LOG, 3, jitter_s=0.001)
    log = OwnLog(ardupilot(tmp_path / "telemetry.bin"), states=stated(received))
    first = next(state for state in log.states if state.yaw_rad is not None)
    assert float(true_s(np.array([first.t_ns * 1e-9]))[0]) == pytest.approx(float(LOG.t_s[0]), abs=0.01)
    assert abs(first.t_ns * 1e-9 - float(LOG.t_s[0])) > 0.9 * OFFSET_S
    assert "by the attitude of frames.csv" in log.zero


def test_a_log_of_another_flight_is_refused(tmp_path: Path) -> None:
    received, _ = telemetry(flight(8, duration_s=40.0), 3)
    with pytest.raises(SourceError, match=r"another flight.*log_zero_s"):
        OwnLog(ardupilot(tmp_path / "telemetry.bin"), states=stated(received))


def test_a_flight_folder_reads_the_log_beside_it(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "flight")
    ardupilot(folder / "telemetry.bin")
    source = FlightFolder(folder)
    shots = list(source.shots())
    assert len([1 for shot in shots for _ in shot.others]) == len([1 for t in LOG.t_s - LOG.t_s[0] if t <= 2.0 + 1e-9])
    assert any(state.roll_rad is not None for shot in shots for state in shot.states) and shots[1].imu
    facts = [fact.text for fact in facts_of(source)]
    assert any("telemetry.bin: the autopilot's clock; zero is its first attitude" in text for text in facts)
    assert any("attitudes of a gimbal from telemetry.bin" in text for text in facts)
    (folder / "telemetry.tlog").write_bytes(b"x")
    with pytest.raises(SourceError, match="keep one log"):
        FlightFolder(folder)


def test_a_table_beside_the_frames_states_telemetry_at_its_own_times(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "flight")
    (folder / "telemetry.csv").write_text("t_s,roll_deg,pitch_deg\n0.1,5,1\n0.2,6,1\n")
    states = [state for shot in FlightFolder(folder).shots() for state in shot.states if state.roll_rad is not None]
    assert [(state.t_ns, round(math.degrees(state.roll_rad or 0.0))) for state in states] == [
        (10**8, 5),
        (2 * 10**8, 6),
    ]


def test_a_log_without_attitude_and_a_file_that_is_no_log_are_refused(tmp_path: Path) -> None:
    write_dataflash(tmp_path / "a.bin", [("POS", {"TimeUS": 1, "RelHomeAlt": 3.0})])
    (tmp_path / "b.bin").write_bytes(b"no log at all")
    with pytest.raises(SourceError, match="holds no attitude"):
        OwnLog(tmp_path / "a.bin")
    with pytest.raises(SourceError, match="no log of an autopilot"):
        OwnLog(tmp_path / "b.bin")
