"""A loop of 2 km, flown twice over ground that no map shows: fragments, loop closure and relocalisation."""

import math
from pathlib import Path

import numpy as np
import pytest

from mapless_flight import MaplessFlight, darkened, fly
from terrafix.core.gate import GATE
from terrafix.messages import Verdict
from terrafix.vision.sources import Shot
from terrafix_lab.sim.flights.make import FlightOptions, make

SIDE_M, LAPS, AGL_M = 500.0, 2, 100.0
CENTRE = (48.152, 14.349)  # degrees, of the generated place
LAP_FRAMES = 172  # after these the flight is over the ground of its first frame again
DARK = (range(60, 84), range(140, 160))  # frames with black images, 12 s and 10 s, in the first lap

pytestmark = pytest.mark.slow


def write_loop(path: Path) -> Path:
    """-> a waypoint file with ``LAPS`` around a square."""
    lat0, lon0 = CENTRE
    half_m = SIDE_M / 2
    corners = [(-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m)]
    course = [corners[i % 4] for i in range(4 * LAPS + 1)]
    rows = ["QGC WPL 110"]
    for k, (east_m, north_m) in enumerate([course[0], *course]):
        lat = lat0 + north_m / 111_132.0
        lon = lon0 + east_m / (111_320.0 * math.cos(math.radians(lat0)))
        frame, agl_m = (0, 0.0) if k == 0 else (3, AGL_M)  # the home position; relative to it
        rows.append("\t".join(map(str, [k, int(k == 0), frame, 16, 0, 0, 0, 0, lat, lon, agl_m, 1])))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flight folder."""
    folder = tmp_path_factory.mktemp("loop")
    mission, out = write_loop(folder / "loop.waypoints"), folder / "flight"
    make(out, FlightOptions(size_km=1.2, seed=5, mission=mission))
    return out


def drift_m(flown: MaplessFlight, frame_id: int) -> float:
    """Error of the motion since the first frame, whose position only the operator has stated."""
    return float(np.linalg.norm(flown.error_m(frame_id) - flown.error_m(min(flown.truth_m))))


def assert_no_estimate_is_worse_than_its_covariance(flown: MaplessFlight) -> None:
    nees = [
        flown.error_m(i) @ np.linalg.solve(flown.cov_m2(i), flown.error_m(i))
        for i in flown.truth_m
        if i in flown.estimates()
    ]
    assert max(nees) < GATE[2]


@pytest.mark.nightly
def test_at_the_end_of_a_second_lap_the_position_relative_to_the_start_is_known_to_a_third_of_a_percent_of_the_way(
    loop: Path,
) -> None:
    flown = fly(loop)
    last = max(flown.truth_m)
    assert flown.way_m() > 3500.0
    assert max(drift_m(flown, i) for i in range(LAP_FRAMES, last)) > 0.006 * flown.way_m()  # what there is to correct
    assert drift_m(flown, last) <= 0.003 * flown.way_m()
    assert_no_estimate_is_worse_than_its_covariance(flown)


def test_each_fragment_after_a_dark_gap_has_an_id_and_is_found_again_a_lap_later_without_a_map(loop: Path) -> None:
    def in_the_dark(shot: Shot) -> Shot:
        return darkened(shot) if any(shot.frame.frame_id in gap for gap in DARK) else shot

    flown = fly(loop, in_the_dark)
    fragment_of = {o.frame_id: o.fragment_id for o in flown.odometry()}
    starts = (0, DARK[0].stop + 1, DARK[1].stop + 1)  # the first frame after a gap has none to be registered to
    assert [fragment_of[i] for i in starts] == [0, 1, 2]
    assert {fragment_of[i] for gap in DARK for i in gap} == {-1}
    assert {fragment_of[i] for i in range(DARK[1].stop + 1, max(fragment_of) + 1)} == {2}
    accepted = [v.frame_id for v in flown.verdicts("relocalization") if v.verdict is Verdict.ACCEPTED]
    seen_again = {r.keyframe_fragment_id for r in flown.relocalizations() if r.frame_id in accepted}
    assert seen_again == {0, 1, 2}
    assert min(accepted) >= LAP_FRAMES - 10  # not before it is over known ground
    assert drift_m(flown, max(flown.truth_m)) <= 0.006 * flown.way_m()
    assert_no_estimate_is_worse_than_its_covariance(flown)
