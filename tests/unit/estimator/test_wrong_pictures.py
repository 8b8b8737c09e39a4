"""A camera whose images contradict inertial readings: frozen with jitter, turned or mirrored after a restart."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import msgspec
import numpy as np
import pytest

from inertial_flight import ORIGIN, InertialFlight
from map_matches import position_of, with_pose
from overloaded_flight import FRAME_EVERY, FRAME_S, sigma_m
from overloaded_flight import OverloadedResult as LoadedFlown
from seeds import seeds
from simulated_flight import PLACE, EstimatorRun, Flight
from simulated_flight import sigma_m as sigma_of
from terrafix.core.limits import MAX_SENT_VELOCITY_SIGMA_MPS
from terrafix.estimator import propagation
from terrafix.estimator.integrity.signed_innovations import SignedInnovations
from terrafix.estimator.monitors.image_orientation import ORIENTATIONS, Orientation
from terrafix.messages import (
    CalibrationFault,
    Frame,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    Prediction,
    Verdict,
)
from terrafix_lab.sim.true_messages import first_odometry

LED, SHIFT_MPS = 5, 10.0  # images that are believed before the alarm
SECONDS, FIRST, END = 25, 50, 100  # frames of the fault: 10 to 20 s
KEYFRAME_EVERY = 5
JITTER = 0.4 / 560.0  # 0.4 px
Change = Callable[[Odometry, np.random.Generator], Odometry]


@dataclass
class WrongPictures(LoadedFlown):
    """``published``: by the estimator. ``velocity_off_mps``: error of the velocity of each of ``estimates``.
    ``contradicted``: frames after which only a place ties images to the flight."""

    published: list[Message] = field(default_factory=list)
    velocity_off_mps: list[float] = field(default_factory=list)
    contradicted: set[int] = field(default_factory=set)

    def lies(self) -> list[str]:
        """Fixes whose position or velocity is off by more than three times the claim, and by over 20 m or 3 m/s."""
        found = []
        for (estimate, error_m), off_mps in zip(self.estimates, self.velocity_off_mps, strict=True):
            claim_mps, off_m = estimate.velocity_sigma_mps, float(np.hypot(*error_m))
            wrong = off_m > max(20.0, 3.0 * sigma_m(estimate)) or off_mps > max(3.0, 3.0 * claim_mps)
            if wrong and claim_mps < MAX_SENT_VELOCITY_SIGMA_MPS:
                at = f"frame {estimate.frame_id}: {off_m:.0f} m at {sigma_m(estimate):.1f}"
                found.append(f"{at}, {off_mps:.1f} m/s at {claim_mps:.2f}")
        return found

    def odometry(self) -> dict[int, Verdict]:
        return {v.frame_id: v.verdict for v in self.verdicts if v.measurement == "odometry"}

    def is_back(self, within_s: float) -> bool:
        """Whether a true position is claimed so long after the end of the fault."""
        end_s = END * FRAME_S
        return any(
            np.hypot(*error_m) < 20.0 and estimate.t_ns * 1e-9 <= end_s + within_s
            for estimate, error_m in self.claimed(end_s)
        )


@cache
def simulated(seed: int) -> InertialFlight:
    return InertialFlight(seed, SECONDS, FRAME_EVERY)


def flown(
    seed: int,
    change: Change,
    matches: Callable[[int], int | None],
    frames: int = END + 16,
    first: Change | None = None,
) -> WrongPictures:
    """``change``: of the odometry of a frame of the fault, whose keyframe is one of them, too. ``first``: of the first
    one, whose keyframe is before the fault; None: it begins a fragment. ``matches``: the frame whose place the map
    match of a frame of the fault has; None: it has none."""
    flight, run = simulated(seed), EstimatorRun()
    rng, result = np.random.default_rng([seed, 56]), WrongPictures()
    run.feed([ORIGIN, Frame(t_ns=0, frame_id=0, file="", width=1, height=1, buffered=True)])
    for i in range(frames):
        telemetry = [m for m in flight.messages_by_frame[i] if not isinstance(m, Odometry | MapMatch)]
        odometry, *found = images(
            flight, i, rng, first if i == FIRST and first else change, matches, tied=first is not None
        )
        replies = run.feed([*telemetry, odometry])
        if any(isinstance(reply, Prediction) for reply in replies):  # the anchor matches those frames only
            replies += run.feed(found)
        assert run.node.estimator is not None
        if run.node.estimator.state.contradicted_images.active:
            result.contradicted.add(i)
        for reply in replies:
            if isinstance(reply, NavEstimate):
                at_m = np.array(PLACE.to_local(reply.lat_deg, reply.lon_deg))
                result.estimates.append((reply, at_m - flight.poses[reply.frame_id][1][:2]))
                off_mps = np.array(reply.velocity_enu_mps) - flight.velocity_mps[reply.frame_id]
                result.velocity_off_mps.append(float(np.linalg.norm(off_mps)))
            elif isinstance(reply, MeasurementVerdict):
                result.verdicts.append(reply)
    result.published = run.published
    return result


def images(
    flight: InertialFlight,
    i: int,
    rng: np.random.Generator,
    change: Change,
    matches: Callable[[int], int | None],
    *,
    tied: bool,
) -> list[Message]:
    """Odometry and map match of frame ``i``. ``tied``: the first frame of the fault is tied to the keyframe before."""
    t_ns, faulty = round(i * FRAME_S * 1e9), FIRST <= i < END
    keyframe, fragment = max((i - 1) // KEYFRAME_EVERY * KEYFRAME_EVERY, 0), (i >= FIRST and not tied) + (i >= END)
    if i in (0, END) or (i == FIRST and not tied):
        odometry = first_odometry(t_ns, i, fragment)
    else:
        odometry = flight.registered(i, keyframe, t_ns, rng, becomes_keyframe=i % KEYFRAME_EVERY == 0)
        odometry = msgspec.structs.replace(odometry, fragment_id=fragment)
        odometry = change(odometry, rng) if faulty else odometry
    at = (matches(i) if faulty else i) if i and i % KEYFRAME_EVERY == 0 else None
    return [odometry] if at is None else [odometry, msgspec.structs.replace(flight.fix(at, t_ns, rng), frame_id=i)]


def with_pairs(odometry: Odometry, pairs: np.ndarray) -> Odometry:
    return msgspec.structs.replace(odometry, two_view=[tuple(row) for row in pairs.reshape(-1, 4).tolist()])


def frozen_with_jitter(odometry: Odometry, rng: np.random.Generator) -> Odometry:
    """Every image shows the same view, displaced by 0.4 px."""
    pairs = np.array(odometry.two_view)
    pairs[:, 2:] = pairs[:, :2] + rng.normal(0.0, JITTER, 2) + rng.normal(0.0, 0.1 * JITTER, (len(pairs), 2))
    return with_pairs(odometry, pairs)


def seen_as(orientation: Orientation) -> Change:
    inverse = np.linalg.inv(orientation.matrix)
    return lambda odometry, _: with_pairs(odometry, np.array(odometry.two_view).reshape(-1, 2) @ inverse.T)


@pytest.mark.parametrize("seed", seeds(1, 2))
def test_a_frozen_picture_that_jitters_is_stalled_and_its_place_on_the_map_is_not_taken(seed: int) -> None:
    result = flown(seed, frozen_with_jitter, lambda _: FIRST)
    assert not result.lies()
    verdicts = result.odometry()
    assert [verdicts[i] for i in range(FIRST + 2, END)] == [Verdict.STALLED] * (END - FIRST - 2)
    predicted = {m.frame_id for m in result.published if isinstance(m, Prediction)}
    assert not predicted & set(range(FIRST + 2, END))
    faults = [(m.quantity, m.active) for m in result.published if isinstance(m, CalibrationFault)]
    assert faults == [("picture frozen", True), ("picture frozen", False)]
    assert result.is_back(3.0)


@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=lambda o: f"{o.quantity} {o.turned_deg}")
def test_turned_or_mirrored_pictures_are_named_and_refused(orientation: Orientation) -> None:
    result = flown(1, seen_as(orientation), lambda _: None)
    assert not result.lies()
    faults = [m for m in result.published if isinstance(m, CalibrationFault)]
    assert [(m.quantity, m.active) for m in faults] == [(orientation.quantity, True), (orientation.quantity, False)]
    assert faults[0].t_ns * 1e-9 - FIRST * FRAME_S < 3.0
    assert faults[0].factor == (orientation.turned_deg if orientation.quantity == "picture turned" else None)
    accepted = {frame for frame, verdict in result.odometry().items() if verdict is Verdict.ACCEPTED}
    assert not accepted & set(range(FIRST, END))
    predicted = {m.frame_id for m in result.published if isinstance(m, Prediction)}
    assert not predicted & set(range(round(faults[0].t_ns * 1e-9 / FRAME_S), END))  # the anchor would lose the place
    assert len([e for e, _ in result.claimed(FIRST * FRAME_S) if e.frame_id < END]) > 20  # by inertial readings
    assert result.is_back(3.0)


@pytest.mark.parametrize("turned_deg", [90, 180, -90])
def test_a_picture_that_turns_from_one_frame_to_the_next_is_no_turn_of_the_vehicle(turned_deg: int) -> None:
    """Features tie the first turned image to the keyframe before it."""
    orientation = Orientation(turned_deg)
    inverse = np.linalg.inv(orientation.matrix)

    def turned_alone(odometry: Odometry, _: np.random.Generator) -> Odometry:
        pairs = np.array(odometry.two_view)
        return with_pairs(odometry, np.hstack([pairs[:, :2], pairs[:, 2:] @ inverse.T]))

    result = flown(1, seen_as(orientation), lambda _: None, END, turned_alone)
    verdicts = result.odometry()
    assert verdicts[FIRST] is Verdict.IMPLAUSIBLE
    assert Verdict.ACCEPTED not in {verdicts[i] for i in range(FIRST, END)}
    assert not [v for v in result.verdicts if v.measurement in ("attitude", "heading")]
    assert not result.lies()
    faults = [m for m in result.published if isinstance(m, CalibrationFault)]
    assert [(m.quantity, m.active) for m in faults] == [(orientation.quantity, True)]


def twice_as_fast(odometry: Odometry, _: np.random.Generator) -> Odometry:
    """Every motion since the keyframe is doubled: images of another flight, which no orientation explains."""
    pairs = np.array(odometry.two_view)
    pairs[:, 2:] += (pairs[:, 2:] - pairs[:, :2]).mean(axis=0)
    return with_pairs(odometry, pairs)


@pytest.mark.parametrize("seed", seeds(1, 2))
def test_images_that_contradict_inertial_readings_for_long_are_not_believed_for_that(seed: int) -> None:
    """The graph is reset, as wide as all of that time allows, and only a place ties images to it again."""
    result = flown(seed, twice_as_fast, lambda _: None)
    assert not result.lies()
    resets = [v for v in result.resets() if v.detail == "odometry contradicts inertial readings for 5 s"]
    assert len(resets) == 1
    after = {e.frame_id: e for e, _ in result.estimates}
    assert sigma_m(after[resets[0].frame_id]) > 5.0 * 15.0  # speeds of 15 m/s for five seconds
    verdicts = result.odometry()
    assert Verdict.ACCEPTED not in {verdicts[i] for i in range(FIRST, END)}
    assert result.contradicted == set(range(resets[0].frame_id, max(result.contradicted) + 1))
    assert END < max(result.contradicted) < END + 5.0 / FRAME_S  # map matches decide, the way between two of them apart
    assert result.is_back(3.0)


def squeezed(odometry: Odometry, _: np.random.Generator) -> Odometry:
    """16:9 in 4:3: one axis of the image has another scale."""
    return with_pairs(odometry, np.array(odometry.two_view) * (1.0, 4.0 / 3.0, 1.0, 4.0 / 3.0))


@pytest.mark.parametrize("matched", [False, True])
@pytest.mark.parametrize("seed", seeds(1, 2))
def test_images_that_are_squeezed_in_flight_contradict_inertial_readings(seed: int, *, matched: bool) -> None:
    """Each motion alone passes the innovation gate. ``matched``: the map shows where they are, not how they move."""
    result = flown(seed, squeezed, lambda frame: frame if matched else None)
    assert not result.lies()
    resets = [v for v in result.resets() if v.detail.endswith("to one side of the prediction")]
    assert resets and resets[0].frame_id * FRAME_S - FIRST * FRAME_S < 3.0
    faults = [m for m in result.published if isinstance(m, CalibrationFault) and m.active]
    assert (faults[0].quantity, faults[0].t_ns) == ("picture contradicts motion", resets[0].t_ns)
    assert result.contradicted >= set(range(resets[0].frame_id, END))
    assert result.is_back(3.0)


def test_inertial_readings_go_on_from_the_velocity_before_the_images_that_contradict_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That velocity is shifted by 10 m/s, to be recognised; the claim contains that of the images, too."""
    add, led, motion = SignedInnovations.add, list[int](), propagation.KnownMotion

    def counted(odometry: Odometry, rng: np.random.Generator) -> Odometry:
        seen.append(odometry.frame_id)
        return squeezed(odometry, rng)

    def alarm_after(signed: SignedInnovations, *args: np.ndarray, inertial: bool) -> None:
        add(signed, *args, inertial=inertial)
        led.extend(seen[-1:])
        signed.alarm, signed.run = len(led) == LED, LED

    def shifted(t_s: float, v: np.ndarray, cov: np.ndarray) -> object:
        return motion(t_s, v + np.eye(len(v))[0] * SHIFT_MPS, cov)

    seen = list[int]()
    monkeypatch.setattr(SignedInnovations, "add", alarm_after)
    monkeypatch.setattr(propagation, "KnownMotion", shifted)
    result = flown(1, counted, lambda _: None, FIRST + 12)
    after = {e.frame_id: (e, off) for (e, _), off in zip(result.estimates, result.velocity_off_mps, strict=True)}
    assert after[led[LED - 2]][1] < 0.2 * SHIFT_MPS
    estimate, off_mps = after[led[LED - 1]]
    assert off_mps == pytest.approx(SHIFT_MPS, rel=0.2)
    assert estimate.velocity_sigma_mps == pytest.approx(SHIFT_MPS, rel=0.2)


@pytest.mark.parametrize("nats", [0.0, -2.0])
def test_places_that_wrong_images_have_shown_count_until_the_next_ones_fit_the_estimate_alone(nats: float) -> None:
    """Two map matches that agree with each other, 40 m beside the position, and then right ones."""
    flight, run = Flight(60, seed=5, fix_every=3), EstimatorRun().fly(Flight(60, seed=5, fix_every=3), 0, 30)
    for i in range(30, 40):
        match = flight.fix(i)
        e_m, n_m, up_m = position_of(match)
        wrong = with_pose(match, p_c_in_w_m=(e_m + 40.0, n_m, up_m))
        shown = wrong if i < 36 else msgspec.structs.replace(match, alternative_nats=nats)
        run.feed([shown if isinstance(message, MapMatch) else message for message in flight.messages(i)])
    assert (sigma_of(run.estimate(39)) < 7.0) is (nats < 0.0)
