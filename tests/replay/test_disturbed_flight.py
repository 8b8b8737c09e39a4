"""A recorded flight with a foreign frame from 350 m away, and with five frames missing in a turn (AC-3, AC-4)."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from terrafix.messages import SearchStep
from terrafix_lab.accept.flight import open_flight
from terrafix_lab.accept.measuring import measures
from terrafix_lab.accept.measuring.evidence import gather
from terrafix_lab.accept.measuring.results import Marks
from terrafix_lab.faults import edits
from terrafix_lab.faults.source import AlteredSource
from terrafix_tools.replay import replay

FRAMES = 85
INSERTED_BEFORE, TURN = 40, range(56, 61)  # frames of village-1: on a straight leg; in a turn of 65 degrees
FAR_M = 350.0


@pytest.mark.slow
def test_a_foreign_frame_is_rejected_and_a_gap_in_a_turn_is_bridged(
    data_set: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = data_set("flights/village-1")
    data_set("maps/village-2014-01.tif")
    flight = open_flight(str(folder), None, None, folder / "truth.csv", None)
    track_m = flight.track_m()
    away_m = np.hypot(*(track_m - track_m[INSERTED_BEFORE]).T)
    far = int(np.argmax(away_m >= FAR_M))
    assert away_m[far] >= FAR_M
    next_file = flight.frame_refs[INSERTED_BEFORE].file
    inserted = edits.foreign_frames({next_file: flight.picture(far)})
    gap = edits.without_frames(frozenset(flight.frame_refs[i].file for i in TURN))
    replay(
        folder,
        None,
        tmp_path,
        wrap_source=lambda source: AlteredSource(source, lambda shots: gap(inserted(shots)), frames=FRAMES),
    )
    marks = Marks(wrong_files=frozenset({edits.foreign_name(next_file)}))
    evidence = gather(tmp_path, flight.truth, marks)
    assert len(evidence.frames) == FRAMES + 1 - len(TURN)
    assert measures.wrong_rejected(evidence).value == 1.0
    after_m = measures.error_after_wrong(evidence).value
    assert after_m is not None and after_m < 50.0
    assert evidence.metrics["within_50m"] == 1.0 and evidence.metrics["within_20m"] >= 0.8
    assert evidence.metrics["false_fixes"] == 0 and evidence.metrics["ellipse95_coverage"] >= 0.9
    assert evidence.metrics["odometry_rate"] > 0.95  # the gap starts no new fragment: the remaining frames overlap
    assert {frame.match.search.step for frame in evidence.frames if frame.match} <= {SearchStep.NORMAL, SearchStep.SKIP}
