"""Which positions a place stands behind: labels of the estimates, refined positions, heights, after a restart."""

import msgspec
import numpy as np
import pytest

from map_matches import with_search
from simulated_flight import ORIGIN, EstimatorRun, Flight, t_ns
from terrafix.core.geodesy import LocalFrame
from terrafix.core.initial_position import SEARCH_START_SIGMA_M
from terrafix.estimator.prior import EstimatorCheckpoint, NavPrior
from terrafix.messages import InitialPosition, MapMatch, Origin, Refinement, SourceEnded, SourceLabel, Verdict

FRAMES, FOUND_AT = 16, 8
UNKNOWN_START = msgspec.structs.replace(ORIGIN, start_sigma_m=2500.0)


def flown(origin: Origin, *, found: bool) -> EstimatorRun:
    """A flight from ``origin``; ``found``: a search finds the position at frame FOUND_AT, and the map matches from then
    on."""
    flight, run = Flight(FRAMES, seed=5), EstimatorRun()
    run.feed([origin])
    for i in range(FRAMES):
        messages = [m for m in flight.messages(i) if not isinstance(m, MapMatch)]
        if found and i >= FOUND_AT:
            match = flight.fix(i)
            messages.append(with_search(match, relocalized=True) if i == FOUND_AT else match)
        run.feed(messages)
    run.feed([SourceEnded(t_ns=t_ns(FRAMES), frames=FRAMES)])
    return run


def labels(run: EstimatorRun) -> list[SourceLabel]:
    """Of the last estimate of each frame."""
    return [run.estimate(i).source_label for i in range(FRAMES)]


def refined_frames(run: EstimatorRun) -> set[int]:
    return {pose.frame_id for m in run.published if isinstance(m, Refinement) for pose in m.poses}


def test_without_a_start_no_frame_is_placed_before_the_map_has_found_one() -> None:
    run = flown(UNKNOWN_START, found=True)
    assert set(labels(run)[:FOUND_AT]) == {SourceLabel.NOT_PLACED}
    assert set(labels(run)[FOUND_AT:]) == {SourceLabel.SATELLITE_ANCHORED}
    assert refined_frames(run) == set(range(FOUND_AT, FRAMES))


def test_a_flight_that_the_map_never_finds_has_no_position_at_all() -> None:
    run = flown(UNKNOWN_START, found=False)
    assert set(labels(run)) == {SourceLabel.NOT_PLACED} and not refined_frames(run)


def test_a_known_start_places_the_flight_until_the_map_does() -> None:
    known = msgspec.structs.replace(ORIGIN, start_sigma_m=SEARCH_START_SIGMA_M)
    run = flown(known, found=False)
    assert SourceLabel.NOT_PLACED not in labels(run) and refined_frames(run) == set(range(FRAMES))


@pytest.mark.parametrize(("sigma_m", "placed"), [(30.0, True), (900.0, False)])
def test_a_hint_places_the_flight_if_it_is_better_than_a_search(sigma_m: float, placed: bool) -> None:
    flight, run = Flight(FRAMES, seed=5), EstimatorRun()
    hint = InitialPosition(
        t_ns=0,
        verdict=Verdict.ACCEPTED,
        lat_deg=ORIGIN.lat_deg,
        lon_deg=ORIGIN.lon_deg,
        sigma_m=sigma_m,
        ground_amsl_m=None,
    )
    run.feed([UNKNOWN_START, hint])
    run.feed([m for m in flight.messages(0) if not isinstance(m, MapMatch)])
    assert (run.estimate(0).source_label is not SourceLabel.NOT_PLACED) is placed


@pytest.mark.parametrize("found", [True, False])
def test_a_restarted_estimator_is_placed_if_the_one_before_was(found: bool) -> None:
    last = flown(UNKNOWN_START, found=found).estimates()[-1]
    prior = NavPrior.of(EstimatorCheckpoint(last), LocalFrame(ORIGIN.lat_deg, ORIGIN.lon_deg), ORIGIN.camera)
    assert prior.placed is found


@pytest.mark.parametrize(("ground_m", "dem", "known"), [(None, False, False), (None, True, True), (520.0, False, True)])
def test_a_height_above_the_sea_is_known_with_an_elevation_of_start_or_map(
    ground_m: float | None, dem: bool, known: bool
) -> None:
    flight, run = Flight(4, seed=5, dem=dem), EstimatorRun()
    run.fly(flight, 0, 4, origin=msgspec.structs.replace(ORIGIN, ground_amsl_m=ground_m))
    run.feed([SourceEnded(t_ns=t_ns(4), frames=4)])
    assert run.estimate(3).amsl_known is known
    heights = [pose.alt_amsl_m for m in run.published if isinstance(m, Refinement) for pose in m.poses]
    assert heights and all((height is not None) is known for height in heights)
    assert np.isfinite(run.estimate(3).agl_m)
