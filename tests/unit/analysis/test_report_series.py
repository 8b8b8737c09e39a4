"""Thinning of long series, statistics of innovations and of the delays by stage."""

import re
from collections import Counter

import msgspec
import numpy as np
import pytest

from flight_records import estimate, frame, gps_input
from terrafix import messages as m
from terrafix_tools.pages.charts import Chart
from terrafix_tools.pages.series import COLUMNS, thin_line, thin_marks, thin_path, thin_spans
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.innovations import Innovations, spread_of
from terrafix_tools.report.sections_computer import computer, medians
from terrafix_tools.report.sections_innovations import innovations
from terrafix_tools.report.stage_times import StageTimes

MS = 1_000_000


def test_a_long_line_keeps_its_extremes() -> None:
    points = [(k * 0.01, 50.0) for k in range(90_000)]
    points[12_345] = (123.45, 3.0)
    points[77_777] = (777.77, 99.0)
    thin = thin_line(points)
    assert len(thin) <= 4 * COLUMNS
    assert points[12_345] in thin and points[77_777] in thin
    assert (thin[0], thin[-1]) == (points[0], points[-1])
    assert thin == sorted(thin)
    assert thin_line(points[:1000]) == points[:1000]


def test_a_chart_of_an_hour_is_small() -> None:
    chart = Chart(x_max=3600.0, y_min=0.0, y_max=1.0)
    chart.line([(k / 10, (k % 7) / 7) for k in range(36_000)], "error")
    assert len(chart.marks[0]) < 60_000


@pytest.mark.parametrize(("unit", "lengths"), [("s", [10, 2, 5]), ("", [10, 6])])
def test_a_line_is_not_drawn_over_a_gap_in_time_nor_over_unknown_values(unit: str, lengths: list[int]) -> None:
    chart = Chart(x_max=100.0, y_min=0.0, y_max=1.0, x_unit=unit)
    points = [(float(k), None if k == 10 else 0.5) for k in range(12)]  # one alone after the unknown one
    chart.line([*points, *((float(k), 0.5) for k in range(80, 85))], "error")
    runs = [re.findall(r"[\d.]+,[\d.]+", mark) for mark in chart.marks]
    assert [len(run) for run in runs] == lengths  # the one alone is a dot: a line of no length
    chart.area([(0.0, 0.5), (1.0, 0.5), (2.0, 0.5), (60.0, 0.5)], "claim")
    areas = [mark for mark in chart.marks if "<polygon" in mark]
    assert len(areas) == (2 if unit == "s" else 1)


def test_a_short_state_is_seen_among_many() -> None:
    spans = [(float(k), float(k + 1), "good" if k % 2 else "fair", f"{k}") for k in range(4000)]
    spans[2001] = (2001.0, 2002.0, "bad", "the one")
    thin = thin_spans(spans, 4000.0)
    assert len(thin) <= COLUMNS
    assert [tip for *_, css, tip in thin if css == "bad"] == ["the one"]
    assert thin[0][0] == 0.0 and thin[-1][1] == pytest.approx(4000.0)


def test_marks_and_tracks_are_thinned_by_distance() -> None:
    assert thin_marks([(0.0, 0.0), (0.4, 0.4), (5.0, 0.0)], 1.0) == [(0.0, 0.0), (5.0, 0.0)]
    assert thin_path([(0.0, 0.0), (0.3, 0.0), (2.0, 0.0), (2.1, 0.0)], 1.0) == [(0.0, 0.0), (2.0, 0.0), (2.1, 0.0)]


def _verdict(
    i: int, innovation: float, ratio: float | None, verdict: m.Verdict = m.Verdict.ACCEPTED
) -> m.MeasurementVerdict:
    return m.MeasurementVerdict(
        t_ns=i * 1000 * MS, frame_id=i, measurement="height", verdict=verdict, innovation=(innovation,),
        innovation_variance=(4.0,), test_ratio=ratio,
    )  # fmt: skip


