"""False pictures in the closed loop: the edits, and the metrics of GPS_INPUT and of the vehicle's trajectory."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from accept_case import PLACE, FrameCase, evidence
from terrafix.core.config import Config
from terrafix.core.node import Image
from terrafix.messages import GpsInput
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_lab.accept import closed
from terrafix_lab.accept.closed import EditedCamera, sent_fixes
from terrafix_lab.accept.false_inputs import loop_integrity as of
from terrafix_lab.accept.false_inputs import scenarios
from terrafix_lab.accept.false_inputs.scenarios import LIES_IN_THE_LOOP
from terrafix_lab.accept.measuring.criteria import judge
from terrafix_lab.accept.measuring.evidence import Evidence, SentFix
from terrafix_lab.accept.measuring.results import Marks, Verdict
from terrafix_lab.accept.plan import CLOSED_LOOP
from terrafix_lab.accept.run import QUICK_LEAVES_OUT
from terrafix_lab.accept.scenarios import BY_NAME
from terrafix_lab.faults.edits import Span
from terrafix_lab.sim.closed_loop.loop import TRACK_COLUMNS
from terrafix_lab.sim.interfaces import State

LIE = Span(10.0, 20.0, "lie")
HZ = 10


def loop(tmp_path: Path, sent: Callable[[float], SentFix]) -> Evidence:
    """30 s with frames at 2 Hz and GPS_INPUT at 10 Hz; ``sent``: time -> GPS_INPUT."""
    found = evidence(tmp_path, [FrameCase()] * 60, Marks(spans=(LIE,), lie=LIE))
    found.sent = [sent(i / HZ) for i in range(30 * HZ)]
    return found


def fix(t_s: float, error_m: float = 2.0, accuracy_m: float = 5.0, deviation_m: float = 3.0) -> SentFix:
    return SentFix(t_s, error_m, accuracy_m, deviation_m)


def none(t_s: float, deviation_m: float = 3.0) -> SentFix:
    return SentFix(t_s, None, 100.0, deviation_m, "the position has jumped")


def during(from_s: float, to_s: float, **changed: float) -> Callable[[float], SentFix]:
    return lambda t_s: fix(t_s, **changed) if from_s <= t_s <= to_s else fix(t_s)


def test_a_deviation_of_more_than_50_m_with_a_3d_fix_breaks_the_floor(tmp_path: Path) -> None:
    found = loop(tmp_path, during(14.0, 14.0, deviation_m=50.5))
    row = judge("a", ("aside on a fix",), found)[0]
    assert (row.measured, row.verdict) == (50.5, Verdict.BELOW)
    assert row.why == "4.0 s after its beginning; 200 of 200 GPS_INPUT with a 3D fix"
    assert (
        judge("a", ("aside on a fix",), loop(tmp_path / "b", during(14.0, 14.0, deviation_m=49.5)))[0].verdict == "pass"
    )


def test_the_deviation_counts_from_the_start_of_the_false_input_and_only_with_a_fix(tmp_path: Path) -> None:
    assert of.deviation_on_a_fix_m(loop(tmp_path / "before", during(3.0, 9.9, deviation_m=80.0))).value == 3.0
    assert of.deviation_on_a_fix_m(loop(tmp_path / "after", during(25.0, 25.0, deviation_m=80.0))).value == 80.0
    withdrawn = loop(tmp_path / "without", lambda t_s: none(t_s, 80.0) if 12.0 <= t_s <= 14.0 else fix(t_s))
    assert of.deviation_on_a_fix_m(withdrawn).value == 3.0
    nothing = of.deviation_on_a_fix_m(loop(tmp_path / "nothing", none))
    assert nothing == of.Measured(0.0, "no 3D fix any more from its beginning on")


def test_the_deviation_at_the_first_withdrawal_of_the_fix(tmp_path: Path) -> None:
    found = loop(tmp_path / "a", lambda t_s: none(t_s, t_s) if t_s < 2.0 or 12.5 <= t_s <= 15.0 else fix(t_s))
    assert of.deviation_at_withdrawal_m(found) == of.Measured(
        12.5, "2.5 s after its beginning: the position has jumped"
    )
    never = of.deviation_at_withdrawal_m(loop(tmp_path / "b", fix))
    assert never == of.Measured(None, "it is never withdrawn")


def test_a_false_gps_input_has_an_error_beyond_50_m_and_three_times_its_accuracy() -> None:
    assert of.is_false_gps_input(fix(0.0, error_m=51.0, accuracy_m=16.0))
    assert not of.is_false_gps_input(fix(0.0, error_m=51.0, accuracy_m=18.0))
    assert not of.is_false_gps_input(fix(0.0, error_m=49.0, accuracy_m=1.0))
    assert not of.is_false_gps_input(none(0.0))


def test_false_gps_input_is_allowed_for_the_first_three_seconds_of_the_false_input(tmp_path: Path) -> None:
    early = loop(tmp_path / "early", during(10.0, 13.0, error_m=80.0))
    assert of.late_false_fixes_sent(early) == of.Measured(0.0, "of 31")
    longer = loop(tmp_path / "longer", during(10.0, 13.5, error_m=80.0))
    assert of.late_false_fixes_sent(longer) == of.Measured(5.0, "of 36; 3.1 s after its beginning the first")
    assert judge("a", ("late lies sent",), longer)[0].verdict is Verdict.BELOW
    around = loop(tmp_path / "around", lambda t_s: fix(t_s, 80.0) if t_s in (9.9, 20.1) else fix(t_s))
    assert of.late_false_fixes_sent(around).value == 2.0
    assert of.false_fixes_sent(longer) == of.Measured(36.0, "of 300 with a 3D fix; 80 m off at a claim of 5 m at worst")


def test_false_gps_input_is_allowed_for_five_frames_if_these_are_longer_than_three_seconds(tmp_path: Path) -> None:
    found = loop(tmp_path, during(10.0, 18.0, error_m=80.0))
    for number, frame in enumerate(found.frames):
        frame.row.t_s = 2.0 * number
    assert of.late_false_fixes_sent(found).value == 0.0  # the fifth frame of the lie is at 18 s


def test_a_correct_fix_for_a_second_is_required_within_five_seconds_after_the_false_input(tmp_path: Path) -> None:
    assert of.fix_again_s(loop(tmp_path / "at once", fix)).value == pytest.approx(0.1)
    for name, wrong in (("none", none), ("off", lambda t_s: fix(t_s, 25.0)), ("false", lambda t_s: fix(t_s, 90.0))):
        found = loop(tmp_path / name, lambda t_s, wrong=wrong: wrong(t_s) if t_s < 24.0 or t_s == 24.5 else fix(t_s))  # type: ignore[misc]
        assert of.fix_again_s(found).value == pytest.approx(4.6), name
    late = loop(tmp_path / "late", lambda t_s: none(t_s) if t_s < 25.2 else fix(t_s))
    assert judge("a", ("fix again",), late)[0].verdict is Verdict.BELOW
    never = loop(tmp_path / "never", lambda t_s: none(t_s) if t_s < 29.5 else fix(t_s))
    assert of.fix_again_s(never) == of.Measured(None, "never", Verdict.BELOW)


def test_a_flight_without_gps_input_breaks_the_floors(tmp_path: Path) -> None:
    found = evidence(tmp_path, [FrameCase()] * 60, Marks(spans=(LIE,), lie=LIE))
    rows = judge("a", ("aside on a fix", "late lies sent", "lies sent"), found)
    assert [row.verdict for row in rows] == [Verdict.BELOW] * 3
    assert judge("a", ("fix again",), found)[0].why == "the flight ends with the lie"


def write_track(folder: Path, place: Callable[[float], tuple[float, float]]) -> None:
    folder.mkdir(exist_ok=True)
    with (folder / "track.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(TRACK_COLUMNS)
        for t_s in np.arange(0.0, 70.0, 0.2).tolist():
            e_m, n_m = place(t_s)
            writer.writerow([t_s, e_m, n_m, 100.0, 100.0, "", "", ""])


def gps_input(t_s: float, e_m: float, n_m: float, fix_type: int = 3) -> GpsInput:
    lat_deg, lon_deg = PLACE.to_wgs84(e_m, n_m)
    return GpsInput(
        t_ns=round(t_s * 1e9), fix_type=fix_type, time_week=0, time_week_ms=0, lat_deg=lat_deg, lon_deg=lon_deg,
        alt_amsl_m=100.0, hdop=1.0, vdop=1.0, vn_mps=0.0, ve_mps=0.0, vd_mps=0.0, speed_accuracy_mps=0.3,
        horiz_accuracy_m=4.0, vert_accuracy_m=4.0, satellites_visible=6, estimate_age_ms=0.0,
        no_fix_reason="dark")  # fmt: skip


def test_gps_input_is_compared_with_the_truth_and_the_vehicle_with_the_reference_flight(tmp_path: Path) -> None:
    """North at 20 m/s, a second behind the reference flight and 30 m east of it; that one stops at 20 s."""
    write_track(tmp_path / "way", lambda t_s: (0.0, 20.0 * t_s if t_s < 20.0 else 400.0))
    write_track(tmp_path, lambda t_s: (30.0, 20.0 * (t_s - 1.0)))
    writer = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    for message in (gps_input(10.1, 30.0, 182.0 + 60.0), gps_input(12.0, 0.0, 0.0, fix_type=1)):
        writer.write(message, message.t_ns)
    writer.close()
    first, second = sent_fixes(tmp_path, tmp_path / "way", PLACE)
    assert (first.t_s, first.accuracy_m) == (10.1, 4.0)
    assert first.error_m == pytest.approx(60.0, abs=0.1)
    assert first.deviation_m == pytest.approx(30.0, abs=0.1)
    assert (second.error_m, second.reason) == (None, "dark")


@pytest.mark.parametrize("now_s", [10.0, 50.0])
def test_a_later_leg_over_the_same_ground_is_not_the_reference(now_s: float, tmp_path: Path) -> None:
    write_track(tmp_path / "way", lambda t_s: (0.0, 20.0 * t_s))
    write_track(tmp_path, lambda _: (0.0, 600.0))  # on the reference trajectory 20 s later or earlier
    writer = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    writer.write(gps_input(now_s, 0.0, 600.0), 0)
    writer.close()
    assert sent_fixes(tmp_path, tmp_path / "way", PLACE)[0].deviation_m == pytest.approx(200.0, abs=0.5)


def state(t_s: float) -> State:
    zero = np.zeros(3)
    return State(t_s, zero, zero, 0.0, 0.0, 0.0, 100.0, zero, zero, 20.0)


def pictures(name: str) -> list[Image]:
    """200 frames at 2 Hz; the true picture of frame i has grey i + 1 on the left, and 250 on the right."""

    def view(_: State, index: int) -> Image:
        image = np.full((40, 40, 3), 250, np.uint8)
        image[:, :20] = index + 1
        return image

    camera = EditedCamera(view, LIES_IN_THE_LOOP[name](closed.LIE))
    taken = [camera(state(i / 2), i) for i in range(200)]
    return [image for image in taken if image is not None]


FIRST, LAST = 120, 150  # frames of the lie


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("GNSS jam, frozen picture", lambda _: FIRST),
        ("GNSS jam, four stale buffers", lambda i: FIRST - 3 + (i - FIRST) % 4),
        ("GNSS jam, late pictures", lambda i: i + 1 - 2),
    ],
)
def test_earlier_pictures_are_shown_only_within_the_false_input(name: str, shown: Callable[[int], int]) -> None:
    for i, image in enumerate(pictures(name)):
        assert image[:, :20].mean() == pytest.approx(shown(i) if FIRST <= i <= LAST else i + 1, abs=0.3), i


@pytest.mark.parametrize("name", ["GNSS jam, frozen picture", "GNSS jam, four stale buffers"])
def test_a_repeated_picture_has_new_noise(name: str) -> None:
    lie = pictures(name)[FIRST : LAST + 1]
    assert len({image.tobytes() for image in lie}) == len(lie)


def test_foreign_pictures_are_mirrored_ones_of_25_s_before() -> None:
    for i, image in enumerate(pictures("GNSS jam, foreign frames")):
        assert (image[0, -1, 0], image[0, 0, 0]) == ((i + 1 - 50, 250) if FIRST <= i <= LAST else (250, i + 1)), i


def test_an_edit_keeps_missing_pictures() -> None:
    camera = EditedCamera(lambda _state, _index: None, LIES_IN_THE_LOOP["GNSS jam, late pictures"](closed.LIE))
    assert [camera(state(t_s), 0) for t_s in (0.0, 61.0)] == [None, None]


def test_every_closed_loop_false_input_is_a_scenario_that_quick_skips() -> None:
    names = {scenario.name for scenario in scenarios.LIES if scenario.ground == CLOSED_LOOP}
    assert names == set(LIES_IN_THE_LOOP) and names <= set(QUICK_LEAVES_OUT)
    for name in names:
        assert BY_NAME[name].frames / 2.0 >= closed.LIE.to_s + 20.0, name
        assert {"aside on a fix", "late lies sent", "fix again", "failsafes"} <= set(BY_NAME[name].criteria)
