"""Delay of the first GPS_INPUT that contains the map match of a frame."""

import os
from pathlib import Path

import pytest
from rich.console import Console

from flight_records import estimate, gps_input
from terrafix.core.errors import OutputError, UsageError
from terrafix.messages import MapMatch, Verdict
from terrafix_tools.bench.latency import AnchoredOutput, fly_at, show, use_cores


def match(t_ns: int, verdict: Verdict = Verdict.ACCEPTED) -> MapMatch:
    return MapMatch(t_ns=t_ns, frame_id=t_ns, verdict=verdict, matcher="gradient")


def test_the_delay_ends_with_the_first_gps_input_after_the_estimate_that_has_the_match() -> None:
    anchored = AnchoredOutput()
    for received_ns, message in (
        (150, match(100)),
        (160, gps_input(160)),  # of the estimate before the match
        (170, estimate(140, 0.0, 0.0)),  # of a newer frame, with the match
        (180, gps_input(180)),
        (190, gps_input(190)),
        (210, match(200, Verdict.AMBIGUOUS)),
        (220, estimate(200, 0.0, 0.0)),
        (230, gps_input(230)),
    ):
        anchored.take(received_ns, message)
    assert anchored.delays_ns == [80]


def test_an_existing_folder_is_not_written_to(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="exists"):
        fly_at(2.0, tmp_path, seed=1, duration_s=10.0, console=Console())


def test_more_cores_than_there_are_is_an_error() -> None:
    with pytest.raises(UsageError, match="--cores 0"):
        use_cores(0)
    with pytest.raises(UsageError, match="choose 1 to"):
        use_cores(len(os.sched_getaffinity(0)) + 1)


def test_the_table_has_a_dash_for_a_stage_without_messages() -> None:
    console = Console(width=170, record=True)
    row = {"frames": 4, "dropped": 1, "matched": 0, "delay_ms": {"frame": [20, 30, 31]}}
    stages = ("odometry", "prediction", "map match", "estimate", "GPS_INPUT", "anchored GPS_INPUT")
    row["delay_ms"] |= {stage: [] for stage in stages}  # type: ignore[operator]
    show({2.0: row}, console)
    text = console.export_text()
    assert "2 Hz" in text and "20, 30, 31" in text and "-" in text
