"""Judgement of a cell of the fault matrix, its table, and the damage that its camera does."""

import time
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from terrafix.core.errors import OutputError, SourceError, UsageError
from terrafix_lab.chaos import run, verdict
from terrafix_lab.chaos.camera import StreamedCamera
from terrafix_lab.chaos.rig import Rig
from terrafix_lab.chaos.run import Results
from terrafix_lab.chaos.scene import AGL_M, ChaosScene, phases
from terrafix_lab.chaos.table import table, write_table
from terrafix_lab.chaos.verdict import Outcome
from terrafix_lab.faults.edits import Edit, Span, unchanged, unchanged_origin
from terrafix_lab.faults.fault import CAMPAIGNS, Phase, check_flown_by, lacking
from terrafix_lab.faults.table import FAULTS, MATRIX
from terrafix_lab.sim.autopilot.course import PeerState
from terrafix_lab.sim.autopilot.report import ReceivedFix
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_tools.score import longest_gap_s


def ticks(from_s: float, to_s: float) -> list[float]:
    """Times of GPS_INPUT at 10 Hz."""
    return np.arange(from_s, to_s - 0.01, 0.1).tolist()


def test_silence_is_the_longest_time_without_a_message_and_reaches_to_the_ends() -> None:
    received = [*ticks(0.0, 5.0), *ticks(9.0, 12.0)]
    assert longest_gap_s(received, 4.0, 12.0) == pytest.approx(4.1, abs=0.11)
    assert longest_gap_s(received, 4.0, 20.0) == pytest.approx(8.1, abs=0.11)
    assert longest_gap_s([], 4.0, 7.0) == 3.0


def test_the_fix_is_back_when_none_is_missing_any_more() -> None:
    fixes = [*ticks(0.0, 5.0), *ticks(8.0, 9.0), *ticks(12.0, 20.0)]
    assert verdict.back_s(fixes, 6.0, 20.0) == pytest.approx(6.0)
    assert verdict.back_s(fixes, 14.0, 20.0) == 0.0
    assert verdict.back_s(fixes, 6.0, 25.0) is None
    assert verdict.without_fix_s(fixes, 4.0, 20.0) == pytest.approx(3.1 + 3.1, abs=0.01)


def test_a_position_is_wrong_beyond_four_times_its_accuracy() -> None:
    fixes = [ReceivedFix(1.0, error_m, 2.0) for error_m in (7.9, 8.1, 100.0)]
    assert [fix.error_m for fix in verdict.wrong_fixes(fixes)] == [8.1, 100.0]
    assert verdict.wrong_fixes([ReceivedFix(1.0, 0.1, None)]), "a position without an accuracy is a wrong one"


def test_what_the_record_lacks_is_the_longest_time_received_and_not_recorded() -> None:
    received = ticks(0.0, 10.0)
    recorded = [t + 0.03 for t in received if not 3.0 <= t <= 5.0]
    assert verdict.not_recorded_s(received, recorded) == pytest.approx(2.0, abs=0.21)
    assert verdict.not_recorded_s(received, received) == 0.0


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        ({"back_s": 1.0}, "ok"),
        ({"back_s": None}, "no fix afterwards"),
        ({"back_s": 1.0, "wrong": 3}, "3 wrong positions"),
        ({"back_s": 1.0, "not_recorded_s": 1.4}, "ok"),
        ({"back_s": 1.0, "not_recorded_s": 1.6}, "1.6 s not recorded"),
    ],
)
def test_a_verdict_names_the_promises_that_were_broken(outcome: dict[str, float], expected: str) -> None:
    found = Outcome(fault="f", phase="p", verdict="", **outcome)  # type: ignore[arg-type]
    assert verdict.text_of(found, fix_expected=True, record_expected=True) == expected


def test_a_fix_is_not_expected_after_a_fault_in_the_landing_and_no_record_where_its_process_was_hit() -> None:
    landed = Outcome(fault="f", phase="p", verdict="", back_s=None, not_recorded_s=9.0)
    assert verdict.text_of(landed, fix_expected=False, record_expected=False) == "ok"


def test_the_faults_have_names_of_their_own() -> None:
    assert len({fault.name for fault in MATRIX}) == len(MATRIX) > 40


