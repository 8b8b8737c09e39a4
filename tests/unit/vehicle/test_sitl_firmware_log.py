"""Figures that are read from the firmware's own log of a SITL flight."""

from pathlib import Path

import pytest

from autopilot_logs import FORMATS, Row, write_dataflash
from terrafix_lab.sim.sitl.firmware_log import firmware_figures, text_lines

SIM = {"SIM": ("QffffLLfffff", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng,Q1,Q2,Q3,Q4,X")}


def armed_flight() -> list[Row]:
    """Boot at 0, armed at 20 s, disarmed at 120 s, log until 130 s; POS 10 m north of SIM from 115 s on; GPS 2 without
    a fix from 50 to 60 s and in use from then on.
    """
    rows: list[Row] = [("PARM", {"Name": name, "Value": v}) for name, v in (("GPS_PRIMARY", 1), ("GPS_AUTO_SWITCH", 4))]
    for second in range(131):
        at = {"TimeUS": second * 1_000_000}
        lat_deg = 48.0 + 1e-4 * second
        rows.append(("SIM", at | {"Lat": lat_deg, "Lng": 11.0}))
        rows.append(("POS", at | {"Lat": lat_deg + (10.0 / 111_194.9 if second >= 115 else 0.0), "Lng": 11.0}))
        rows.append(("GPS", at | {"I": 0, "Status": 1, "U": int(second < 60)}))
        rows.append(("GPS", at | {"I": 1, "Status": 1 if 50 <= second < 60 else 3, "U": int(second >= 60)}))
        if second in (20, 120):
            rows.append(("EV", at | {"Id": 10 if second == 20 else 11}))
        if second in (5, 52):
            rows.append(("ERR", at | {"Subsys": 17, "ECode": 1}))
        if second == 70:
            rows.append(("PARM", at | {"Name": "GPS_PRIMARY", "Value": 0}))
    return rows


def written(folder: Path, rows: list[Row]) -> Path:
    (folder / "logs").mkdir()
    write_dataflash(folder / "logs" / "00000001.BIN", rows, FORMATS | SIM)
    return folder


def test_the_time_from_arming_to_disarming_is_evaluated(tmp_path: Path) -> None:
    found = firmware_figures(written(tmp_path, armed_flight()))
    assert found is not None and found.duration_s == pytest.approx(100.0)
    errors_m = (found.position_median_m, found.position_p95_m, found.position_max_m)
    assert errors_m == pytest.approx((0.0, 10.0, 10.0), abs=0.02)
    second = found.receivers["2"]
    assert second.fix_share == pytest.approx(91 / 101)
    assert second.longest_gap_s == pytest.approx(11.0)
    assert second.used_share == pytest.approx(61 / 101)
    first = found.receivers["1"]
    assert first.fix_share == 0.0 and first.longest_gap_s == pytest.approx(100.0)
    assert first.used_share == pytest.approx(40 / 101)
    assert found.errors == ["32 s 17:1"], "before arming is not counted"
    assert found.parameters == {"GPS_AUTO_SWITCH": 4.0, "GPS_PRIMARY": 0.0}, "the last value"
    assert "GPS 2: 3D fix 90.1%, longest gap 11.0 s, in use 60.4%" in "\n".join(text_lines(found))


def test_no_log_has_no_figures_and_one_without_the_event_of_arming_counts_from_its_start(tmp_path: Path) -> None:
    assert firmware_figures(tmp_path) is None
    rows = [row for row in armed_flight() if row[1].get("Id") != 10]
    found = firmware_figures(written(tmp_path, rows))
    assert found is not None and found.duration_s == pytest.approx(120.0)


def test_a_log_that_ends_in_the_air_is_evaluated_to_its_end(tmp_path: Path) -> None:
    found = firmware_figures(written(tmp_path, [row for row in armed_flight() if row[1].get("Id") != 11]))
    assert found is not None and found.duration_s == pytest.approx(110.0)
