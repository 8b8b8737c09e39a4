"""The worst moments of a flight: the rule by which they are chosen, and what is said of them."""

from pathlib import Path

import numpy as np

from flight_records import ORIGIN, estimate, frame, gps_input, origin
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.recorder.images import thumbnail_jpeg
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.estimates import NS, Row
from terrafix_tools.evaluate import Compared, Truth
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.innovations import Innovations
from terrafix_tools.report.moment_record import FrameRecord, is_picture, read_frames, shown_frame
from terrafix_tools.report.moment_text import facts
from terrafix_tools.report.moments import Candidate, Moment, peaks, worst_moments
from terrafix_tools.report.page import MAX_POINTED, pointed_rows


def row(t_s: float, sigma_m: float) -> Row:
    lat_deg, lon_deg = ORIGIN.to_wgs84(0.0, 0.0)
    return Row(f"{t_s:g}.jpg", t_s, lat_deg, lon_deg, sigma_e_m=sigma_m, sigma_n_m=sigma_m, cov_en_m2=0.0)


def flight(sigmas_m: list[float]) -> FlightView:
    """A frame a second."""
    return FlightView("flight", [row(float(t), s) for t, s in enumerate(sigmas_m)], list(range(len(sigmas_m))))


def verdict(i: int, ratio: float, verdict: m.Verdict = m.Verdict.INNOVATION) -> m.MeasurementVerdict:
    return m.MeasurementVerdict(
        t_ns=i * NS, frame_id=i, measurement="map", verdict=verdict, test_ratio=ratio, detail="12 m away"
    )


def test_a_peak_is_not_led_up_to_by_a_worse_candidate_nearby() -> None:
    sizes = [9.0, 8.0, 7.0, 6.0, 5.0, 1.0, 4.0, 1.0]
    ordered = sorted((Candidate(float(t), size, "") for t, size in enumerate(sizes)), key=lambda c: -c.size)
    assert [found.t_s for found in peaks(ordered, 1.5)] == [0.0, 6.0]
    assert [found.t_s for found in peaks(ordered, 0.5)] == [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 5.0, 7.0]
    assert [found.t_s for found in peaks(ordered[:5] + ordered[6:], 1.5)] == [0.0, 7.0]


def test_the_largest_radii_are_moments_at_least_ten_seconds_apart() -> None:
    sigmas = [1.0] * 400
    for at, sigma in ((50, 80.0), (56, 70.0), (200, 90.0), (300, 30.0)):
        sigmas[at] = sigma
    moments = worst_moments(flight(sigmas))
    assert [moment.t_s for moment in moments] == [50.0, 200.0]  # 73 m at 300 s is a fix, which the autopilot gets
    assert moments[0].reasons == {"accuracy": "Stated 95 % radius 195.8 m"}
    assert (moments[1].row, moments[1].frame_id) == (200, 200)


def test_a_flight_in_which_nothing_was_bad_has_no_worst_moment() -> None:
    view = flight([2.0] * 400)
    truth = Truth(48.0, 11.0)
    view.compared = {r.file: Compared(r, truth, 0.0, 0.0, 5.0, None, None) for r in view.rows}
    view.innovations = {"map": Innovations()}
    view.innovations["map"].take(verdict(333, 5.0))
    assert worst_moments(view, trusted=True) == []
    assert [moment.t_s for moment in worst_moments(view)] == [333.0]
    view.compared["100.jpg"] = Compared(view.rows[100], truth, 0.0, 0.0, 7.0, None, None)  # 3.5 sigma
    assert [moment.t_s for moment in worst_moments(view, trusted=True)] == [100.0]


def test_the_kinds_take_turns_and_neighbours_become_reasons() -> None:
    view = flight([2.0] * 401)
    without_s = {*range(100, 130), 400}  # the last message alone has no duration
    view.gps = [(float(t), gps_input(t * NS, 1 if t in without_s else 3)) for t in range(401)]
    view.faults = [
        (102.0, m.CalibrationFault(t_ns=0, quantity="scale", factor=2.0, detail="measured", active=True)),
        (140.0, m.CalibrationFault(t_ns=0, quantity="scale", factor=2.0, detail="measured", active=False)),
    ]
    view.events = [(250.0, m.ProcessEvent(t_ns=0, process="vision", event="died", detail="signal 9"))]
    view.innovations = {"map": Innovations()}
    for found in (verdict(350, 3.0), verdict(380, 0.5), verdict(20, 2.0, m.Verdict.ACCEPTED)):
        view.innovations["map"].take(found)
    moments = {moment.t_s: list(moment.reasons.values()) for moment in worst_moments(view)}
    assert moments[100.0] == [
        "GPS_INPUT without a 3D fix for 30.0 s: no estimate yet",
        "Height/focal seems x2.00 off: no fix: measured (at 1:42)",
        "No GPS_INPUT for 1.0 s (at 1:30)",
    ]
    assert not any("for 0.0 s" in reason for reasons in moments.values() for reason in reasons)
    assert moments[250.0][0] == "Process vision died: signal 9"
    assert moments[350.0][0] == "Map match rejected, 3.0 times its gate: 12 m away"
    assert 380.0 not in moments and 20.0 not in moments


