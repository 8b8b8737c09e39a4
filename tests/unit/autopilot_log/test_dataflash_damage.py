"""DataFlash logs whose first bytes are lost, zero or foreign, and logs of 2013."""

import math
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from terrafix.core.errors import SourceError
from terrafix_tools.autopilot_log.read import is_autopilot_log, read_autopilot_log


def fmt(number: int, length: int, name: str, characters: str, columns: str) -> bytes:
    texts = (name.encode(), characters.encode(), columns.encode())
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, *texts)


FORMATS = (
    fmt(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    + fmt(11, 3 + 8 + 64, "MSG", "QZ", "TimeUS,Message")
    + fmt(10, 3 + 8 + 12, "ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw")
)
MSG = b"\xa3\x95\x0b" + struct.pack("<Q64s", 1_000_000, b"ArduCopter V4.7.0 (abc)")
ATTITUDES = [
    b"\xa3\x95\x0a" + struct.pack("<Qfff", 1_000_000 + 100_000 * k, 5 * math.sin(k / 5), 3.0, 90 + k / 10)
    for k in range(100)
]
GOOD = FORMATS + MSG + b"".join(ATTITUDES)


@pytest.mark.parametrize(
    ("data", "skipped", "attitudes"),
    [
        (GOOD, 0, 100),
        (GOOD[1:], 88, 100),
        (GOOD[40:], 49, 100),
        (GOOD[89:], 0, 100),
        (GOOD[100:], 78, 100),  # MSG is not known any more, ATT is: its format comes after
        (bytes(512) + GOOD, 512, 100),
        (bytes(300_000) + GOOD, 300_000, 100),
        (b"\xff" * 77 + GOOD, 77, 100),
        (b"\xa3\x95\x80" + GOOD, 3, 100),
        (MSG + GOOD, 75, 100),
        (FORMATS + MSG + b"".join(ATTITUDES[:50]) + bytes(64) + b"".join(ATTITUDES[50:]), 64, 100),
        (FORMATS + MSG + b"".join(ATTITUDES)[:-9], 14, 99),
    ],
    ids=["whole", "a byte", "40 bytes", "a message", "two messages", "zeros", "many zeros", "erased", "head twice",
         "before its format", "a hole", "cut off"],
)  # fmt: skip
def test_lost_zero_and_foreign_bytes_are_skipped_and_counted(
    data: bytes, skipped: int, attitudes: int, tmp_path: Path
) -> None:
    path = tmp_path / "00000012.BIN"
    path.write_bytes(data)
    assert is_autopilot_log(path)
    log = read_autopilot_log(path)
    assert (len(log.attitude.t_s), log.kind) == (attitudes, "ArduPilot DataFlash")
    if data == GOOD[100:]:  # the message MSG itself has no format
        assert log.skipped_bytes == skipped + len(MSG) and log.firmware == ""
    else:
        assert log.skipped_bytes == skipped and log.firmware.startswith("ArduCopter V4.7.0")


def test_a_text_log_whose_first_line_is_torn_is_read(tmp_path: Path) -> None:
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 10, 23, ATT, Qfff, TimeUS,Roll,Pitch,Yaw",
    ]
    lines += [f"ATT, {1_000_000 + 100_000 * k}, {0.1 * k:.2f}, 0.00, 90.00" for k in range(20)]
    path = tmp_path / "flight.log"
    path.write_text("\r\n".join(lines)[14:] + "\r\n")
    assert len(read_autopilot_log(path).attitude.t_s) == 20


@pytest.mark.parametrize("data", [bytes(4096), b"\xa3\x95\x80" * 100, b"FMT, nothing\nFMT, 1\n", b"\xff" * 1000])
def test_what_has_no_whole_format_is_no_log(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(data)
    with pytest.raises(SourceError, match="is no log of an autopilot"):
        read_autopilot_log(tmp_path / "a.bin")


def test_a_text_log_of_2013_has_its_times_from_the_gps_and_names_of_modes(tmp_path: Path) -> None:
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 1, 19, ATT, ccccCCC, RollIn,Roll,PitchIn,Pitch,YawIn,Yaw,NavYaw",
        "FMT, 3, 6, MODE, Mh, Mode,ThrCrs",
        "FMT, 5, 38, GPS, BIBcLLeeEe, Status,Time,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs",
        "MODE, ALT_HOLD, 400",
    ]
    for k in range(20):
        lines += [f"ATT, 0.00, {k}.00, 0.00, 3.00, 0, 90.00, 0"] * 2
        lines.append(f"GPS, 3, {300_000_000 + 200 * k}, 10, 1.50, 48.1445900, 14.3558480, 30.00, 370.00, 1.00, 90.00")
    (tmp_path / "a.log").write_text("\r\n".join(lines))
    log = read_autopilot_log(tmp_path / "a.log")
    assert len(log.attitude.t_s) >= 38 and log.span_s[1] - log.span_s[0] == pytest.approx(3.8, abs=0.3)
    assert [event.text for event in log.events if event.kind == "mode"] == ["alt hold"]


@pytest.mark.parametrize(
    ("name", "skipped", "attitudes"),
    [("good.bin", 0, 100), ("first_bytes_lost.bin", 49, 100), ("msg_before_fmt.bin", 75, 100), ("copter31.log", 0, 50)],
)
def test_dataflash_logs_of_the_field_are_read(
    name: str, skipped: int, attitudes: int, data_set: Callable[[str], Path]
) -> None:
    log = read_autopilot_log(data_set("field") / "dataflash" / name)
    assert (len(log.attitude.t_s), log.skipped_bytes) == (attitudes, skipped)