def test_an_interrupted_matrix_goes_on_where_it_was(tmp_path: Path) -> None:
    results = Results(tmp_path / "results.json")
    assert not results.has(MATRIX[1], Phase.CRUISE)
    results.add(Outcome(fault=MATRIX[1].name, phase=Phase.CRUISE, verdict="ok", silence_s=2.5, back_s=4.0))
    results.add(Outcome(fault=MATRIX[1].name, phase=Phase.CRUISE, verdict="ok", silence_s=1.5, back_s=3.0, fixes=7))
    again = Results(tmp_path / "results.json")
    assert again.has(MATRIX[1], Phase.CRUISE) and not again.has(MATRIX[1], Phase.TURN)
    assert [outcome.silence_s for outcome in again.outcomes] == [1.5]


def test_commands_that_fly_parts_of_one_matrix_keep_each_others_outcomes(tmp_path: Path) -> None:
    one, other = Results(tmp_path / "results.json"), Results(tmp_path / "results.json")
    one.add(Outcome(fault=MATRIX[1].name, phase=Phase.CRUISE, verdict="ok"))
    other.add(Outcome(fault=MATRIX[1].name, phase=Phase.TURN, verdict="ok"))
    assert [o.phase for o in Results(tmp_path / "results.json").outcomes] == [Phase.CRUISE, Phase.TURN]
    assert other.has(MATRIX[1], Phase.CRUISE)


