"""`terrafix status`: facts from the messages of the bus, and the screen."""

from typing import Any

import pytest
from rich.console import Console

from flight_records import estimate, gps_input
from terrafix import messages as m
from terrafix_tools.status.facts import facts
from terrafix_tools.status.line import line_of
from terrafix_tools.status.processes import ProcessState
from terrafix_tools.status.screen import screen
from terrafix_tools.status.state import KINDS, LINES, Status

S = 1_000_000_000  # ns
USES_POSITION, NO_POSITION = 16, 1  # EKF_STATUS_FLAGS


def after(seconds: float, *received: tuple[float, m.Message]) -> dict[str, Any]:
    """Facts ``seconds`` after the beginning, with messages at their times of reception [s]."""
    status = Status(0)
    for at_s, message in received:
        status.take(round(at_s * S), message)
    states = [ProcessState("vision", "running", 0.04), ProcessState("anchor", "stuck", 95.0)]
    return facts(status, states, round(seconds * S))


def text_of(found: dict[str, Any]) -> str:
    console = Console(width=150, record=True, force_terminal=False)
    console.print(screen(found, "Terrafix"))
    return console.export_text()


def link_status() -> m.LinkStatus:
    return m.LinkStatus(
        t_ns=0, connected=True, autopilot="ardupilot", sysid=1, sent=10, received=20, bad=0, time_offset_ms=1.0
    )


def frame(i: int) -> m.Frame:
    return m.Frame(t_ns=i, frame_id=i, file="", width=64, height=48)


def test_a_3d_fix_has_its_accuracy_position_and_source() -> None:
    found = after(1.0, (0.5, estimate(3, 10.0, 20.0, sigma_m=4.0)), (0.9, gps_input(S)))
    position = found["position"]
    assert (position["fix"], position["reason"], position["accuracy_m"]) == ("3D", "", 5.0)
    assert position["radius_95_m"] == 9.8  # 4 m times the square root of 5.991
    assert position["source"] == "satellite_anchored" and position["agl_m"] == 100.0 and position["speed_mps"] == 10.0
    assert "3D fix, accuracy 5.0 m" in text_of(found) and "map match" in text_of(found)


@pytest.mark.parametrize("slow", [False, True])
def test_the_rate_at_which_frames_are_taken_is_a_fact(slow: bool) -> None:
    rate = m.FrameRate(t_ns=0, offered_hz=2.0, taken_hz=1.33, every=1, computer_too_slow=slow)
    found = after(1.0, (0.5, rate))
    assert found["frame_rate"]["taken_hz"] == 1.33 and after(1.0)["frame_rate"] is None
    assert "running at 1.3 of 2 Hz" in text_of(found) and ("the computer is too slow" in text_of(found)) is slow


def test_what_the_source_says_of_itself_is_a_fact() -> None:
    said = m.SourceFacts(t_ns=0, facts=(m.Fact("clock", "by arrival"),))
    assert after(1.0, (0.5, said))["source"] == [{"topic": "clock", "text": "by arrival"}]
    assert after(1.0)["source"] is None


def test_without_a_fix_the_reason_is_that_of_gps_input() -> None:
    found = after(1.0, (0.9, gps_input(S, fix_type=1)))
    assert (found["position"]["fix"], found["position"]["reason"]) == ("none", "no estimate yet")
    assert found["position"]["accuracy_m"] is None
    assert "no fix: no estimate yet" in text_of(found)


def test_gps_input_that_is_older_than_two_seconds_is_no_fix() -> None:
    assert after(2.9, (1.0, gps_input(S)))["position"]["fix"] == "3D"
    silent = after(3.1, (1.0, gps_input(S)))["position"]
    assert (silent["fix"], silent["reason"]) == ("none", "no GPS_INPUT")


def test_rates_are_those_of_the_last_five_seconds() -> None:
    frames = [(i / 10, frame(i)) for i in range(200)]  # 10 Hz for 20 s
    assert after(20.0, *frames)["rates_hz"]["Frame"] == pytest.approx(10.0, abs=0.2)
    assert after(24.0, *frames)["rates_hz"]["Frame"] == pytest.approx(2.0, abs=0.2)
    assert after(30.0, *frames)["rates_hz"]["Frame"] == 0.0
    assert after(2.0, *frames[:20])["rates_hz"]["Frame"] == 10.0


def test_the_delay_is_the_median_from_the_exposure_to_the_estimate() -> None:
    estimates = [(1.0 + i / 10, estimate(i, 0.0, 0.0)) for i in range(3)]
    assert after(2.0, *estimates)["delay_ms"] == 120.0
    assert after(10.0, *estimates, (9.0, frame(1)))["delay_ms"] is None


def test_the_share_of_accepted_map_matches() -> None:
    verdicts = [m.Verdict.ACCEPTED, m.Verdict.AMBIGUOUS, m.Verdict.ACCEPTED, m.Verdict.ACCEPTED]
    matches = [(1.0, m.MapMatch(t_ns=i, frame_id=i, verdict=v, matcher="gradient")) for i, v in enumerate(verdicts)]
    assert after(2.0, *matches)["map_matches_accepted"] == 0.75
    assert after(2.0)["map_matches_accepted"] is None


