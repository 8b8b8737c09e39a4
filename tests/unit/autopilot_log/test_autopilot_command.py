"""`terrafix log autopilot` and `terrafix log info LOG`: what they say of a record and the log of the same flight."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from autopilot_logs import (
    OFFSET_S,
    PLACE,
    Row,
    attitude_rows,
    flight,
    sent_at,
    telemetry,
    write_dataflash,
    write_flight_record,
)
from flight_records import live_messages, write_record
from terrafix.core.errors import EvaluationError, SourceError
from terrafix_tools.cli import app
from terrafix_tools.installation import install_command

FLOWN = flight(seed=1)  # 20 to 140 s of the log
RECORD_S = np.arange(18.0, 136.0, 0.2)  # times of the record at which a position was sent
SWITCH_S = 80.0  # of the log: from GPS 1 to GPS 2, and to lane 1
USING_GPS, ABSOLUTE = 1 << 13, 1 << 4
NORTH_M = 4.0  # our position less that of the EKF


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["log", *(str(argument) for argument in arguments)])


def log_rows() -> list[Row]:
    """GPS 1 is a receiver at PLACE; GPS 2 has the positions that Terrafix sent."""
    rows: list[Row] = [
        ("MSG", {"TimeUS": 19_000_000, "Message": "ArduPlane V4.6.3 (3fc7011a)"}),
        *attitude_rows(FLOWN),
        ("MODE", {"TimeUS": 30_000_000, "Mode": 10, "ModeNum": 10}),
        ("MODE", {"TimeUS": 100_000_000, "Mode": 11, "ModeNum": 11}),
        ("MSG", {"TimeUS": 60_000_000, "Message": "EKF3 lane switch 1 <&>"}),
    ]
    for i, message in enumerate(sent_at(RECORD_S, NORTH_M)):
        time_us = round((RECORD_S[i] + OFFSET_S) * 1e6)
        later = time_us >= SWITCH_S * 1e6
        at: dict[str, float | str] = {"TimeUS": time_us}
        rows.append(("GPS", at | {"I": 0, "Status": 3, "Lat": PLACE[0], "Lng": PLACE[1], "U": int(not later)}))
        ours = {"Lat": message.lat_deg, "Lng": message.lon_deg, "U": int(later)}
        rows.append(("GPS", at | {"I": 1, "Status": 3} | ours))
        rows.append(("POS", at | {"Lat": PLACE[0], "Lng": PLACE[1], "Alt": 602.0}))
        status = ABSOLUTE | USING_GPS
        rows.append(("XKF4", at | {"C": 0, "SP": {200: 250, 300: 900}.get(i, 40), "SS": status, "PI": int(later)}))
        rows.append(("XKF4", at | {"C": 1, "SP": 10, "SS": status, "PI": int(later)}))
        rows.append(("XKF3", at | {"C": 0, "IPN": 1.5}))
        rows.append(("XKF3", at | {"C": 1, "IPN": -2.5}))
        rows.append(("XKFS", at | {"C": 0, "GI": int(later)}))
        rows.append(("XKFS", at | {"C": 1, "GI": int(later)}))
    return rows


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    write_flight_record(folder / "run" / "flight-000.mcap", telemetry(FLOWN, seed=1)[0], sent_at(RECORD_S, NORTH_M))
    return folder / "run"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataflash(tmp_path_factory.mktemp("log") / "00000017.BIN", log_rows())


@pytest.fixture(scope="module")
def found(record: Path, log: Path) -> dict[str, Any]:
    result = call("autopilot", record, log, "--json")
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.output))


def test_the_log_is_on_the_time_of_the_record(found: dict[str, Any]) -> None:
    clock = found["clock"]
    assert clock["offset_s"] == pytest.approx(OFFSET_S, abs=0.02) and clock["drift_ppm"] == pytest.approx(50, abs=40)
    assert clock["correlation"] > clock["needed_correlation"] and clock["aligned_correlation"] > 0.95
    modes = [(event["t_s"], event["text"]) for event in found["events"] if event["kind"] == "mode"]
    assert [text for _, text in modes] == ["auto", "rtl"]
    assert [t_s for t_s, _ in modes] == pytest.approx([27.0, 97.0], abs=0.03)
    assert (found["from_s"], found["to_s"]) == pytest.approx((17.0, 137.0), abs=0.2)


def test_the_receiver_with_our_positions_is_named_and_its_use_has_times(found: dict[str, Any]) -> None:
    first, second = found["gps"]
    assert (first["name"], second["name"]) == ("GPS 1", "GPS 2 (Terrafix)")
    assert [receiver["terrafix"] for receiver in found["gps"]] == [False, True]
    assert first["used"][0][1] == pytest.approx(SWITCH_S - OFFSET_S, abs=0.3)
    assert second["used"][0][0] == pytest.approx(SWITCH_S - OFFSET_S, abs=0.3)
    fused = {fusion["name"]: fusion for fusion in found["fused"]}
    assert fused["GPS 2 (Terrafix)"]["spans"][0][0] == pytest.approx(SWITCH_S - OFFSET_S, abs=0.3)
    assert fused["GPS 1"]["seconds"] == pytest.approx(SWITCH_S - OFFSET_S - 18.0, abs=0.5)


def test_test_ratios_and_innovations_are_those_of_the_primary_core(found: dict[str, Any]) -> None:
    ratio = found["test_ratios"]["position"]
    assert ratio["max"] == 2.5 and ratio["max_at_s"] == pytest.approx(RECORD_S[200], abs=0.03)
    assert ratio["above_gate_share"] == pytest.approx(1 / len(RECORD_S), rel=0.02)
    series = found["innovations"]["position_n_m"]["series"]
    assert {value for t_s, value in series if t_s < SWITCH_S - OFFSET_S - 0.3} == {1.5}
    assert {value for t_s, value in series if t_s > SWITCH_S - OFFSET_S + 0.3} == {-2.5}
    assert [span["value"] for span in found["lanes"]] == [0, 1]


def test_our_position_is_compared_with_that_of_the_ekf_at_the_same_time(found: dict[str, Any]) -> None:
    sent = found["sent_less_ekf"]
    assert sent["median_m"] == pytest.approx(NORTH_M, abs=0.1) and sent["samples"] == pytest.approx(590, abs=3)
    assert sent["north_m"][0][1] == pytest.approx(NORTH_M, abs=0.1) and sent["east_m"][0][1] == pytest.approx(0.0)
    assert sent["down_m"][0][1] == pytest.approx(2.0)  # sent at 600 m, the EKF at 602 m


def test_text_states_clocks_receivers_and_events(record: Path, log: Path) -> None:
    result = call("autopilot", record, log)
    lines = result.output.splitlines()
    assert lines[0].endswith("00000017.BIN: ArduPilot DataFlash, ArduPlane V4.6.3 (3fc7011a)")
    assert any(line.startswith("clocks: log less record 2.99") for line in lines)
    assert "GPS 2 (Terrafix): 590 samples, 3D fix 100 %, used 50 %" in lines
    assert any(line.startswith("test ratio position: at most 2.50 at 58.0") for line in lines)
    assert any(line.split()[1:] == ["s", "mode", "rtl"] for line in lines)


def test_the_page_has_every_section_and_needs_no_other_file(record: Path, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    assert call("autopilot", record, log, "--out", out).exit_code == 0
    page = out.read_text()
    for section in ("Events", "Receivers and what is fused", "Test ratios", "Innovations", "GPS_INPUT against the EKF"):
        assert f"<h2>{section}</h2>" in page
    assert "EKF3 lane switch 1 &lt;&amp;&gt;" in page and "GPS 2 (Terrafix) used" in page
    assert "http" not in page.replace("http://www.w3.org", "") and "<script" not in page


def test_the_log_of_another_flight_is_refused_with_exit_code_9(record: Path, tmp_path: Path) -> None:
    other = write_dataflash(tmp_path / "other.bin", attitude_rows(flight(seed=2)))
    with pytest.raises(EvaluationError, match="the log is of another flight than the record"):
        CliRunner().invoke(app, ["log", "autopilot", str(record), str(other)], catch_exceptions=False)
    assert EvaluationError.exit_code == 9


def test_a_record_without_telemetry_is_refused(log: Path, tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", live_messages(3))
    with pytest.raises(SourceError, match="the record has no attitude of an autopilot"):
        CliRunner().invoke(app, ["log", "autopilot", str(tmp_path), str(log)], catch_exceptions=False)


def test_info_says_what_a_log_contains(log: Path) -> None:
    lines = call("info", log).output.splitlines()
    assert lines[0].startswith(f"{log}: ArduPilot DataFlash, 0.")
    assert lines[1] == "ArduPlane V4.6.3 (3fc7011a), 120.0 s from 20.0 s of its clock"
    assert "receivers: GPS 1 590, GPS 2 590" in lines and "EKF cores: 0, 1" in lines
    assert any(line.split() == ["ATT", "3000", "25.01", "Hz"] for line in lines)
    about = json.loads(call("info", log, "--json").output)
    assert about["messages"]["XKF4"] == 1180 and about["attitude"] == 3000 and about["origin"] is None


def test_without_pyulog_one_line_states_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "a.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(60))
    code = "import sys; sys.modules['pyulog'] = None; from terrafix_tools.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "log", "info", str(tmp_path / "a.ulg")], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert done.stderr == f"terrafix: this command needs pyulog; install it: {install_command('ground')}\n"
