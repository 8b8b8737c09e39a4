"""Rows of the table of faults in Monte Carlo: the edits of pictures, telemetry and start, applied to messages."""

import math

import numpy as np
import pytest

from terrafix.core.errors import UsageError
from terrafix.messages import Gimbal, GimbalAttitude, VehicleState, Verdict
from terrafix_lab.faults import pictures
from terrafix_lab.faults.table import FAULTS, in_turn
from terrafix_lab.montecarlo.edited import edited
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flight import run
from terrafix_lab.montecarlo.flown import SimulatedFlight, fly
from terrafix_lab.montecarlo.ground import Terrain
from terrafix_lab.montecarlo.plan import plan
from terrafix_lab.montecarlo.run import FLYABLE, fault_of
from terrafix_lab.sim.autopilot.parameters import Kind

SHORT_S = 60.0
TRUE = plan(5, 1, fault=DrawnFault.NONE, duration_s=SHORT_S)
FLOWN = fly(TRUE, Terrain(TRUE.seed, TRUE.hills_m, TRUE.settled))


def changed(name: str) -> SimulatedFlight:
    return edited(FLOWN, FAULTS[name])


def states(flown: SimulatedFlight) -> list[VehicleState]:
    return [m for messages in flown.telemetry for m in messages if isinstance(m, VehicleState)]


def test_a_fault_that_does_nothing_leaves_every_message_as_it_is() -> None:
    same = changed("none")
    assert same.telemetry == FLOWN.telemetry and same.frames == FLOWN.frames
    assert all(
        np.array_equal(a.p_m, b.p_m) and a.t_s == b.t_s for a, b in zip(same.pictures, FLOWN.pictures, strict=True)
    )
    assert np.allclose(same.path_m, FLOWN.path_m) and same.lie is None


def test_pictures_come_late_freeze_and_turn_dark_within_the_span_of_the_fault() -> None:
    late = changed("pictures 1 s late").pictures
    assert all(np.array_equal(shown.p_m, FLOWN.frames[max(0, i - 1)].p_m) for i, shown in enumerate(late))
    assert [shown.t_s for shown in late] == [shot.t_s for shot in FLOWN.frames]
    frozen = changed("frozen picture with noise")
    assert frozen.lie is not None and frozen.lie.to_s - frozen.lie.from_s == 15.0
    held = [i for i, shown in enumerate(frozen.pictures) if not np.array_equal(shown.p_m, FLOWN.frames[i].p_m)]
    assert held == [i for i, shot in enumerate(FLOWN.frames) if frozen.lie.has(shot.t_s)]
    assert {frozen.pictures[i].p_m.tobytes() for i in held} == {FLOWN.frames[held[0] - 1].p_m.tobytes()}
    for name in ("camera: black", "camera: no JPEG"):
        dark = changed(name)
        assert sum(shown.dark for shown in dark.pictures) in (6, 7) and dark.lie is None, name
    assert len(changed("camera: unplugged").frames) in (len(FLOWN.frames) - 7, len(FLOWN.frames) - 6)


def test_telemetry_and_the_stated_camera_are_edited_and_the_truth_is_not() -> None:
    low = changed("height 30 % low")
    assert all(a.agl_m == pytest.approx(0.7 * b.agl_m) for a, b in zip(states(low), states(FLOWN), strict=True))  # type: ignore[operator]
    assert low.frames == FLOWN.frames
    doubled = changed("focal length doubled")
    assert doubled.origin.camera.fx == 2.0 * FLOWN.origin.camera.fx and doubled.telemetry == FLOWN.telemetry


def test_a_picture_turned_by_180_degrees_is_that_of_a_turned_camera_and_a_mirrored_one_is_of_none() -> None:
    shot = FLOWN.frames[3]
    turned = shot.scaled(-1.0, -1.0)
    assert turned.r_w_c == pytest.approx(shot.r_w_c @ np.diag([-1.0, -1.0, 1.0])) and turned.scale == (1.0, 1.0)
    assert shot.scaled(-1.0, 1.0).scale == (-1.0, 1.0)
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert np.array_equal(pictures.upside_down(image), image[::-1, ::-1])
    assert np.array_equal(pictures.mirrored(image), image[:, ::-1])
    stretched = pictures.scaled(1.0, 2.0)(np.repeat(10 * np.arange(8, dtype=np.uint8), 8).reshape(8, 8))
    assert stretched[:, 0].tolist() == [18, 22, 28, 32, 38, 42, 48, 52]


def test_the_focal_length_that_the_estimator_is_told_is_not_that_of_the_camera() -> None:
    """Odometry then contradicts height and attitude: a flight with it is not accepted as one without."""
    honest, wrong = run(TRUE), run(plan(5, 1, fault="focal length doubled", duration_s=SHORT_S))
    assert honest.fixes.get(Verdict.ACCEPTED, 0) > 30 > 3 * wrong.fixes.get(Verdict.ACCEPTED, 0)
    assert wrong.lie is not None and math.isclose(wrong.lie.from_s, 0.0)


def test_a_fault_that_monte_carlo_cannot_fly_is_one_clear_error() -> None:
    with pytest.raises(UsageError, match=r"'link: silent': the fault needs the real processes.* chaos"):
        fault_of("link: silent")
    with pytest.raises(UsageError, match=r"'moon': no such fault; known: none, 10 % wrong"):
        fault_of("moon")
    assert fault_of("60 s blackouts") is DrawnFault.BLACKOUT and fault_of("mirrored pictures") in FLYABLE


def test_faults_in_turn_follow_each_other() -> None:
    both = in_turn("both", "", FAULTS["camera: unplugged"], FAULTS["frozen picture with noise"])
    flown = edited(FLOWN, both)
    assert both.lasts_s == 21.0 and both.flight_s == 52.5 and flown.lie is not None
    times_s = [shot.t_s for shot in flown.frames]
    assert not [t_s for t_s in times_s if 0.0 <= t_s - flown.lie.from_s < 6.0]
    held = {flown.pictures[i].p_m.tobytes() for i, t_s in enumerate(times_s) if 7.0 < t_s - flown.lie.from_s < 21.0}
    assert len(held) == 1


def test_outlier_fixes_of_the_table_are_rejected_by_the_estimator() -> None:
    honest, wrong = run(TRUE), run(plan(5, 1, fault="350 m outlier fix", duration_s=SHORT_S))
    assert wrong.fixes.get(Verdict.INNOVATION, 0) >= honest.fixes.get(Verdict.INNOVATION, 0) + 5
    assert np.hypot(*wrong.error_m[:, :2].T).max() < 60.0


def test_a_fault_of_a_gimbal_is_flown_by_a_copter_whose_camera_is_on_one_that_reports() -> None:
    drawn = plan(5, 2, fault="gimbal not reported", duration_s=50.0)
    flown = edited(fly(drawn, Terrain(drawn.seed, 1.0, drawn.settled)), FAULTS[drawn.fault])
    assert drawn.kind is Kind.COPTER and isinstance(flown.origin.camera.gimbal, Gimbal)
    reported_s = np.array([m.t_ns / 1e9 for sent in flown.telemetry for m in sent if isinstance(m, GimbalAttitude)])
    assert np.diff(reported_s).max() == pytest.approx(20.0, abs=0.5) and np.median(np.diff(reported_s)) < 0.21