def test_innovations_are_normalised_by_their_variance_and_rejected_ones_left_out() -> None:
    found = Innovations()
    for i, value in enumerate((-2.0, 2.0, 6.0)):
        found.take(_verdict(i, value, 0.1))
    found.take(_verdict(3, 200.0, 9.0, m.Verdict.INNOVATION))
    found.take(_verdict(4, 1.0, None))
    assert found.normalised().ravel().tolist() == [-1.0, 1.0, 3.0]
    assert [one.accepted for one in found.tested] == [True, True, True, False]
    spread = spread_of(found.normalised().ravel())
    assert spread is not None
    assert (spread.count, spread.mean, spread.deviation) == (3, 1.0, 2.0)
    assert spread.outside == pytest.approx(1 / 3)


def test_the_section_says_how_many_were_rejected_and_how_wide_they_are() -> None:
    view = FlightView("flight", [], [])
    rng = np.random.default_rng(5)
    for name in ("odometry", "height"):
        view.innovations[name] = Innovations()
        for i in range(400):
            view.innovations[name].take(_verdict(i, 4.0 * float(rng.normal()), 0.5))
        view.innovations[name].take(_verdict(400, 50.0, 9.0, m.Verdict.INNOVATION))
    view.verdicts = {"odometry": Counter({"accepted": 400, "innovation": 1}), "height": Counter({"innovation": 1})}
    page = innovations(view)
    assert "1 of 401 rejected (0.2 %)" in page
    assert "1 rejected; accepted ones are not recorded" in page
    assert page.count('class="crosses rejected"') == 2 and page.count('class="points accepted"') == 2
    assert "standard deviation 1.9" in page or "standard deviation 2.0" in page


def _received(times: StageTimes, message: m.Message, delay_ms: float) -> None:
    times.take(message.t_ns + round(delay_ms * MS), message)


def test_delays_are_counted_from_the_exposure_by_stage() -> None:
    times = StageTimes()
    for i in range(3):
        exposed_ns = i * 500 * MS
        _received(times, frame(i), 10)
        _received(times, m.Odometry(t_ns=exposed_ns, frame_id=i, keyframe_id=0, verdict=m.Verdict.ACCEPTED), 40 + i)
        _received(times, estimate(i, 0.0, 0.0), 60)
        # 100 ms old: with the first estimate of the frame, and before the last one.
        times.take(exposed_ns + 101 * MS, gps_input(exposed_ns + 100 * MS))
        _received(times, m.MapMatch(t_ns=exposed_ns, frame_id=i, verdict=m.Verdict.ACCEPTED, matcher="gradient"), 150)
        _received(times, estimate(i, 0.0, 0.0), 170)
        for age_ms in (200, 300):
            sent = msgspec.structs.replace(gps_input(exposed_ns + age_ms * MS), estimate_age_ms=float(age_ms))
            times.take(exposed_ns + (age_ms + 2) * MS, sent)
    assert times.percentiles_ms("odometry")[0] == 41.0
    assert times.percentiles_ms("estimate") == [170.0, 170.0, 170.0]
    assert times.percentiles_ms("GPS_INPUT") == [202.0, 202.0, 202.0]
    assert (times.step_ms("map match"), times.step_ms("estimate"), times.step_ms("frame")) == (None, 20.0, None)
    assert times.series("frame", 500 * MS) == [(-0.5, 10.0), (0.0, 10.0), (0.5, 10.0)]


def test_a_replay_has_no_latency() -> None:
    view = FlightView("flight", [], [])
    _received(view.stage_times, frame(0), 10)
    assert "Latency by stage" not in computer(view)
    view.clocked = True
    assert "Latency by stage" in computer(view)
    assert "Latency by stage" not in computer(FlightView("flight", [], [], clocked=True))


def test_medians_have_gaps_where_nothing_was_received() -> None:
    line = medians([(1.0, 5.0), (1.5, 7.0), (1.6, 90.0), (599.0, 4.0)], 600.0)
    assert line[0] == (2.5, 7.0)
    assert line[1] == (7.5, None)
    assert line[-1][1] == 4.0
