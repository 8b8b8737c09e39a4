"""Logs of each format, read into the common structure by value."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from autopilot_logs import (
    FORMATS,
    Row,
    Topic,
    attitude_messages,
    attitude_rows,
    attitude_topic,
    flight,
    part,
    write_dataflash,
    write_dataflash_text,
    write_tlog,
    write_ulog,
)
from terrafix.core.autopilot_log.attitude import AttitudeSeries, cleaned
from terrafix.core.autopilot_log.dataflash import read_dataflash
from terrafix.core.errors import SourceError
from terrafix_tools.autopilot_log.read import is_autopilot_log, read_autopilot_log
from terrafix_tools.autopilot_log.structure import AutopilotLog, LogEvent

S = 1_000_000
FLOWN = part(flight(seed=1), 20.0, 24.0)
USING_GPS, ABSOLUTE, DEAD_RECKONING = 1 << 13, 1 << 4, 1 << 18


def ekf_rows() -> list[Row]:
    """Two cores for 3 s at 10 Hz: at 21.5 s from lane 0 and source set 1 to lane 1 and set 2; from 22.5 s on the
    position has timed out."""
    rows: list[Row] = []
    for i in range(30):
        time_us = 20 * S + i * 100_000
        later = i >= 15
        for core in (0, 1):
            at: dict[str, float | str] = {"TimeUS": time_us, "C": core}
            rows.append(("XKF1", at | {"PN": 10.0 + core, "PE": 20.0, "PD": -30.0, "VN": 1.0, "VE": 2.0, "VD": 3.0}))
            rows.append(("XKF3", at | {"IVN": 0.5, "IPE": -1.25 - core, "IMX": 40, "IYAW": 1.5}))
            status = ABSOLUTE | (DEAD_RECKONING if later else USING_GPS)
            rows.append(("XKF4", at | {"SV": 50 + core, "SP": 120, "SS": status, "TS": int(i >= 25), "PI": int(later)}))
            rows.append(("XKFS", at | {"GI": 1, "SS": 1 if later else 0}))
        for receiver in (0, 1):
            at = {"TimeUS": time_us, "I": receiver}
            fix = {"Status": 6 if receiver == 0 else 3, "NSats": 12, "U": receiver}
            rows.append(("GPS", at | fix | {"Lat": 48.0 + 1e-7 * i, "Lng": 11.0, "Alt": 512.5}))
            rows.append(("GPA", at | {"HAcc": 0.5 + receiver}))
    return rows


def rows() -> list[Row]:
    return [
        ("MSG", {"TimeUS": 19 * S, "Message": "ArduCopter V4.6.3 (3fc7011a)"}),
        ("PARM", {"TimeUS": 19 * S, "Name": "EK3_SRC1_POSXY", "Value": 3.0}),
        ("PARM", {"TimeUS": 19 * S, "Name": "EK3_SRC2_POSXY", "Value": 6.0}),
        ("ORGN", {"TimeUS": 19 * S, "Type": 0, "Lat": 48.0, "Lng": 11.0, "Alt": 500.0}),
        ("MODE", {"TimeUS": 19 * S, "Mode": 5, "ModeNum": 5}),
        *attitude_rows(FLOWN),
        *ekf_rows(),
        ("IMU", {"TimeUS": 21 * S, "I": 0, "GyrX": 0.1, "GyrY": 0.2, "GyrZ": 0.3}),
        ("IMU", {"TimeUS": 21 * S, "I": 1, "GyrX": 9.0}),
        ("EV", {"TimeUS": 20 * S, "Id": 10}),
        ("ERR", {"TimeUS": 22 * S, "Subsys": 24, "ECode": 0}),
        ("MODE", {"TimeUS": 23 * S, "Mode": 6, "ModeNum": 6}),
    ]


@pytest.fixture(params=["binary", "text"])
def dataflash(request: pytest.FixtureRequest, tmp_path: Path) -> AutopilotLog:
    if request.param == "text":
        return read_autopilot_log(write_dataflash_text(tmp_path / "a.log", rows()))
    return read_autopilot_log(write_dataflash(tmp_path / "00000001.BIN", rows()))


def assert_flown(log: AutopilotLog, abs_s: float = 1e-6) -> None:
    assert log.attitude.t_s == pytest.approx(FLOWN.t_s, abs=abs_s)
    assert log.attitude.roll_rad == pytest.approx(FLOWN.roll_rad, abs=1e-6)
    assert log.attitude.pitch_rad == pytest.approx(FLOWN.pitch_rad, abs=1e-6)
    assert np.sin(log.attitude.yaw_rad - FLOWN.yaw_rad) == pytest.approx(0.0, abs=1e-6)


def test_dataflash_has_attitude_rates_ekf_and_receivers_in_si_units(dataflash: AutopilotLog) -> None:
    log = dataflash
    assert (log.kind, log.firmware) == ("ArduPilot DataFlash", "ArduCopter V4.6.3 (3fc7011a)")
    assert_flown(log)
    assert log.rates is not None and log.rates.rates_radps == pytest.approx(np.array([[0.1, 0.2, 0.3]]))
    assert [track.core for track in log.ekf] == [0, 1]
    assert log.ekf[1].position_ned_m[0] == pytest.approx([11.0, 20.0, -30.0])
    assert log.ekf[1].velocity_ned_mps[0] == pytest.approx([1.0, 2.0, 3.0])
    core = log.innovations[1].values
    assert core["velocity_n_mps"][0] == 0.5 and core["position_e_m"][0] == -2.25
    assert core["mag_x_gauss"][0] == pytest.approx(0.040) and core["yaw_rad"][0] == pytest.approx(math.radians(1.5))
    assert len(log.gps) == 2
    second = log.gps[1]
    assert second.lat_deg[:2] == pytest.approx([48.0, 48.0000001], abs=1e-9) and second.alt_amsl_m[0] == 512.5
    assert second.horizontal_m[1] == pytest.approx(1.5) and second.fix_type[0] == 3 and second.satellites[0] == 12
    assert [track.used is not None and bool(track.used.all()) for track in log.gps] == [False, True]


def test_test_ratios_in_hundredths_are_1_at_the_gate(tmp_path: Path) -> None:
    """The same numbers as "H" with a factor of its own and, in older logs, as "c"."""
    new = read_autopilot_log(write_dataflash(tmp_path / "new.bin", rows()))
    characters = FORMATS["XKF4"][0].replace("QBHHHHH", "QBccccc")
    older = {**FORMATS, "XKF4": (characters, FORMATS["XKF4"][1])}
    scaled = [(n, {k: v / 100 if k in ("SV", "SP") else v for k, v in f.items()}) for n, f in rows()]  # type: ignore[operator]
    old = read_autopilot_log(write_dataflash(tmp_path / "old.bin", scaled, older))
    for log in (new, old):
        assert log.ratios[1].values["velocity"][0] == pytest.approx(0.51)
        assert log.ratios[0].values["position"][0] == pytest.approx(1.20)


def test_lanes_source_sets_and_what_was_fused_change_when_the_log_says_so(dataflash: AutopilotLog) -> None:
    log = dataflash
    assert log.primary is not None and log.source_set is not None
    assert (log.primary.t_s.tolist(), log.primary.value.tolist()) == ([20.0, 21.5], [0, 1])
    assert log.source_set.value.tolist() == [1, 2]
    fused = {
        fusion.name: (fusion.t_s[fusion.fused].min(), fusion.t_s[fusion.fused].max())
        for fusion in log.fusion
        if fusion.fused.any()
    }
    assert fused["GPS 2"] == pytest.approx((20.0, 21.4))
    assert fused["external navigation"] == pytest.approx((21.5, 22.4))
    assert fused["dead reckoning"] == pytest.approx((21.5, 22.9))
    assert "GPS 1" not in fused and "constant position" not in fused


def test_events_of_dataflash_have_names_and_times(dataflash: AutopilotLog) -> None:
    events = [(event.t_s, event.kind, event.text) for event in dataflash.events]
    for expected in (
        (19.0, "mode", "loiter"),
        (20.0, "arming", "armed"),
        (21.5, "lane", "lane 0 -> 1"),
        (21.5, "source set", "source set 1 -> 2"),
        (22.0, "error", "EKF primary: resolved"),
        (23.0, "mode", "rtl"),
    ):
        assert expected in events
    assert [t for t, _, _ in events] == sorted(t for t, _, _ in events)


def test_without_pos_the_position_is_that_of_the_primary_core_about_the_origin(dataflash: AutopilotLog) -> None:
    position = dataflash.position
    assert position is not None
    north_m = (position.lat_deg - 48.0) * 111_318.845
    assert north_m[[0, -1]] == pytest.approx([10.0, 11.0], abs=1e-3)  # core 0, then core 1
    assert position.alt_amsl_m[0] == 530.0
    assert (position.lon_deg[0] - 11.0) * 111_318.845 * math.cos(math.radians(48.0)) == pytest.approx(20.0, abs=1e-3)


def test_damaged_bytes_in_a_binary_log_are_skipped_and_counted(tmp_path: Path) -> None:
    path = write_dataflash(tmp_path / "a.bin", rows())
    data = path.read_bytes()
    whole = read_dataflash(path, ["ATT"])
    first = data.index(b"\xa3\x95" + bytes([128 + list(FORMATS).index("ATT")]))
    path.write_bytes(data[:first] + b"\xa3\xa3noise" + data[first:-5])
    damaged = read_dataflash(path, ["ATT"])
    assert len(damaged.tables["ATT"]) == len(whole.tables["ATT"]) == len(FLOWN.t_s)
    assert whole.skipped_bytes == 0 and damaged.skipped_bytes == 7 + 14 - 5  # the last message, MODE, is cut off


def test_damaged_times_and_angles_are_left_out_of_the_attitude() -> None:
    t_s = np.array([1.0, 2.0, 9e9, 3.0, 3.0, 2.5, 4.0, np.nan, 5.0, 6.0])
    roll_rad = np.arange(10.0)
    roll_rad[8] = np.nan
    kept = cleaned(AttitudeSeries(t_s, roll_rad, np.zeros(10), np.zeros(10)))
    assert (kept.t_s.tolist(), kept.roll_rad.tolist()) == ([1.0, 2.0, 3.0, 4.0, 6.0], [0.0, 1.0, 3.0, 6.0, 9.0])


def test_damaged_numbers_of_a_text_log_are_missing_and_the_rest_is_read(tmp_path: Path) -> None:
    path = write_dataflash_text(tmp_path / "a.log", rows())
    text = path.read_text()
    assert "GPS, 20000000, 1, 3, " in text and "MODE, 23000000, 6, 6" in text
    path.write_text(
        text.replace("GPS, 20000000, 1, 3, ", "GPS, 20000000, 1, x, ").replace("23000000, 6, 6", "23000000, 6, ?")
    )
    log = read_autopilot_log(path)
    assert log.gps[1].fix_type[:2].tolist() == [0, 3]
    assert (23.0, "mode", "stabilize") in [(event.t_s, event.kind, event.text) for event in log.events]


def test_the_reader_of_dataflash_agrees_with_pymavlink(tmp_path: Path) -> None:
    from pymavlink.DFReader import DFReader_binary

    path = write_dataflash(tmp_path / "a.bin", rows())
    ours = read_dataflash(path, FORMATS)
    theirs = DFReader_binary(str(path))
    seen = dict.fromkeys(FORMATS, 0)
    while (message := theirs.recv_msg()) is not None:
        kind = message.get_type()
        for column, value in message.to_dict().items():
            if column != "mavpackettype":
                assert ours.tables[kind].columns[column][seen[kind]] == value
        seen[kind] += 1
    theirs.close()
    assert seen == {name: ours.counts[name] for name in FORMATS}


def test_the_real_log_of_2015_is_read(data_set: Callable[[str], Path]) -> None:
    log = read_autopilot_log(data_set("logs/log171.bin"))
    assert log.firmware == "APM:Copter V3.3-dev (ae3192b8)" and log.skipped_bytes == 0
    assert log.span_s == pytest.approx((11.478, 253.981))
    assert (len(log.attitude.t_s), log.counts["IMU"], len(log.gps[0].t_s)) == (2383, 11916, 1199)
    assert log.gps[0].lat_deg[-1] == pytest.approx(-35.36, abs=0.01) and set(log.gps[0].fix_type) == {1.0, 3.0}
    assert LogEvent(217.209, "mode", "acro") in log.events
    assert log.ratios[0].values["velocity"].max() == pytest.approx(3.09)


def test_telemetry_has_the_autopilots_time_over_a_restart(tmp_path: Path) -> None:
    """The arrival of packets jitters by 50 ms; times of the attitude do not."""
    first, second = part(FLOWN, 20.0, 22.0), part(FLOWN, 22.0, 24.0)
    rng = np.random.default_rng(0)
    timed = [*attitude_messages(first, boot_s=5.0), *attitude_messages(second, boot_s=21.9)]
    late = [(t_s + (rng.uniform(0.0, 0.05) if i % 10 else 0.0), message) for i, (t_s, message) in enumerate(timed)]
    log = read_autopilot_log(write_tlog(tmp_path / "a.tlog", late))
    assert log.kind == "MAVLink telemetry"
    assert_flown(AutopilotLog(log.path, "", _shifted(log, 20.0)), abs_s=2e-3)
    assert log.rates is not None and log.rates.rates_radps[0] == pytest.approx([0.1, 0.2, 0.3])


def _shifted(log: AutopilotLog, by_s: float) -> AttitudeSeries:
    found = log.attitude
    return AttitudeSeries(found.t_s + by_s, found.roll_rad, found.pitch_rad, found.yaw_rad)


def test_telemetry_has_modes_texts_receivers_and_status_of_the_ekf(tmp_path: Path) -> None:
    def heartbeat(mode: int, armed: bool) -> mavlink.MAVLink_message:
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 128 if armed else 0, mode, 4, 3
        )

    flags = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_ATTITUDE
    timed = [
        *attitude_messages(FLOWN, boot_s=0.0),
        (21.0, heartbeat(10, False)),
        (21.2, heartbeat(10, True)),
        (21.4, heartbeat(11, True)),
        (21.5, mavlink.MAVLink_statustext_message(4, b"EKF3 lane switch 1 and a text that is too long for", 7, 0)),
        (21.5, mavlink.MAVLink_statustext_message(4, b" one packet", 7, 1)),
        (21.6, mavlink.MAVLink_ekf_status_report_message(flags, 0.25, 0.5, 0.75, 1.5, 0.0)),
        (21.7, mavlink.MAVLink_gps_raw_int_message(0, 3, 480000001, 110000000, 512500, 0, 0, 0, 0, 9, 0, 1500)),
        (21.8, mavlink.MAVLink_gps_global_origin_message(480000000, 110000000, 500000)),
        (21.9, mavlink.MAVLink_local_position_ned_message(21900, 1.0, 2.0, -3.0, 4.0, 5.0, 6.0)),
        (22.0, mavlink.MAVLink_global_position_int_message(22000, 480000000, 110000000, 503000, 3000, 0, 0, 0, 0)),
    ]
    log = read_autopilot_log(write_tlog(tmp_path / "a.tlog", sorted(timed, key=lambda one: one[0])))
    events = [(round(event.t_s + 20.0, 3), event.kind, event.text) for event in log.events]
    assert events == [
        (21.0, "mode", "auto"),
        (21.2, "arming", "armed"),
        (21.4, "mode", "rtl"),
        (21.5, "message", "EKF3 lane switch 1 and a text that is too long for one packet"),
    ]
    ratios = {name: values[0] for name, values in log.ratios[0].values.items()}
    assert ratios == {"velocity": 0.25, "position": 0.5, "height": 0.75, "mag": 1.5, "airspeed": 0.0}
    assert {fusion.name: bool(fusion.fused[0]) for fusion in log.fusion} == {
        "absolute position": True,
        "constant position": False,
        "GPS glitch": False,
    }
    assert log.gps[0].lat_deg[0] == pytest.approx(48.0000001, abs=1e-9) and log.gps[0].horizontal_m[0] == 1.5
    assert log.origin is not None and log.origin.alt_amsl_m == 500.0
    assert log.ekf[0].position_ned_m[0].tolist() == [1.0, 2.0, -3.0]
    assert log.position is not None and log.position.alt_amsl_m[0] == 503.0


LOCAL = "float x;float y;float z;float vx;float vy;float vz;bool xy_global;double ref_lat;double ref_lon;float ref_alt;"
RECEIVER = (
    "uint32_t device_id;double latitude_deg;double longitude_deg;double altitude_msl_m;float eph;uint8_t fix_type;"
    "uint8_t satellites_used;"
)
INNOVATIONS = "float[2] gps_hpos;float[2] ev_hpos;float heading;"
AID = "uint8_t estimator_instance;bool fused;"


def px4_topics() -> list[Topic]:
    """Two cores and two receivers for 4 s; at 22 s from the first of each to the second."""

    def topic(name: str, instance: int, fields: str, *values: float) -> Topic:
        return (name, instance, fields, [(20.0 + 0.5 * i, *values) for i in range(8)])

    def switched(name: str, fields: str, first: tuple[float, ...], second: tuple[float, ...]) -> Topic:
        return (name, 0, fields, [(20.0 + 0.5 * i, *(first if i < 4 else second)) for i in range(8)])

    return [
        attitude_topic(FLOWN),
        topic("vehicle_angular_velocity", 0, "float[3] xyz;", 0.1, 0.2, 0.3),
        topic("vehicle_local_position", 0, LOCAL, 1.0, 2.0, -3.0, 4.0, 5.0, 6.0, True, 48.0, 11.0, 500.0),
        topic("vehicle_global_position", 0, "double lat;double lon;float alt;", 48.5, 11.5, 503.0),
        topic("estimator_innovations", 0, INNOVATIONS, 0.5, -0.25, 0.0, 0.0, 0.1),
        topic("estimator_innovations", 1, INNOVATIONS, 0.0, 0.0, 2.0, 3.0, 0.2),
        topic("estimator_innovation_test_ratios", 0, "float[2] gps_hpos;float heading;", 0.25, 0.0, 1.44),
        switched("estimator_selector_status", "uint8_t primary_instance;", (0,), (1,)),
        topic("estimator_aid_src_aux_global_position", 0, AID, 0, True),
        topic("estimator_aid_src_aux_global_position", 1, AID, 1, False),
        topic("sensor_gps", 0, RECEIVER, 7, 48.0, 11.0, 512.5, 1.5, 3, 12),
        topic("sensor_gps", 1, RECEIVER, 8, 48.1, 11.0, 512.5, 1.5, 3, 12),
        switched("vehicle_gps_position", "uint32_t device_id;uint8_t fix_type;", (7, 3), (8, 3)),
        switched("vehicle_status", "uint8_t nav_state;uint8_t arming_state;", (4, 1), (14, 2)),
    ]


def test_ulog_has_the_same_structure(tmp_path: Path) -> None:
    log = read_autopilot_log(write_ulog(tmp_path / "a.ulg", px4_topics(), [(21.0, "Takeoff detected")]))
    assert log.kind == "PX4 ULog"
    assert_flown(log)
    assert log.rates is not None and log.rates.rates_radps[0] == pytest.approx([0.1, 0.2, 0.3])
    assert log.ekf[0].position_ned_m[0].tolist() == [1.0, 2.0, -3.0]
    assert log.origin is not None and (log.origin.lat_deg, log.origin.alt_amsl_m) == (48.0, 500.0)
    assert log.position is not None and log.position.lat_deg[0] == 48.5
    assert log.innovations[0].values["position_e_m"][0] == -0.25
    assert log.innovations[1].values["position_e_m"][0] == 3.0  # of external vision: there is none of GPS
    assert log.ratios[0].values["position"][0] == 0.5  # the root of 0.25
    assert log.ratios[0].values["yaw"][0] == pytest.approx(1.2)
    assert log.primary is not None and log.primary.t_s.tolist() == [20.0, 22.0]
    assert [track.used is not None and track.used.tolist() for track in log.gps] == [
        [True] * 4 + [False] * 4,
        [False] * 4 + [True] * 4,
    ]
    fused = {fusion.name: fusion.t_s[fusion.fused].tolist() for fusion in log.fusion}
    assert fused == {"auxiliary position": [20.0, 20.5, 21.0, 21.5]}  # of the core that is primary
    events = [(event.t_s, event.kind, event.text) for event in log.events]
    assert (22.0, "arming", "armed") in events and (22.0, "mode", "offboard") in events
    assert (22.0, "lane", "lane 0 -> 1") in events and (21.0, "message", "Takeoff detected") in events


@pytest.mark.parametrize("name", ["a.bin", "a.txt", "a.tlog"])
def test_the_format_is_recognised_by_content(name: str, tmp_path: Path) -> None:
    assert read_autopilot_log(write_ulog(tmp_path / name, [attitude_topic(FLOWN)])).kind == "PX4 ULog"
    assert read_autopilot_log(write_dataflash(tmp_path / name, attitude_rows(FLOWN))).kind == "ArduPilot DataFlash"
    assert read_autopilot_log(write_tlog(tmp_path / name, attitude_messages(FLOWN))).kind == "MAVLink telemetry"
    assert is_autopilot_log(tmp_path / name)


def test_each_bad_file_has_one_line(tmp_path: Path) -> None:
    for name, content, text in (
        ("empty.bin", b"", "is empty"),
        ("photo.jpg", b"\xff\xd8\xff" + bytes(100), "is no log of an autopilot; give ArduPilot's .bin or .log"),
        ("text.tlog", b"no telemetry " * 20, "holds no MAVLink record"),
        ("cut.ulg", b"ULog\x01\x12", "is no readable ULog"),
        # pyulog alone searches without end for a message after one that states to be longer than the rest
        ("endless.ulg", b"ULog\x01\x12\x35\x01" + bytes(8) + b"\x60\xea\xffabc", "no end of the damaged part"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SourceError, match=text) as error:
            read_autopilot_log(tmp_path / name)
        assert "\n" not in str(error.value) and str(error.value).startswith(str(tmp_path / name))
    with pytest.raises(SourceError, match="No such file"):
        read_autopilot_log(tmp_path / "nowhere.bin")


@pytest.mark.parametrize("suffix", [".bin", ".log", ".tlog", ".ulg"])
def test_a_log_without_attitude_says_which_message_is_missing(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    mode: list[Row] = [("MODE", {"TimeUS": S, "ModeNum": 5})]
    if suffix == ".ulg":
        write_ulog(path, px4_topics()[1:])
    elif suffix == ".tlog":
        write_tlog(path, [(1.0, mavlink.MAVLink_system_time_message(0, 0))])
    else:
        (write_dataflash if suffix == ".bin" else write_dataflash_text)(path, mode)
    with pytest.raises(SourceError, match=r"holds no attitude.*\((ATT|ATTITUDE|vehicle_attitude)\)"):
        read_autopilot_log(path)
