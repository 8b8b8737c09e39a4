"""The soak test: slopes, and what counts as growth."""

from pathlib import Path

import numpy as np
import pytest

from flight_records import gps_input, live_messages, write_record
from terrafix_lab.bench.soak import Samples, grows, growth, output_of, slope_per_h


def samples(mb_per_h: float, *, files: int = 0, away: bool = False) -> Samples:
    """Two hours of one process of 100 MB with a scatter of 0.2 MB, and of one that does not grow."""
    t_s = np.arange(0.0, 7200.0, 10.0)
    noise = np.random.default_rng(1).normal(0.0, 0.2, (2, len(t_s)))
    memory = 100.0 + mb_per_h * t_s / 3600.0 + noise[0]
    if away:
        memory[300:305] = np.nan
    opened = [20 + (files if t > 5400.0 else 0) for t in t_s.tolist()]
    return Samples(
        t_s.tolist(),
        {"vision": memory.tolist(), "link": (50.0 + noise[1]).tolist()},
        {"vision": opened, "link": [9] * len(opened)},
    )


def test_the_slope_is_that_of_the_line_with_its_uncertainty() -> None:
    t_s = np.arange(0.0, 3600.0, 10.0)
    slope, sigma = slope_per_h(t_s, 5.0 + 3.0 * t_s / 3600.0 + np.random.default_rng(2).normal(0.0, 0.1, len(t_s)))
    assert slope == pytest.approx(3.0, abs=4.0 * sigma) and 0.01 < sigma < 0.03
    assert slope_per_h(t_s[:2], t_s[:2])[1] == float("inf")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (samples(0.0), []),
        (samples(1.0), []),  # 0.7 % of 150 MB
        (samples(3.0), ["memory by 1.9 % an hour"]),
        (samples(0.0, away=True), []),
        (samples(0.0, files=7), ["open files of vision by 7"]),
    ],
)
def test_growth_is_judged_by_all_processes_together_and_by_open_files(given: Samples, expected: list[str]) -> None:
    assert grows(growth(given)) == expected


def test_caches_that_fill_in_the_first_half_are_no_growth_and_what_grows_in_the_second_is() -> None:
    filling, late = samples(0.0), samples(0.0)
    t_s = np.array(filling.t_s)
    filling.memory_mb["vision"] = (np.array(filling.memory_mb["vision"]) + np.minimum(t_s / 60.0, 59.0)).tolist()
    late.memory_mb["vision"] = (np.array(late.memory_mb["vision"]) + np.maximum(t_s - 3600.0, 0.0) / 900.0).tolist()
    assert grows(growth(filling)) == []
    assert grows(growth(late)) == ["memory by 2.5 % an hour"]


def test_the_output_of_a_record_has_its_rate_and_how_often_the_fix_was_lost(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [*live_messages(20), gps_input(11 * 10**9, 1), gps_input(12 * 10**9)])
    found = output_of(tmp_path / "flight.mcap")
    assert len(found["delay_by_minute_ms"]) == 1 and found["taken_per_s"] == pytest.approx(20 / 9.0)
    assert found["frames_per_s"] == pytest.approx(19 / 9.0) and found["changes_per_min"] == pytest.approx(10.0)
