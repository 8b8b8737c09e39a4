"""What a record says of its flight: identity, columns of the two tables."""

import shutil
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fleet_records import Invented, write_records
from flight_records import PERIOD_NS, live_messages, write_record
from terrafix import messages as m
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.estimates import Row
from terrafix_tools.fleet.build import build
from terrafix_tools.fleet.examine import Examiner
from terrafix_tools.fleet.find import find_records, open_place
from terrafix_tools.fleet.flight import _map, distance_m, flight_rows, longest_without_fix_s, season
from terrafix_tools.fleet.query import query
from terrafix_tools.log.edit import cut, recover
from terrafix_tools.report.data import FlightView

NOON_NS = 1_783_080_000_000_000_000  # 2026-07-03 12:00:00 UTC
FRAMES = 20


def tables_of(messages: list[m.Message], folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    folder.mkdir(exist_ok=True)
    write_record(folder / "flight-000.mcap", messages)
    return flight_rows(folder, folder)


def ids(folder: Path) -> list[str]:
    """Flights of all records below a folder, in the order of their paths."""
    examiner = Examiner(open_place(str(folder)))
    found = [examiner.render(record) for record in find_records(open_place(str(folder)))[0]]
    assert not [examined.error for examined in found if examined.error]
    return [tables.flight for examined in found for tables in examined.flights]


def rewritten(path: Path, flight: Invented, first: int, last: int) -> None:
    """Writes a segment: the origin, and the messages ``first`` to ``last`` after it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = FlightWriter(path, flight.header)
    origin, *messages = flight.messages()
    for message, received_ns in (origin, *messages[first:last]):
        writer.write(message, received_ns)
    writer.close()


def test_the_row_of_a_flight_has_the_numbers_of_its_record(tmp_path: Path) -> None:
    """20 frames at 2 Hz to the east at 10 m/s, the first without position, every fifth match refused."""
    clock = m.WallClock(t_ns=2 * PERIOD_NS, unix_ns=NOON_NS + 2 * PERIOD_NS, source="autopilot")
    fault = m.CalibrationFault(t_ns=3 * PERIOD_NS, quantity="heading", factor=9.0, detail="", active=True)
    link = m.LinkStatus(t_ns=0, connected=True, autopilot="px4", sysid=7, sent=0, received=0, bad=0, time_offset_ms=0.0)
    flight, _ = tables_of([*live_messages(FRAMES), clock, fault, link], tmp_path / "run")
    expected = {
        "start_utc": datetime(2026, 7, 3, 12, 0, 0, tzinfo=UTC),
        "season": "summer",
        "duration_s": 9.9,
        "live": False,
        "vehicle": "px4 7",
        "frames": 20,
        "localised": 19,
        "fixes": 16,
        "refusals": 4,
        "refused": [("ambiguous", 4)],
        "availability": 0.95,
        "trusted": 0.0,  # a heading fault holds from the beginning
        "sigma_median_m": pytest.approx(4.0),
        "sigma_max_m": pytest.approx(4.0),
        "agl_median_m": 100.0,
        "longest_without_fix_s": 1.0,
        "faults": ["heading"],
        "dropped": 3,
        "truncated": False,
        "damaged": 0,
        "camera": "64 x 48, f 60 px",
        "start_lat_deg": 48.0,
    }
    assert {name: flight[name] for name in expected} == expected
    assert flight["distance_m"] == pytest.approx(90.0, abs=5.1)


def test_a_row_of_the_frames_has_position_claim_and_reason(tmp_path: Path) -> None:
    clock = m.WallClock(t_ns=0, unix_ns=NOON_NS, source="autopilot")
    _, frames = tables_of([*live_messages(FRAMES), clock], tmp_path / "run")
    assert [frame["verdict"] for frame in frames[:6]] == ["refused", *["accepted"] * 4, "refused"]
    refused = frames[5]
    assert (refused["frame"], refused["reason"], refused["source"]) == (5, "ambiguous", "visual_propagated")
    assert (refused["t_s"], refused["agl_m"], refused["anchor_age_ms"]) == (2.5, 100.0, 500)
    assert refused["sigma_m"] == pytest.approx(4.0) and refused["lat_deg"] == pytest.approx(48.0, abs=1e-4)
    assert refused["time_utc"] == NOON_NS / 1e6 + 2500
    assert frames[0]["lat_deg"] is None and frames[1]["reason"] is None
    assert all(frame["latency_ms"] is None for frame in frames), "this record has no times of reception"


def test_a_live_record_has_latencies_and_a_replay_has_the_map(tmp_path: Path) -> None:
    write_records(tmp_path, 5, frames=4)
    live = tmp_path / "vehicle-0" / "run-0000"
    flight, frames = flight_rows(live, live)
    assert flight["live"] and all(60.0 <= frame["latency_ms"] < 200.0 for frame in frames[1:])
    assert (flight["map"], flight["map_checksum"], flight["map_date"]) == ("valley-2025", None, None)
    assert (flight["camera"], flight["version"], flight["git"]) == ("wide", "1.0.0", "v1.0.0")
    replayed = tmp_path / "vehicle-0" / "run-0004"
    flight, _ = flight_rows(replayed, replayed)
    assert (flight["live"], flight["start_utc"], flight["season"]) == (False, None, None)
    assert (flight["map"], flight["map_checksum"]) == ("coast-2024", "sum of coast-2024")
    assert flight["map_date"] == date(2024, 7, 1)


def test_a_live_record_has_the_map_that_its_head_states(tmp_path: Path) -> None:
    head = {"config": {"map": {"path": "configured.gpkg"}}}
    stated = {"path": "flown.gpkg", "source": "town.tif", "checksum": "c1", "date": "2021-05-03"}
    view = FlightView(title="", rows=[], frame_ids=[], header=head | {"map": stated})
    assert _map(view, tmp_path) == {"map": "town", "map_checksum": "c1", "map_date": date(2021, 5, 3)}
    view.header = head
    assert _map(view, tmp_path) == {"map": "configured", "map_checksum": None, "map_date": None}


def test_copies_parts_and_later_segments_of_a_record_are_the_same_flight(tmp_path: Path) -> None:
    flight = Invented(3, frames=20)
    run = tmp_path / "a-run"
    rewritten(run / "flight-000.mcap", flight, 0, 40)
    rewritten(run / "flight-001.mcap", flight, 40, 99)
    shutil.copytree(run, tmp_path / "b-later")
    (tmp_path / "b-later" / "flight-000.mcap").unlink()  # the ring has deleted it
    whole = (run / "flight-000.mcap").read_bytes()
    (tmp_path / "c-copy.mcap").write_bytes(whole)
    recover(run, tmp_path / "d-recovered.mcap")
    cut(run, tmp_path / "e-cut.mcap", 1.0, 3.0)
    assert len(ids(tmp_path)) == 5 and len(set(ids(tmp_path))) == 1


def test_the_start_is_that_of_the_flight_when_its_first_segments_were_deleted(tmp_path: Path) -> None:
    later = [message for message in live_messages(FRAMES) if isinstance(message, m.Origin) or message.t_ns > 5e9]
    clock = m.WallClock(t_ns=12 * PERIOD_NS, unix_ns=NOON_NS + 12 * PERIOD_NS, source="autopilot")
    flight, frames = tables_of([*later, clock], tmp_path / "run")
    assert flight["start_utc"] == datetime(2026, 7, 3, 12, 0, 0, tzinfo=UTC)
    assert frames[0]["t_s"] == 5.5 and flight["duration_s"] < 6.0


@pytest.mark.parametrize("changed", ["origin", "version", "configuration"])
def test_another_origin_version_or_configuration_is_another_flight(tmp_path: Path, changed: str) -> None:
    flight = Invented(3, frames=2)
    rewritten(tmp_path / "a.mcap", flight, 0, 9)
    header, origin = dict(flight.header), flight.origin
    if changed == "origin":
        origin = msgspec.structs.replace(origin, t_ns=origin.t_ns + 1)
    elif changed == "version":
        header["versions"] = header["versions"].replace("v1.", "v2.")
    else:
        header["config"] = header["config"].replace("ce90_m", "ce80_m")
    writer = FlightWriter(tmp_path / "b.mcap", header)
    writer.write(origin, origin.t_ns)
    writer.close()
    assert len(set(ids(tmp_path))) == 2


def test_two_runs_that_were_recorded_into_one_folder_are_two_flights(tmp_path: Path) -> None:
    run = tmp_path / "records" / "run"
    rewritten(run / "flight-000.mcap", Invented(1, frames=5), 0, 99)
    rewritten(run / "flight-001.mcap", Invented(2, frames=7), 0, 99)
    (run / "flight-002.mcap").write_bytes((run / "flight-001.mcap").read_bytes()[:200])  # cut off before its origin
    build(str(tmp_path / "records"), tmp_path / "fleet", workers=1)
    assert query(tmp_path / "fleet", "SELECT frames, truncated FROM flights ORDER BY frames").rows == [
        (5, False),
        (7, True),
    ]


@pytest.mark.parametrize(
    ("month", "lat_deg", "expected"),
    [(1, 48.0, "winter"), (12, 48.0, "winter"), (3, 48.0, "spring"), (1, -33.0, "summer"), (7, -33.0, "winter")],
)
def test_seasons_are_meteorological_and_opposite_in_the_south(month: int, lat_deg: float, expected: str) -> None:
    assert season(month, lat_deg) == expected


def test_the_noise_of_a_hovering_vehicle_is_no_distance() -> None:
    hovering = [Row(file="", t_s=0.0, lat_deg=48.0 + (i % 2) * 2e-5, lon_deg=11.0) for i in range(100)]  # 2.2 m
    assert distance_m(hovering) == 0.0
    moving = [Row(file="", t_s=0.0, lat_deg=48.0 + i * 1e-4, lon_deg=11.0) for i in range(11)]
    assert distance_m([*hovering, *moving]) == pytest.approx(111.2, abs=2.3)


def test_the_longest_time_without_a_fix_includes_start_and_end() -> None:
    times_s = [float(t) for t in range(11)]
    assert longest_without_fix_s(times_s, [4.0, 5.0]) == 5.0
    assert longest_without_fix_s(times_s, [7.0, 8.0]) == 7.0
    assert longest_without_fix_s(times_s, []) == 10.0
    assert longest_without_fix_s([], []) is None
