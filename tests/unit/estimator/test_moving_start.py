"""A vehicle that stood on what moves: disarmed is evidence for standing, and no place."""

import numpy as np
import pytest

from inertial_flight import ORIGIN
from seeds import seeds
from simulated_flight import CAMERA, EstimatorRun, cov_of
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b
from terrafix.link.pilot_text.statustext import fault_text
from terrafix.messages import (
    CalibrationFault,
    Imu,
    MeasurementVerdict,
    NavEstimate,
    Odometry,
    SourceLabel,
    VehicleState,
    Verdict,
)
from terrafix_lab.sim.true_messages import first_odometry, map_match, odometry

FRAME_HZ, STANDS_S, SEEN_M, MAPPED_M = 5, 12.0, 8.0, 30.0
MS = 1_000_000


def up_m(t_s: float) -> float:
    return 0.3 + float(np.clip((t_s - STANDS_S) * 3.0, 0.0, 60.0))


def taken_off(seed: int, deck_mps: float, seconds: float) -> EstimatorRun:
    """A copter stands disarmed on a deck with ``deck_mps`` east, and climbs. The ground is seen from SEEN_M on, and
    found on the map from MAPPED_M on."""
    rng, run = np.random.default_rng([seed, 5]), EstimatorRun()
    run.feed([ORIGIN])
    r_w_b = rot_w_b(1.0, 0.0, 0.0)
    r_w_c, poses, keyframe = r_w_b @ Mount.of(CAMERA).r_b_c(), {}, -1
    for i in range(round(seconds * FRAME_HZ)):
        t_s = i / FRAME_HZ
        t_ns = round(t_s * 1e9)
        for before_ns in (160 * MS, 120 * MS, 80 * MS, 40 * MS, 0):
            at_ns = max(t_ns - before_ns, 0)
            noise, height_m = rng.normal(0.0, 0.003, 3), up_m(at_ns * 1e-9) - 0.3 + rng.normal(0.0, 0.2)
            run.feed(
                [
                    VehicleState(
                        t_ns=at_ns,
                        source="simulated",
                        yaw_rad=1.0 + noise[0],
                        pitch_rad=noise[1],
                        roll_rad=noise[2],
                        agl_m=height_m,
                        armed=at_ns * 1e-9 > STANDS_S - 2.0,
                    ),
                    Imu(
                        t_ns=at_ns,
                        source="simulated",
                        samples=[(0, *rng.normal([0.0, 0.0, -9.81], 0.1), 0.0, 0.0, 0.0)],
                    ),
                ]
            )
        poses[i] = r_w_c, np.array([deck_mps * t_s, 0.0, up_m(t_s)])
        if up_m(t_s) < SEEN_M:
            run.feed([Odometry(t_ns=t_ns, frame_id=i, keyframe_id=i, verdict=Verdict.FEW_INLIERS)])
            continue
        if keyframe < 0:
            keyframe = i
            run.feed([first_odometry(t_ns, i)])
            continue
        run.feed([odometry(t_ns, (keyframe, i), (poses[keyframe], poses[i]), rng, becomes_keyframe=i % 3 == 0)])
        keyframe = i if i % 3 == 0 else keyframe
        if up_m(t_s) > MAPPED_M and i % 4 == 0:
            run.feed([map_match(t_ns, i, poses[i], rng)])
    return run


def starts_of(run: EstimatorRun) -> list[CalibrationFault]:
    return [m for m in run.published if isinstance(m, CalibrationFault) and m.quantity == "start"]


@pytest.mark.parametrize("seed", seeds(1, 2, 3))
def test_a_start_on_a_deck_that_moves_is_no_place_once_the_ground_is_seen_to_move(seed: int) -> None:
    run = taken_off(seed, 6.0, 21.0)
    estimate = run.estimates()[-1]
    assert estimate.source_label is SourceLabel.NOT_PLACED
    assert np.sqrt(cov_of(estimate)[0, 0]) > 6.0 * STANDS_S
    assert [fault.active for fault in starts_of(run)] == [True]
    assert fault_text(starts_of(run)[0]) == "take-off moved: no fix before the map"


def test_the_map_places_a_flight_that_began_on_a_deck() -> None:
    run = taken_off(1, 6.0, 26.0)
    assert run.estimates()[-1].source_label is not SourceLabel.NOT_PLACED
    assert [fault.active for fault in starts_of(run)] == [True, False]


@pytest.mark.parametrize("seed", seeds(1, 2, 3, 4))
def test_a_take_off_from_the_ground_stays_placed(seed: int) -> None:
    run = taken_off(seed, 0.0, 21.0)
    assert all(m.source_label is not SourceLabel.NOT_PLACED for m in run.published if isinstance(m, NavEstimate))
    resets = {m.detail for m in run.published if isinstance(m, MeasurementVerdict) and m.measurement == "reset"}
    assert not any("may have moved" in detail for detail in resets) and not starts_of(run)
