"""The report: one self-contained page, from a live record or a replay, with or without truth."""

import re
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import pytest
from mcap.reader import make_reader

from flight_records import PERIOD_NS, frame, live_messages, origin, write_record, write_truth
from terrafix.core.config import Config
from terrafix.core.errors import SourceError
from terrafix.messages import (
    CalibrationFault,
    EkfStatus,
    GnssReading,
    GnssState,
    GnssVerdict,
    MapMatch,
    MeasurementVerdict,
    Message,
    Verdict,
)
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.estimates import Row, write_rows
from terrafix_tools.pages.charts import clock, spans_of, ticks
from terrafix_tools.report.page import report


class Page(HTMLParser):
    """Open tags, links and text of an HTML page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.text = ""
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "action")]
        self.ids |= {value or "" for name, value in attrs if name == "id"}
        if tag not in ("meta", "img", "input", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def page_of(folder: Path, **options: Path) -> Page:
    text = report(folder, options.get("truth"), options.get("map")).read_text(encoding="utf-8")
    assert not re.search(r"https?:|url\(|@import", text)
    page = Page(text)
    assert page.open == []
    assert all(link.startswith("data:image/jpeg;base64,") or link[1:] in page.ids for link in page.links)
    return page


def test_the_report_of_a_live_record_with_truth_has_all_sections(tmp_path: Path) -> None:
    write_record(tmp_path / "flight-000.mcap", live_messages())
    write_truth(tmp_path / "truth.csv")
    (tmp_path / "peer.json").write_text('{"longest_gap_ms": 512.5, "resets": 0}')
    page = page_of(tmp_path)
    for words in ("within 20 m", "95 % ellipse", "Verdicts", "ambiguous", "GPS_INPUT", "longest gap ms", "thermal"):
        assert words in page.text, words
    assert "Process link: died (signal 9 <kill>)." in page.text
    assert "Longest GPS_INPUT gap: 0.50 s." in page.text
    assert "3 messages were dropped" in page.text
    assert any(link.startswith("data:image/jpeg") for link in page.links)


def test_the_report_has_calibration_faults_and_the_verdict(tmp_path: Path) -> None:
    wrong = CalibrationFault(
        t_ns=7_000_000_000, quantity="scale", factor=2.0, detail="stated against measured", active=True
    )
    right = CalibrationFault(
        t_ns=8_000_000_000, quantity="scale", factor=2.0, detail="stated against measured", active=False
    )
    write_record(tmp_path / "flight-000.mcap", [*live_messages(), wrong, right])
    text = page_of(tmp_path).text
    assert "Height/focal seems x2.00 off: no fix: stated against measured." in text
    assert (
        "Trust it from 8.0 s (0016.jpg) to 9.5 s (0019.jpg), and no more than that "
        "(height/focal seems x2.00 off)." in text
    )


def test_the_report_has_the_rejected_map_matches_with_the_largest_test_ratios(tmp_path: Path) -> None:
    def verdict(i: int, verdict: Verdict, detail: str, test_ratio: float | None = None) -> MeasurementVerdict:
        return MeasurementVerdict(
            t_ns=i * PERIOD_NS, frame_id=i, measurement="map", verdict=verdict, detail=detail, test_ratio=test_ratio
        )

    def match(i: int, verdict: Verdict) -> MapMatch:
        return MapMatch(t_ns=i * PERIOD_NS, frame_id=i, verdict=verdict, matcher="gradient")

    learned = MapMatch(t_ns=PERIOD_NS, frame_id=1, verdict=Verdict.FEW_INLIERS, matcher="xfeat")
    few = [match(0, Verdict.FEW_INLIERS), verdict(0, Verdict.FEW_INLIERS, "5 inliers"), learned]
    (tmp_path / "few").mkdir()
    write_record(tmp_path / "few" / "flight.mcap", [origin(), *(frame(i) for i in range(3)), *few])
    text = page_of(tmp_path / "few").text
    assert "1 of 1 rejected map matches" in text
    assert "Frames matched with the map by: gradient 50 %, xfeat 50 %." in text
    assert "0.0 s0few inliersanchor-5 inliers" in text

    gated: list[Message] = []
    for i in range(1, 24):
        gated += [match(i, Verdict.ACCEPTED), verdict(i, Verdict.INNOVATION, f"<{i}> m", 1.0 + 0.01 * i)]
    (tmp_path / "all").mkdir()
    write_record(tmp_path / "all" / "flight.mcap", [origin(), *(frame(i) for i in range(24)), *few, *gated])
    text = page_of(tmp_path / "all").text
    assert "20 of 24 rejected map matches" in text
    assert "11.5 s23innovationestimator1.23<23> m" in text
    assert "<3> m" not in text and "5 inliers" not in text  # the smallest ratios, and none


def test_the_report_has_the_moments_with_links_and_commands(tmp_path: Path) -> None:
    folder = tmp_path / "a flight"
    folder.mkdir()
    write_record(folder / "flight-000.mcap", live_messages(60))
    write_truth(folder / "truth.csv", 60)
    page = page_of(folder)
    assert "#moment-1" in page.links and "moment-1" in page.ids
    assert "Process link died: signal 9 <kill>" in page.text
    assert f"terrafix log show '{folder}' --from 4.0 --to 6.0\nterrafix locate '{folder}' --frame 10" in page.text


def test_a_damaged_picture_is_left_out_with_a_note(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    for message in live_messages():
        writer.write(message, message.t_ns)
    for i in range(20):
        writer.write_thumbnail(i * PERIOD_NS, i, b"\xff\xd8 no picture \xff\xd9" if i % 2 else b"cut off")
    writer.close()
    page = page_of(tmp_path)
    assert "no readable picture of it in the record" in page.text
    assert not any(link.startswith("data:") for link in page.links)


def test_the_report_has_the_receivers_and_the_ekf_of_the_autopilot(tmp_path: Path) -> None:
    def judged(t_ns: int, state: GnssState) -> GnssVerdict:
        return GnssVerdict(t_ns=t_ns, receiver=1, state=state, distance_m=80.0, sigmas=20.0, reason="80 m away")

    def reading(t_ns: int) -> GnssReading:
        return GnssReading(
            t_ns=t_ns, receiver=1, fix_type=3, lat_deg=48.0, lon_deg=11.0, horizontal_m=1.0, speed_mps=0.0, satellites=9
        )

    seconds = [i * 1_000_000_000 for i in range(10)]
    more: list[Message] = [EkfStatus(t_ns=t, flags=831, position_ratio=0.4, velocity_ratio=0.1) for t in seconds[:5]]
    more += [EkfStatus(t_ns=t, flags=0, position_ratio=1.4, velocity_ratio=0.1) for t in seconds[5:]]
    more += [judged(t, GnssState.TRUSTED if t < 5e9 else GnssState.SPOOFED) for t in seconds]
    more += [reading(t) for t in seconds]
    write_record(tmp_path / "flight-000.mcap", [*live_messages(), *more])
    page = page_of(tmp_path)
    assert "with an absolute horizontal position50.0 %position beyond its gate50.0 %" in page.text
    assert "0:05  GPS2spoofed: 80 m away" in page.text
    assert "Changes of state (2)" in page.text
    assert "GPS2" in page.text and "GPS1" not in page.text


def test_without_truth_the_report_shows_the_reported_accuracy(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", live_messages())
    page = page_of(tmp_path)
    assert "reported 95 % radius, median" in page.text
    assert "no ground truth" in page.text
    assert "median error" not in page.text


def test_the_report_of_a_truncated_record_states_the_truncation(tmp_path: Path) -> None:
    write_record(tmp_path / "flight-000.mcap", live_messages(60))
    data = (tmp_path / "flight-000.mcap").read_bytes()
    (tmp_path / "flight-000.mcap").write_bytes(data[: len(data) * 3 // 4])
    assert "1 file(s) of the record are truncated" in page_of(tmp_path).text


def test_damaged_parts_of_a_record_are_named(tmp_path: Path) -> None:
    write_record(tmp_path / "flight-000.mcap", live_messages(400))
    data = bytearray((tmp_path / "flight-000.mcap").read_bytes())
    summary = make_reader(BytesIO(data)).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    (tmp_path / "flight-000.mcap").write_bytes(data)
    assert "1 damaged part(s) of the record were left out: flight-000.mcap, byte " in page_of(tmp_path).text


def test_the_report_of_an_interrupted_replay_says_unfinished(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap.partial", live_messages())
    with (tmp_path / "estimates.csv.partial").open("w") as stream:
        write_rows(stream, [Row(file="0000.jpg", t_s=0.0), Row(file="0001.jpg", t_s=0.5)])
    assert "replay, unfinished" in page_of(tmp_path).text


def test_the_report_of_a_flight_without_position_says_so(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [origin(), frame(0), frame(1)])
    assert "No frame was localised" in page_of(tmp_path).text


def test_a_flight_of_a_single_frame_has_a_report(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", live_messages(2)[:6])
    page_of(tmp_path)


def test_file_names_are_escaped_in_the_report(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [origin(), frame(0, "</script><script>alert(1)</script>.jpg")])
    text = report(tmp_path).read_text(encoding="utf-8")
    assert "<script>alert" not in text


def test_a_folder_without_a_flight_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no flight record"):
        report(tmp_path)
    with pytest.raises(SourceError, match="no such folder"):
        report(tmp_path / "none")
    write_record(tmp_path / "flight.mcap", [origin()])
    with pytest.raises(SourceError, match="no frame"):
        report(tmp_path)


def test_chart_ticks_are_round_and_inside_the_range() -> None:
    assert ticks(0.0, 100.0, 5) == [0, 20, 40, 60, 80, 100]
    assert ticks(0.0, 178.5, 9, sixties=True) == [0, 30, 60, 90, 120, 150]
    assert ticks(0.5, 60.0, 5, log=True) == [0.5, 1, 2, 5, 10, 20, 50]


def test_clock_texts_and_state_spans() -> None:
    assert [clock(t) for t in (0, 75, 3725)] == ["0:00", "1:15", "1:02:05"]
    assert spans_of([(0, "a"), (1, "a"), (2, "b")], 5) == [(0, 2, "a"), (2, 5, "b")]
