"""GNSS model: noise and delay in the open, and the effects of outage, jamming and spoofing."""

import math
from pathlib import Path

import numpy as np
import pytest

from terrafix.core.errors import SourceError
from terrafix_lab.sim.interfaces import GnssFix
from terrafix_lab.sim.sensors.gnss import DELAY_S, Gnss
from terrafix_lab.sim.sensors.gnss_events import AnyEvent, Drag, Jam, Jump, Outage, read_events
from vehicle_missions import PLACE
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
    """Error east, north against the position at the time of measurement."""
    return np.array(PLACE.to_local(fix.lat_deg, fix.lon_deg)) - (20.0 * (t_s - DELAY_S), 0.0)


def test_in_the_open_fixes_have_the_reported_accuracy_and_delay() -> None:
    received = fixes(120.0)
    assert np.diff([t for t, _ in received]) == pytest.approx(0.2, abs=0.021)
    assert received[0][0] == pytest.approx(DELAY_S, abs=STEP_S)
    assert all(f.fix_type == 3 and f.satellites >= 10 and f.hdop < 1.5 for _, f in received)
    errors = np.array([error_m(t, f) for t, f in received])
    assert np.hypot(*errors.T).max() < 4 * received[0][1].horizontal_m
    speeds = np.array([f.velocity_ned_mps for _, f in received]) - (0.0, 20.0, 0.0)
    assert 0.02 < speeds.std() < received[0][1].speed_mps
    many = [error_m(t, f)[0] for seed in range(60) for t, f in fixes(0.3, seed=seed)]
    assert 0.6 < np.std(many) < 1.6  # the slow error differs between flights


def test_an_outage_removes_the_fix_at_once_and_ends() -> None:
    received = fixes(30.0, Outage(start_s=10.0, end_s=20.0))
    for t, fix in received:
        gone = 10.0 + DELAY_S < t + 1e-3 < 20.0 + DELAY_S
        assert (fix.fix_type < 3) == gone, t
    assert {f.satellites for _, f in received if f.fix_type < 3} == {0}


def test_jamming_degrades_accuracies_before_the_fix_is_lost() -> None:
    received = fixes(30.0, Jam(start_s=10.0, fade_s=8.0))
    fading = [(t, f) for t, f in received if t > 10.2 and f.fix_type == 3]
    assert 2.0 < fading[-1][0] - 10.0 < 8.5
    satellites, accuracy = [f.satellites for _, f in fading], [f.horizontal_m for _, f in fading]
    assert satellites == sorted(satellites, reverse=True) and satellites[-1] <= 7
    assert accuracy == sorted(accuracy) and accuracy[-1] > 5 * accuracy[0]
    assert all(f.fix_type < 3 for t, f in received if t > 18.2)


def test_a_jump_moves_the_next_fix_without_other_signs() -> None:
    received = fixes(20.0, Jump(start_s=10.0, east_m=300.0, north_m=-40.0))
    before = [error_m(t, f) for t, f in received if t < 10.1]
    after = [error_m(t, f) for t, f in received if t > 10.2]
    assert np.abs(before).max() < 6.0
    assert np.mean(after, axis=0) == pytest.approx([300.0, -40.0], abs=5.0)
    assert max(f.horizontal_m for _, f in received) < 2.0


def test_a_drag_starts_at_the_truth_with_a_consistent_velocity() -> None:
    received = fixes(60.0, Drag(start_s=10.0, east_mps=0.0, north_mps=3.0))
    north = {round(t, 2): (error_m(t, f)[1], f.velocity_ned_mps[0]) for t, f in received}
    times = np.array([t for t in north if t > 10.2])
    walked = np.array([north[t][0] for t in times])
    slope, start = np.polyfit(times - DELAY_S - 10.0, walked, 1)
    assert slope == pytest.approx(3.0, abs=0.1) and abs(start) < 4.0
    assert np.mean([north[t][1] for t in times]) == pytest.approx(3.0, abs=0.1)


def test_events_are_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "events.toml"
    path.write_text(
        '[[gnss]]\nkind = "jam"\nstart_s = 60\nend_s = 90.5\n[[gnss]]\nkind = "drag"\nstart_s = 100\nnorth_mps = 1.5\n'
    )
    assert read_events(path) == (Jam(start_s=60.0, end_s=90.5), Drag(start_s=100.0, north_mps=1.5))


@pytest.mark.parametrize(
    ("text", "reason"),
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
def test_a_wrong_file_is_one_clear_line(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "events.toml"
    path.write_text(text)
    with pytest.raises(SourceError, match=reason) as error:
        read_events(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_missing_event_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="--events"):
        read_events(tmp_path / "nope.toml")


def test_the_delay_fits_in_the_buffer_of_an_autopilot() -> None:
    assert 0.0 < DELAY_S < 0.25 and math.isfinite(DELAY_S)  # ArduPilot buffers 250 ms
