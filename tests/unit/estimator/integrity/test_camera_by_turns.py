"""Which of several vehicles carries the camera, by turns: true courses, other courses, and copies of the true one."""

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from simulated_flight import CAMERA, ORIGIN, EstimatorRun, Flight, some_features, t_ns
from terrafix.core.camera import Mount
from terrafix.core.geodesy import rot_w_b, yaw_of
from terrafix.estimator.integrity.camera_vehicle import CameraVehicleTest
from terrafix.estimator.integrity.turn_comparison import Turn
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.monitors.visual_motion import image_turn
from terrafix.estimator.prior import CheckpointWriter, load_checkpoint
from terrafix.messages import CameraVehicle, CandidateAttitude, Message, ServedVehicle, VehicleState
from terrafix_lab.sim.true_messages import apply, homography

FRAME_S, ATTITUDE_S = 0.5, 0.1
UNKNOWN = Attitude(None, None, None, None)
Course = Callable[[np.ndarray, np.random.Generator], np.ndarray]  # times (N,) [s] -> rates of turn (N,) [degrees/s]


def stands(t_s: np.ndarray, _rng: np.random.Generator) -> np.ndarray:
    return np.zeros(len(t_s))


def hovers(t_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(0.0, 1.0, len(t_s))


def circles(t_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.full(len(t_s), rng.uniform(8.0, 20.0))


def turns(t_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Turns of 2 to 8 s at 8 to 30 degrees/s, every 5 to 40 s."""
    rates, at_s = np.zeros(len(t_s)), rng.uniform(5.0, 20.0)
    while at_s < t_s[-1]:
        over_s = rng.uniform(2.0, 8.0)
        rates[(t_s >= at_s) & (t_s < at_s + over_s)] = rng.uniform(8.0, 30.0) * rng.choice([-1, 1])
        at_s += over_s + rng.uniform(5.0, 40.0)
    return rates


def surveys(t_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Half turns of 9 s, left and right, every 49 s."""
    since_s = t_s - rng.uniform(5.0, 30.0)
    return np.where((since_s > 0.0) & (since_s % 49.0 < 9.0), np.where(since_s // 49.0 % 2 == 0, 20.0, -20.0), 0.0)


def decided(
    courses: list[Course], camera: Course | int, seed: int, *, seconds: float = 300.0, late_s: float = 0.0
) -> tuple[int, float]:
    """-> confirmed vehicle (1, 2, ...; 0: none) and time [s]. ``camera``: index of the vehicle that carries it, or the
    course of one that is not on the link. ``late_s``: age of attitudes at their time."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, ATTITUDE_S)
    headings = [np.radians(np.cumsum(course(t_s, rng)) * ATTITUDE_S) for course in courses]
    reported = [heading + np.radians(0.3) * rng.normal(size=len(t_s)) for heading in headings]
    true = headings[camera] if isinstance(camera, int) else np.radians(np.cumsum(camera(t_s, rng)) * ATTITUDE_S)
    frame_s = np.arange(3.0, seconds, FRAME_S)
    seen = np.interp(frame_s, t_s, true) + np.radians(0.1) * rng.normal(size=len(frame_s))
    test, sysids = CameraVehicleTest(), [*range(1, len(courses) + 1)]
    test.on_served(ServedVehicle(t_ns=0, sysid=1, confirmed=False, candidates=sysids))
    at = 0
    for i, frame in enumerate(frame_s[1:]):
        while t_s[at] <= frame:
            for sysid, yaw in zip(sysids, reported, strict=True):
                test.on_candidate(candidate(t_s[at] + late_s, sysid, float(yaw[at])))
            at += 1
        answer = test.on_turn(turn(frame_s[i], float(frame), float(seen[i + 1] - seen[i])))
        if answer is not None:
            return answer.sysid, float(frame)
    return 0, seconds


def candidate(t_s: float, sysid: int, yaw_rad: float) -> CandidateAttitude:
    yaw_rad = math.remainder(yaw_rad, math.tau)
    return CandidateAttitude(t_ns=round(t_s * 1e9), sysid=sysid, yaw_rad=yaw_rad, pitch_rad=0.0, roll_rad=0.0)


def turn(t0_s: float, t1_s: float, yaw_rad: float) -> Turn:
    return Turn(round(t0_s * 1e9), round(t1_s * 1e9), math.remainder(yaw_rad, math.tau))


@pytest.mark.parametrize("other", [stands, hovers, turns, circles])
@pytest.mark.parametrize("seed", range(4))
def test_the_vehicle_with_the_camera_is_confirmed_by_its_turns(other: Course, seed: int) -> None:
    sysid, after_s = decided([other, turns], 1, seed)
    assert sysid == 2 and after_s < 200.0


@pytest.mark.parametrize("late_s", [0.2, 1.0])
def test_late_attitudes_are_compared_at_their_own_time(late_s: float) -> None:
    assert decided([turns, turns], 1, 3, late_s=late_s)[0] == 2


@pytest.mark.parametrize("courses", [[turns, turns], [surveys], [turns], [stands, hovers]])
@pytest.mark.parametrize("seed", range(4))
def test_no_vehicle_is_confirmed_that_does_not_carry_the_camera(courses: list[Course], seed: int) -> None:
    assert decided(courses, turns, seed)[0] == 0


def test_vehicles_that_turn_alike_are_not_told_apart() -> None:
    """As a forger that repeats the telemetry of the true vehicle."""

    def alike(t_s: np.ndarray, _rng: np.random.Generator) -> np.ndarray:
        return turns(t_s, np.random.default_rng(5))

    assert decided([alike, alike], 0, 1)[0] == 0


def test_without_turns_nothing_is_decided() -> None:
    assert decided([stands, hovers], 1, 1)[0] == 0


def test_one_manoeuvre_is_not_enough() -> None:
    def once(t_s: np.ndarray, _rng: np.random.Generator) -> np.ndarray:
        return np.where((t_s > 10.0) & (t_s < 25.0), 20.0, 0.0)

    assert decided([stands, once], 1, 1)[0] == 0


@pytest.mark.parametrize("every_s", [1.0 / 30.0, 0.5, 1.0])
def test_frames_at_any_rate_decide(every_s: float) -> None:
    test = CameraVehicleTest()
    test.on_served(ServedVehicle(t_ns=0, sysid=1, confirmed=False, candidates=[1, 2]))
    answers, at_s = [], 0.0
    for i in range(round(60.0 / every_s)):
        t0_s, t1_s = i * every_s, (i + 1) * every_s
        while at_s <= t1_s:
            test.on_candidate(candidate(at_s, 1, 0.0))
            test.on_candidate(candidate(at_s, 2, math.sin(at_s)))
            at_s += ATTITUDE_S
        answers.append(test.on_turn(turn(t0_s, t1_s, math.sin(t1_s) - math.sin(t0_s))))
    assert [x.sysid for x in answers if x is not None] == [2]


@pytest.mark.parametrize("roll_deg", [0.0, 20.0, 40.0])
@pytest.mark.parametrize("turn_deg", [-12.0, 5.0])
@pytest.mark.parametrize("mount_pitch_deg", [-90.0, -60.0])
def test_image_turns_need_neither_heading_nor_height(roll_deg: float, turn_deg: float, mount_pitch_deg: float) -> None:
    """Of a vehicle that flies on over flat ground, banked or not."""
    camera = msgspec.structs.replace(CAMERA, mount_pitch_deg=mount_pitch_deg)
    mount = Mount.of(camera).r_b_c()
    yaws, roll = (1.0, 1.0 + math.radians(turn_deg)), math.radians(roll_deg)
    views = [(rot_w_b(yaw, 0.0, roll) @ mount, np.array([0.0, 8.0 * k, 100.0])) for k, yaw in enumerate(yaws)]
    features = 0.5 * some_features()
    pairs = np.hstack([features, apply(homography(*views), features)])
    tilt = Attitude(None, 0.0, roll, None)
    assert image_turn(pairs, tilt, tilt, mount) == pytest.approx(math.radians(turn_deg), rel=1e-3)
    assert image_turn(pairs, UNKNOWN, UNKNOWN, mount) == pytest.approx(math.radians(turn_deg), rel=0.5)


# --- in the node ---


def attitudes(flight: Flight, i: int) -> list[Message]:
    """Of two vehicles, a standing one (1) and that with the camera (2), from the frame before to this one."""
    before, now = (yaw_of(flight.r_w_b[k]) for k in (max(i - 1, 0), i))
    steps = np.arange(0.2, 1.01, 0.2)
    return [
        candidate((t_ns(i) * 1e-9) - (1.0 - share) * FRAME_S, sysid, yaw)
        for share in steps
        for sysid, yaw in ((1, 1.0), (2, before + share * math.remainder(now - before, math.tau)))
    ]


def fly(run: EstimatorRun, flight: Flight) -> list[CameraVehicle]:
    """Without the telemetry of any vehicle, as while it is not known which one carries the camera."""
    run.feed([ORIGIN, ServedVehicle(t_ns=0, sysid=1, confirmed=False, candidates=[1, 2])])
    for i in range(flight.frames):
        run.feed([*attitudes(flight, i), *(x for x in flight.messages(i) if not isinstance(x, VehicleState))])
    return [x for x in run.published if isinstance(x, CameraVehicle)]


def test_the_estimator_decides_without_telemetry_and_answers_a_link_that_was_restarted() -> None:
    run = EstimatorRun()
    (answer,) = fly(run, Flight(120, seed=3, turn_rad=-4.0))
    assert answer.sysid == 2 and answer.evidence[1] < 1.0 < answer.evidence[2]
    asked = ServedVehicle(t_ns=t_ns(120), sysid=1, confirmed=False, candidates=[1, 2])
    assert [x.sysid for x in run.feed([asked]) if isinstance(x, CameraVehicle)] == [2]
    known = ServedVehicle(t_ns=t_ns(121), sysid=2, confirmed=True)
    assert run.feed([known]) == []


def test_the_served_vehicle_is_confirmed_while_it_is_alone() -> None:
    flight, run = Flight(120, seed=3, turn_rad=-4.0), EstimatorRun()
    run.feed([ServedVehicle(t_ns=0, sysid=7, confirmed=False)])
    assert [x.sysid for x in run.fly(flight, 0, 120).published if isinstance(x, CameraVehicle)] == [7]


def test_the_answer_outlives_the_estimator(tmp_path: Path) -> None:
    run = EstimatorRun().fly(Flight(2, seed=3), 0, 2)
    writer = CheckpointWriter(tmp_path / "estimator.checkpoint")
    writer.on_message(CameraVehicle(t_ns=0, sysid=2))
    writer.on_message(run.estimate(1))
    found = load_checkpoint(tmp_path / "estimator.checkpoint")
    assert found is not None
    asked = ServedVehicle(t_ns=0, sysid=1, confirmed=False, candidates=[1, 2])
    answer = CameraVehicleTest(found.camera_vehicle).on_served(asked)
    assert answer is not None and answer.sysid == 2


def test_the_link_confirms_for_an_estimator_that_was_restarted() -> None:
    test = CameraVehicleTest()
    assert test.on_served(ServedVehicle(t_ns=0, sysid=2, confirmed=True)) is None
    assert test.confirmed == 2


def test_while_the_confirmed_vehicle_is_not_there_the_others_are_compared() -> None:
    test = CameraVehicleTest(CameraVehicle(t_ns=0, sysid=9))
    answer = test.on_served(ServedVehicle(t_ns=0, sysid=7, confirmed=False))
    assert answer is not None and answer.sysid == 9
    for i in range(600):
        test.on_vehicle_state(
            VehicleState(t_ns=i * 10**8, source="test", yaw_rad=math.sin(i / 10.0), pitch_rad=0.0, roll_rad=0.0)
        )
    answers = [test.on_turn(turn(i / 2, (i + 1) / 2, math.sin((i + 1) / 2) - math.sin(i / 2))) for i in range(110)]
    assert [x.sysid for x in answers if x is not None] == [7]
