"""A real flight with a frame from 350 m away in it, and five frames missing in a turn: AC-3 and AC-4 on real ground."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from terrafix.messages import SearchStep
from terrafix_tools.accept import faults, measures
from terrafix_tools.accept.evidence import gather
from terrafix_tools.accept.flight import open_flight
from terrafix_tools.accept.judged import Marks
from terrafix_tools.replay import replay

FRAMES = 85
WRONG_BEFORE, TURN = 40, range(56, 61)  # frames of village-1: on a straight leg; within a turn of 65 degrees
FAR_M = 350.0


@pytest.mark.slow
def test_a_far_frame_is_refused_and_a_gap_in_a_turn_is_survived(
    data_set: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = data_set("flights/village-1")
    data_set("maps/village-2014-01.tif")
    flight = open_flight(str(folder), None, None, folder / "truth.csv", None)
    track_m = flight.track_m()
    away_m = np.hypot(*(track_m - track_m[WRONG_BEFORE]).T)
    far = int(np.argmax(away_m >= FAR_M))
    assert away_m[far] >= FAR_M
    before = flight.stops[WRONG_BEFORE].file
    wrong = faults.foreign_frames({before: flight.picture(far)})
    gap = faults.without(frozenset(flight.stops[i].file for i in TURN))
    replay(
        folder,
        None,
        tmp_path,
        altered=lambda source: faults.AlteredSource(
            source, lambda shots: gap(wrong(shots)), frames=FRAMES, origin=faults.same_origin
        ),
    )
    marks = Marks(wrong_files=frozenset({faults.foreign_name(before)}))
    seen = gather(tmp_path, flight.truth, marks)
    assert len(seen.frames) == FRAMES + 1 - len(TURN)
    assert measures.wrong_rejected(seen).value == 1.0
    after_m = measures.error_after_wrong(seen).value
    assert after_m is not None and after_m < 50.0
    assert seen.metrics["within_50m"] == 1.0 and seen.metrics["within_20m"] >= 0.8
    assert seen.metrics["false_fixes"] == 0 and seen.metrics["ellipse95_coverage"] >= 0.9
    assert seen.metrics["odometry_rate"] > 0.95  # the gap costs no fragment: what is left still overlaps
    assert {frame.match.step for frame in seen.frames if frame.match} <= {SearchStep.NORMAL, SearchStep.SKIP}