def test_there_are_ten_moments_at_most_in_order_of_time() -> None:
    view = flight([2.0 + (t % 40 == 20) * (100.0 + t / 1000) for t in range(1000)])
    truth = Truth(48.0, 11.0)
    error_m = {501.0: 30.0, 420.0: 20.0, 265.0: 10.0, 170.0: 5.0, 130.0: 4.0}
    view.compared = {r.file: Compared(r, truth, 0.0, 0.0, error_m.get(r.t_s, 0.1), None, None) for r in view.rows}
    view.innovations = {"map": Innovations()}
    view.innovations["map"].take(verdict(333, 5.0))
    moments = worst_moments(view)
    assert len(moments) == 10
    assert [moment.t_s for moment in moments] == sorted(moment.t_s for moment in moments)
    by_time = {moment.t_s: moment for moment in moments}
    assert by_time[501.0].reasons["error"] == "Error 30.0 m against the truth, stated 95 % radius 4.9 m"
    assert 980.0 in by_time and 20.0 not in by_time  # the largest radius, and one of the smaller ones


def test_a_lost_link_and_a_search_are_moments() -> None:
    view = flight([2.0] * 301)

    def status(connected: bool) -> m.LinkStatus:
        return m.LinkStatus(
            t_ns=0, connected=connected, autopilot="px4", sysid=1, sent=0, received=0, bad=0, time_offset_ms=None
        )

    view.link_states = [(t, status(not 60 <= t < 80)) for t in map(float, range(301))]
    view.searches = [
        (200.0, m.SearchState(t_ns=0, step=m.SearchStep.WIDEN)),
        (212.0, m.SearchState(t_ns=0, step=m.SearchStep.NORMAL)),
    ]
    moments = {moment.t_s: list(moment.reasons.values()) for moment in worst_moments(view)}
    assert moments[60.0][0] == "Link to the autopilot down for 20.0 s"
    assert moments[200.0][0] == "Search of the map (widen) for 12.0 s"


def test_the_pictures_are_of_the_nearest_frame_that_was_matched() -> None:
    view = flight([2.0] * 20)
    view.map_matches = [(4.0, 4), (8.0, 8), (9.0, 9)]
    assert [shown_frame(view, Moment(float(t), t, t)) for t in (8, 5, 6, 12)] == [8, 4, 6, 12]


def test_the_nearest_pictures_and_the_messages_of_frames_are_read(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    pictures = {i: thumbnail_jpeg(np.full((48, 64, 3), 20 * i, np.uint8), 32) for i in (2, 3, 8, 9)}
    for i in range(10):
        writer.write(frame(i), 0)
        writer.write(estimate(i, float(i), 0.0), 0)
        writer.write(m.Odometry(t_ns=0, frame_id=i, keyframe_id=0, verdict=m.Verdict.ACCEPTED, inliers=i), 0)
        if i in pictures:
            writer.write_thumbnail(0, i, pictures[i])
    writer.close()
    view = flight([2.0] * 10)
    view.folder = tmp_path
    records, found = read_frames(view, {4, 9}, [0])
    assert found == {2: pictures[2], 9: pictures[9]}
    assert sorted(records) == [4, 9]
    assert records[4].odometry is not None and records[4].odometry.inliers == 4
    assert records[9].estimate == estimate(9, 9.0, 0.0)


def test_the_times_of_log_show_count_from_origin() -> None:
    view = flight([2.0])
    view.origin, view.zero_ns = origin(), 7 * NS
    assert view.log_s(1.5) == 8.5


def test_of_a_long_flight_some_frames_answer_to_the_pointer_and_the_moments_do() -> None:
    view = flight([2.0] * 9001)
    rows = pointed_rows(view, [Moment(4567.0, 4567, 4567)])
    assert len(rows) < MAX_POINTED + 20
    assert {0, 4567, 9000} <= set(rows) and rows == sorted(rows)
    assert pointed_rows(flight([2.0] * 300), []) == list(range(300))


def test_a_damaged_picture_is_none() -> None:
    jpeg = thumbnail_jpeg(np.full((48, 64, 3), 90, np.uint8), 32)
    assert is_picture(jpeg)
    assert not is_picture(jpeg[:-40])
    assert not is_picture(b"\x00" * 40 + b"\xff\xd9")


def test_the_facts_of_a_moment_are_plain_words() -> None:
    view = flight([2.0] * 20)
    view.origin = origin()
    view.health = [
        (
            float(t),
            m.Health(
                t_ns=0, band=m.ThermalBand.HOT, temperature_c=82.0, throttled=True, disk_free_mb=1, cause="",
                clock_limit=0.5,
            ),
        )
        for t in (6.0, 30.0)
    ]  # fmt: skip
    view.pilot_texts = [
        (7.0, m.StatusText(t_ns=0, severity=4, text="Terrafix: no fix")),
        (13.0, m.StatusText(t_ns=0, severity=4, text="later")),
    ]
    own = FrameRecord(7, estimate=estimate(7, 0.0, 0.0))
    own.take(verdict(7, 1.5))
    shown = FrameRecord(8)
    shown.take(
        m.MapMatch(
            t_ns=0, frame_id=8, verdict=m.Verdict.AMBIGUOUS, matcher="gradient", inliers=9,
            search=m.SearchResult(step=m.SearchStep.WHOLE_MAP, sigma_m=900.0),
        )
    )  # fmt: skip
    said = dict(facts(view, Moment(7.0, 7, 7), own, shown))
    assert said["Position"].startswith("95 % radius 4.9 m")
    assert said["Gate of map"] == "too far from the prediction; test ratio 1.50 (limit 1); 12 m away"
    assert said["Map match (of frame 8)"] == "more than one place fits; 9 points agree, by gradient"
    assert said["Search"] == "lost: searching the whole map; 1-sigma 900 m"
    assert said["Computer"] == "hot, 82 °C, clocks limited to 50 %, throttled"
    assert said["Text to the pilot, 0:07"] == "Terrafix: no fix" and "later" not in said.values()