def test_restarts_losses_and_loads_are_counted_by_process() -> None:
    died = m.ProcessEvent(t_ns=0, process="vision", event="died", detail="killed by signal 9")
    restarted = m.ProcessEvent(t_ns=0, process="vision", event="restarted", detail="pid 7")
    thermal = m.ThermalReading(t_ns=0, zones=[], throttling=[], disk_free_mb=1, cpu_load={"all": 0.5, "vision": 0.25})
    lost = m.Dropped(t_ns=0, process="anchor", message="Prediction", count=4)
    found = after(
        2.0, (0.1, died), (0.2, restarted), (0.3, died), (0.4, restarted), (0.5, thermal), (1.0, lost), (1.1, lost)
    )
    vision, anchor = found["processes"]
    assert (vision["restarts"], vision["load"], vision["last_event"]) == (2, 0.25, "restarted: pid 7")
    assert (anchor["restarts"], anchor["load"], anchor["state"]) == (0, None, "stuck")
    assert found["dropped"] == {"anchor: Prediction": 8} and found["computer"]["load"] == 0.5
    text = text_of(found)
    assert "stuck" in text and "anchor: Prediction 8" in text and "25 %" in text


@pytest.mark.parametrize(("flags", "uses"), [(USES_POSITION, True), (NO_POSITION, False)])
def test_the_autopilot_its_ekf_and_the_judge_of_its_receivers(flags: int, uses: bool) -> None:
    spoofed = m.GnssVerdict(
        t_ns=0, receiver=0, state=m.GnssState.SPOOFED, distance_m=212.4, sigmas=9.0, reason="212 m off"
    )
    ekf = m.EkfStatus(t_ns=0, flags=flags, position_ratio=0.25, velocity_ratio=0.1)
    found = after(1.0, (0.5, link_status()), (0.6, ekf), (0.7, spoofed))["autopilot"]
    assert found["connected"] and found["uses_position"] is uses and found["position_test_ratio"] == 0.25
    assert found["gnss"] == {"0": {"state": "spoofed", "distance_m": 212.0, "why": "212 m off"}}
    assert after(4.0, (0.5, link_status()))["autopilot"]["connected"] is False


def test_the_newest_rejections_and_texts_come_first_and_old_ones_go() -> None:
    verdicts = [
        m.MeasurementVerdict(t_ns=i, frame_id=i, measurement="map", verdict=m.Verdict.INNOVATION, detail=f"{i} m")
        for i in range(LINES + 3)
    ]
    accepted = m.MeasurementVerdict(t_ns=9, frame_id=9, measurement="map", verdict=m.Verdict.ACCEPTED)
    said = m.StatusText(t_ns=0, severity=4, text="position lost")
    found = after(1.0, *((0.1, v) for v in verdicts), (0.2, accepted), (0.3, said))
    assert found["rejected"] == [f"map innovation: {i} m" for i in range(LINES + 2, 2, -1)]
    assert found["texts"] == ["position lost"]
    assert "position lost" in text_of(found)


def test_heat_is_shown_with_its_band() -> None:
    hot = m.Health(
        t_ns=0, band=m.ThermalBand.HOT, temperature_c=84.2, throttled=True, disk_free_mb=900, cause="cpu", power_w=14.7
    )
    found = after(1.0, (0.5, hot))
    assert found["computer"] | {"load": None} == {
        "band": "hot",
        "temperature_c": 84.2,
        "throttled": True,
        "power_w": 14.7,
        "disk_free_mb": 900,
        "load": None,
    }
    assert "hot, 84.2 °C" in text_of(found)


def test_before_the_first_message_nothing_is_known_and_the_screen_says_so() -> None:
    found = after(0.0)
    assert found["position"]["fix"] == "none" and found["autopilot"]["connected"] is False
    assert "no fix: no GPS_INPUT" in text_of(found) and "no autopilot" in text_of(found)


def test_all_types_that_are_read_are_taken() -> None:
    assert len(set(KINDS)) == len(KINDS)
    status = Status(0)
    for _, message in ((0, frame(0)), (0, gps_input(0))):
        status.take(0, message)
    assert status.last(m.Frame) == frame(0) and status.last(m.Dropped) is None
    assert status.age_s(m.Frame, 3 * S) == 3.0 and status.age_s(m.Dropped, S) is None


def test_the_line_of_a_run_says_where_it_is_by_what_and_which_processes_are_down() -> None:
    found = after(1.0, (0.5, estimate(3, 10.0, 20.0, sigma_m=4.0)), (0.9, gps_input(S)), (0.9, link_status()))
    line = line_of(found)
    assert line.startswith("3D fix to 5.0 m, ") and "100 m above ground" in line
    assert "by map match, 95 % within 9.8 m" in line
    assert line.endswith("ardupilot connected, without anchor")
    lost = line_of(
        after(1.0, (0.9, gps_input(S, fix_type=1)), (0.9, m.SearchState(t_ns=0, step=m.SearchStep.WHOLE_MAP)))
    )
    assert lost == "no fix: no estimate yet, search: whole_map, no autopilot, without anchor"