def test_results_that_cannot_be_read_or_written_are_named(tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text("[{")
    with pytest.raises(SourceError, match="no results of chaos"):
        Results(tmp_path / "results.json")
    with pytest.raises(OutputError, match="cannot be written"):
        Results(tmp_path / "gone" / "results.json").add(Outcome(fault="none", phase=Phase.CRUISE, verdict="ok"))


def test_the_table_of_a_page_is_replaced_and_names_broken_promises(tmp_path: Path) -> None:
    page = tmp_path / "faults.md"
    page.write_text("before\n<!-- table: chaos -->\nold\n<!-- end -->\nafter\n")
    good = Outcome(fault="none", phase=Phase.CRUISE, verdict="ok", silence_s=0.1, back_s=0.0, fixes=90)
    bad = Outcome(
        fault="none", phase=Phase.TURN, verdict="2 wrong positions", silence_s=4.0, back_s=9.0, fixes=10, wrong=2
    )
    write_table(page, [good, bad])
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert "| fault | cruise | turn |\n|---|---|---|\n" in text
    assert "| none | | 4.0/9.0 **2 wrong positions** |" in text
    assert table([good, bad]).endswith("\n\n2 cells with 100 positions, 2 of them wrong.")


def test_faults_without_an_effect_are_named_below_the_table() -> None:
    def outcome(fault: str, silence_s: float, back_s: float | None, phase: Phase = Phase.CRUISE) -> Outcome:
        return Outcome(fault=fault, phase=phase, verdict="ok", silence_s=silence_s, back_s=back_s)

    quiet = [outcome("link: slow", 0.24, 0.0), outcome("link: leak", 0.1, 0.0), outcome("disk: full", 0.1, 0.0)]
    text = table(
        [*quiet, outcome("link: silent", 6.0, 0.0), outcome("none", 0.1, 0.1), outcome("disk: slow", 0.1, None)]
    )
    assert [row for row in text.splitlines() if row.startswith("| ")] == [
        "| fault | cruise |", "| none | 0.1/0.1 |", "| link: silent | 6.0/0.0 |", "| disk: slow | 0.1/- |",
    ]  # fmt: skip
    assert "\n\nWithout effect: link: slow, leak; disk: full.\nNot flown: " in text
    dark = table([outcome("none", 0.1, 1.5, Phase.DARK), outcome("disk: full", 0.1, 1.6, Phase.DARK)])
    assert "| disk: full | 0.1/1.6 |" in dark and "Without effect: none." in dark


def test_the_sum_of_a_table_has_the_worst_error_and_the_load_of_the_computer() -> None:
    cells = [
        Outcome(fault="none", phase=phase, verdict="ok", silence_s=0.1, fixes=9, worst_sigmas=sigmas, load=load)
        for phase, sigmas, load in ((Phase.CRUISE, 1.5, 0.5), (Phase.TURN, 3.25, 2.0), (Phase.DARK, None, 1.0))
    ]
    expected = "3 cells with 27 positions, 0 of them wrong; the worst error is 3.2 times its horiz_accuracy; "
    assert table(cells).endswith(expected + "load average per core 1.0 in the median, at most 2.0.")


def test_a_cell_whose_flight_failed_before_the_fault_is_none_of_the_table_and_is_flown_again(tmp_path: Path) -> None:
    failed = Outcome(fault="none", phase=Phase.CRUISE, verdict=verdict.NO_FIX, silence_s=0.1, fixes=3)
    assert "| none |" not in table([failed]) and "Not flown: none; " in table([failed])
    assert "0 cells with 0 positions" in table([failed])
    results = Results(tmp_path / "results.json")
    results.add(failed)
    assert not results.has(MATRIX[0], Phase.CRUISE)


def jpeg() -> bytes:
    image = np.random.default_rng(1).integers(40, 120, (90, 160, 3), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def decoded(data: bytes) -> np.ndarray | None:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def copter(t_s: float) -> PeerState:
    """Climbs to AGL_M in 50 s, flies straight to 80 s, turns by 90 degrees in 3 s, and lands from 120 s on."""
    agl_m = AGL_M * min(1.0, t_s / 50.0, max(0.0, (170.0 - t_s) / 50.0))
    yaw_rad = np.pi / 2 * min(1.0, max(0.0, (t_s - 80.0) / 3.0))
    return PeerState(48.0, 11.0, agl_m, agl_m, float(yaw_rad), 0.0, 0.0, 0.0, 0.0, 0.0)


def test_the_phases_of_a_flight_are_found_by_height_and_heading() -> None:
    found = phases(copter, 170.0)
    assert 80.0 <= found[Phase.TURN] <= 83.0
    assert found[Phase.LANDING] == pytest.approx(122.5, abs=0.5), "95 % of the height"
    assert 60.0 < found[Phase.CRUISE] < 110.0 and abs(found[Phase.CRUISE] - 81.5) > 5.0


class KeptStream(FrameStream):
    """A stream that keeps what is pushed."""

    def __init__(self) -> None:
        super().__init__()
        self.pushed: list[tuple[bytes, int]] = []

    def push_jpeg(self, jpeg: bytes, t_ns: int) -> None:
        self.pushed.append((jpeg, t_ns))


def test_each_image_is_stamped_with_its_own_time_whatever_the_phase_of_the_flight() -> None:
    began_s = time.monotonic() - 0.2  # the images of the flight exist at 0, 0.5, 1 s ...
    with (
        KeptStream() as stream,
        StreamedCamera(stream, lambda t_s: f"{t_s:.3f}".encode(), lambda: time.monotonic() - began_s),
    ):
        time.sleep(1.2)
    assert len(stream.pushed) >= 2
    for image, t_ns in stream.pushed:
        assert t_ns / 1e9 - began_s == pytest.approx(float(image), abs=0.002)
        assert float(image) * 2.0 == round(float(image) * 2.0)


@pytest.mark.real_time
def test_the_live_camera_shows_what_its_fault_says() -> None:
    good, black, white, blurred, small, torn = (
        jpeg(),
        *(
            sent(f"camera: {name}")[-1][0]
            for name in ("black", "overexposed", "defocused", "wrong resolution", "no JPEG")
        ),
    )
    images = [decoded(data) for data in (good, black, white, blurred, small)]
    assert all(image is not None for image in images)
    assert images[1].max() == 0 and np.median(images[2]) == 255 and images[4].shape == (45, 80, 3)  # type: ignore[union-attr]
    assert images[3].std() < 0.4 * images[0].std()  # type: ignore[union-attr]
    assert decoded(torn) is None
    assert not sent("camera: unplugged")
    assert {data for data, _ in sent("none")} == {good}, "without a fault the bytes of the flight themselves"


@pytest.mark.real_time
def test_the_live_camera_sends_other_times_and_each_image_ten_times() -> None:
    for name, off_s in (("camera: stamps 5 s ahead", 5.0), ("camera: stamps 3 s late", -3.0)):
        now_ns = time.monotonic_ns()
        assert (sent(name)[0][1] - now_ns) / 1e9 == pytest.approx(off_s, abs=0.8), name
    stamps = [t_ns for _, t_ns in sent("camera: each image ten times")]
    assert len(stamps) > 10 and len(set(stamps)) <= len(stamps) / 5


def sent(name: str) -> list[tuple[bytes, int]]:
    """Images and stamps of 0.25 s of a camera of 20 Hz with the fault."""
    began_s = time.monotonic()
    with (
        KeptStream() as stream,
        StreamedCamera(stream, lambda _t_s: jpeg(), lambda: time.monotonic() - began_s, 20.0) as camera,
    ):
        camera.edit = FAULTS[name].of_camera(Span(0.0, 1e9, name))
        time.sleep(0.1)
        stream.pushed.clear()
        time.sleep(0.25)
        return list(stream.pushed)


def test_a_campaign_that_lacks_what_a_fault_needs_says_so_and_names_one_that_has_it() -> None:
    with pytest.raises(UsageError, match=r"'disk: full': the fault needs .* fly it by terrafix chaos --fault$"):
        check_flown_by("terrafix montecarlo --fault", FAULTS["disk: full"])
    with pytest.raises(UsageError, match=r"needs images, .* terrafix accept --scenario or terrafix chaos --fault$"):
        check_flown_by("terrafix montecarlo --fault", FAULTS["half the picture stands still"])
    for fault in FAULTS.values():
        able = [command for command in CAMPAIGNS if not lacking(command, fault)]
        assert able, f"nothing can fly '{fault.name}'"
        assert fault.process is None or able == ["terrafix chaos --fault"]


class HeldInTheAir:
    """The part of the rig that a cell uses, with a fix 2 m off each 0.1 s."""

    def __init__(self) -> None:
        self.began_s, self.scene = time.monotonic() - 10.0, ChaosScene(Path(), [], copter, {}, 0.0)
        self.camera, self.peer, self.edits = self, self, list[tuple[str, str]]()
        self.received_s: list[float] = []
        self.pushed_s = [self.began_s + 0.5 * k for k in range(100)]

    def __setattr__(self, name: str, value: object) -> None:
        if name == "edit":
            self.edits.append(("camera", "true" if value is unchanged else "edited"))
        object.__setattr__(self, name, value)

    def edit_telemetry(self, edit: Edit) -> None:
        self.edits.append(("telemetry", "true" if edit is unchanged else "edited"))

    def take_off(self) -> None: ...

    def check(self) -> None: ...

    def texts(self) -> list[tuple[float, str]]:
        return [(time.monotonic(), "picture frozen")]

    def fixes(self) -> list[ReceivedFix]:
        count = round(10.0 * (time.monotonic() - self.began_s))
        return [ReceivedFix(self.began_s + 0.1 * k, 2.0, 1.5) for k in range(count)]


@pytest.mark.real_time
@pytest.mark.parametrize(("name", "hit"), [("camera: frozen", "camera"), ("forged heading", "telemetry")])
def test_a_cell_hands_each_part_of_a_fault_to_its_own_and_takes_it_back(
    name: str, hit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "STEADY_S", 0.6)
    rig, fault = HeldInTheAir(), replace(FAULTS[name], lasts_s=0.3)
    outcome, track = run._fly(rig, fault, Phase.CRUISE, 0.5)  # type: ignore[arg-type]
    assert (hit, "edited") in rig.edits and [e for e in rig.edits if e[1] == "edited"] == [(hit, "edited")]
    assert rig.edits[-2:] == [("camera", "true"), ("telemetry", "true")]
    assert track.texts and outcome.texts[0].endswith(" s: picture frozen")
    assert outcome.fixes > 90 and outcome.wrong == 0 and outcome.back_s == 0.0
    assert outcome.criteria["late sure over 20 m"] == "0" and outcome.criteria["right again"].endswith("s")


def test_a_false_start_and_camera_are_in_the_configuration_that_the_processes_read(tmp_path: Path) -> None:
    (tmp_path / "map").write_bytes(b"map")
    scene = ChaosScene(tmp_path / "map", [], copter, {}, 0.0)
    for name, has_start, focal in (("focal length doubled", True, 2.0), ("start unknown", False, 1.0)):
        rig = Rig(scene, tmp_path / name, 60.0, seed=1, origin=FAULTS[name].origin or unchanged_origin)
        try:
            rig._write_config(14550)
        finally:
            rig.stream.close()
        found = tomllib.loads((tmp_path / name / "terrafix.toml").read_text())
        camera = tomllib.loads((tmp_path / name / "camera.toml").read_text())["camera"]
        assert ("start" in found["source"]) == has_start and camera["fx"] == focal * scene.camera.fx
