"""GNSS: noise and delay in the open, and what outage, jamming and spoofing make of it, when they are told to."""

import math
from pathlib import Path

import numpy as np
import pytest

from flown import PLACE
from terrafix.core.errors import SourceError
from terrafix_tools.sim.interfaces import GnssFix
from terrafix_tools.sim.sensors.gnss import DELAY_S, Gnss
from terrafix_tools.sim.sensors.gnss_events import AnyEvent, Drag, Jam, Jump, Outage, read_events
from vehicle_state import STEP_S, state


def fixes(seconds: float, *events: AnyEvent, seed: int = 1) -> list[tuple[float, GnssFix]]:
    gnss = Gnss(PLACE, seed=seed, events=events)
    made = []
    for i in range(round(seconds / STEP_S)):
        now = state(i * STEP_S)
        fix = gnss.read(now)
        if fix is not None:
            made.append((now.t_s, fix))
    return made


def error_m(t_s: float, fix: GnssFix) -> np.ndarray:
    """East, north against where the vehicle was when the fix was measured."""
    return np.array(PLACE.to_local(fix.lat_deg, fix.lon_deg)) - (20.0 * (t_s - DELAY_S), 0.0)


def test_in_the_open_it_is_as_good_as_it_claims_and_late() -> None:
    told = fixes(120.0)
    assert np.diff([t for t, _ in told]) == pytest.approx(0.2, abs=0.021)
    assert told[0][0] == pytest.approx(DELAY_S, abs=STEP_S)
    assert all(f.fix_type == 3 and f.satellites >= 10 and f.hdop < 1.5 for _, f in told)
    errors = np.array([error_m(t, f) for t, f in told])
    assert np.hypot(*errors.T).max() < 4 * told[0][1].horizontal_m
    speeds = np.array([f.velocity_ned_mps for _, f in told]) - (0.0, 20.0, 0.0)
    assert 0.02 < speeds.std() < told[0][1].speed_mps
    many = [error_m(t, f)[0] for seed in range(60) for t, f in fixes(0.3, seed=seed)]
    assert 0.6 < np.std(many) < 1.6  # other days, other errors


def test_an_outage_is_silence_of_position_at_once_and_ends() -> None:
    told = fixes(30.0, Outage(start_s=10.0, end_s=20.0))
    for t, fix in told:
        gone = 10.0 + DELAY_S < t + 1e-3 < 20.0 + DELAY_S
        assert (fix.fix_type < 3) == gone, t
    assert {f.satellites for _, f in told if f.fix_type < 3} == {0}


def test_jamming_fades_before_it_kills() -> None:
    told = fixes(30.0, Jam(start_s=10.0, fade_s=8.0))
    fading = [(t, f) for t, f in told if t > 10.2 and f.fix_type == 3]
    assert 2.0 < fading[-1][0] - 10.0 < 8.5
    satellites, accuracy = [f.satellites for _, f in fading], [f.horizontal_m for _, f in fading]
    assert satellites == sorted(satellites, reverse=True) and satellites[-1] <= 7
    assert accuracy == sorted(accuracy) and accuracy[-1] > 5 * accuracy[0]
    assert all(f.fix_type < 3 for t, f in told if t > 18.2)


def test_a_jump_moves_the_next_fix_and_says_nothing() -> None:
    told = fixes(20.0, Jump(start_s=10.0, east_m=300.0, north_m=-40.0))
    before = [error_m(t, f) for t, f in told if t < 10.1]
    after = [error_m(t, f) for t, f in told if t > 10.2]
    assert np.abs(before).max() < 6.0
    assert np.mean(after, axis=0) == pytest.approx([300.0, -40.0], abs=5.0)
    assert max(f.horizontal_m for _, f in told) < 2.0


def test_a_drag_begins_at_the_truth_and_its_velocity_agrees() -> None:
    told = fixes(60.0, Drag(start_s=10.0, east_mps=0.0, north_mps=3.0))
    north = {round(t, 2): (error_m(t, f)[1], f.velocity_ned_mps[0]) for t, f in told}
    times = np.array([t for t in north if t > 10.2])
    walked = np.array([north[t][0] for t in times])
    slope, start = np.polyfit(times - DELAY_S - 10.0, walked, 1)
    assert slope == pytest.approx(3.0, abs=0.1) and abs(start) < 4.0
    assert np.mean([north[t][1] for t in times]) == pytest.approx(3.0, abs=0.1)


def test_events_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "events.toml"
    path.write_text(
        '[[gnss]]\nkind = "jam"\nstart_s = 60\nend_s = 90.5\n[[gnss]]\nkind = "drag"\nstart_s = 100\nnorth_mps = 1.5\n'
    )
    assert read_events(path) == (Jam(start_s=60.0, end_s=90.5), Drag(start_s=100.0, north_mps=1.5))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[[gnss]]\nkind = "fog"\nstart_s = 1', "kinds are outage, jam, jump, drag"),
        ('[[gnss]]\nkind = "jam"', "start_s"),
        ('[[gnss]]\nkind = "jam"\nstart_s = -1', "start_s"),
        ('[[gnss]]\nkind = "jam"\nstart_s = 9\nend_s = 3', "before it starts"),
        ('[[gnss]]\nkind = "drag"\nstart_s = 9\neast_mps = nan', "nan or inf"),
        ('[[gnss]]\nkind = "jam"\nstart_s = 9\nfade = 3', "fade"),
        ("gnss = 3", "kinds are"),
        ("[[gnss", "TOML"),
    ],
)
def test_a_wrong_file_is_one_clear_line(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "events.toml"
    path.write_text(text)
    with pytest.raises(SourceError, match=said) as error:
        read_events(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_no_event_file_is_an_error_too(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="--events"):
        read_events(tmp_path / "nope.toml")


def test_delay_is_less_than_what_an_autopilot_can_hold() -> None:
    assert 0.0 < DELAY_S < 0.25 and math.isfinite(DELAY_S)  # ArduPilot buffers 250 ms
