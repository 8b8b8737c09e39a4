"""Decisions that two records took differently: by kind, and not what is merely rounded otherwise."""

from pathlib import Path

import pytest

from terrafix.core.errors import SourceError
from terrafix.messages import MapMatch, MatchPlace, MeasurementVerdict, Odometry, Verdict
from terrafix_lab.bench.flips import Decisions, _take, differences, read_decisions

PAIRS = [(0.1, 0.2, 0.11, 0.2), (-0.3, 0.1, -0.29, 0.1), (0.0, -0.2, 0.01, -0.2)]
MATCHES = [(0.1, 0.2, 10.0, 20.0, 0.0, 0.5), (-0.3, 0.1, -30.0, 10.0, 0.0, 0.5)]


def decided(
    shift: float = 0.0, keyframe: int = 3, pairs: int = 3, e_m: float = 0.0, rejected: bool = False
) -> Decisions:
    """One frame. ``shift``: of all image points; ``e_m``: of the place and of the first patch's peak."""
    found = Decisions()
    two_view = [(a + shift, b, c + shift, d) for a, b, c, d in PAIRS[:pairs]]
    matches = [(x + shift, y, e + e_m * (i == 0), n, u, w) for i, (x, y, e, n, u, w) in enumerate(MATCHES)]
    verdict = Verdict.INNOVATION if rejected else Verdict.ACCEPTED
    place = MatchPlace(e_m=e_m, n_m=0.0, mass=1.0)
    for message in (
        Odometry(t_ns=0, frame_id=7, keyframe_id=keyframe, verdict=Verdict.ACCEPTED, two_view=two_view),
        MapMatch(t_ns=0, frame_id=7, verdict=Verdict.ACCEPTED, matcher="gradient", matches=matches, place=place),
        MeasurementVerdict(t_ns=0, frame_id=7, measurement="map", verdict=verdict),
    ):
        _take(found, message, None)
    return found


def test_what_is_rounded_otherwise_is_no_other_decision() -> None:
    assert differences(decided(), decided(shift=1e-6, e_m=1e-3)) == {}


@pytest.mark.parametrize(
    ("other", "kinds"),
    [
        (decided(keyframe=4), {"keyframe": "(3, False) | (4, False)"}),
        (decided(pairs=2), {"which features": "1 of 5 alone"}),
        (decided(rejected=True), {"verdict of map": "accepted | innovation"}),
        (decided(e_m=2.0), {"patches elsewhere": "1 of 2"}),
        (decided(e_m=8.0), {"patches elsewhere": "1 of 2", "mode": "8.0 m apart"}),
    ],
)
def test_each_decision_is_named_by_its_kind(other: Decisions, kinds: dict[str, str]) -> None:
    assert differences(decided(), other) == kinds


def test_without_a_record_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SourceError):
        read_decisions(tmp_path)
