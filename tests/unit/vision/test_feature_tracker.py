"""Frame-to-keyframe tracking: motion, foreign frames, lost overlap and new fragments."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from terrafix.core.camera import CameraCalibration
from terrafix.core.limits import WINDOW_NODES
from terrafix.messages import Verdict
from terrafix.vision import covisibility, feature_tracker
from terrafix.vision.feature_tracker import MAX_ODOMETRY_PAIRS, MAX_TRACK_FAILURES, FrameTracker, Motion
from terrafix_lab.sim.true_messages import apply, homography
from textured_ground import PINHOLE, rotation, texture, view

AGL_M = 100.0
Pose = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(1)


def pose(e_m: float, n_m: float, yaw_deg: float = 0.0, agl_m: float = AGL_M) -> Pose:
    return rotation(yaw_deg), np.array([e_m, n_m, agl_m])


def picture(ground: np.ndarray, at: Pose, camera: CameraCalibration = PINHOLE) -> np.ndarray:
    return view(ground, camera, *at)


def foreign(seed: int = 9) -> np.ndarray:
    """A frame of another place."""
    return picture(texture(seed, 190.0), pose(0.0, 0.0))


def errors(motion: Motion, keyframe: Pose, now: Pose) -> np.ndarray:
    """Error of each match against the true motion of the ground, in pixels: (N, 2)."""
    expected = apply(homography(keyframe, now), motion.two_view[:, :2])
    return (motion.two_view[:, 2:] - expected) * PINHOLE.fx


def is_right(motion: Motion, keyframe: Pose, now: Pose) -> bool:
    """Every match is right within a pixel, the resolution of these images, and the mean error is small."""
    error = errors(motion, keyframe, now)
    return bool(np.median(np.linalg.norm(error, axis=1)) < 1.2 and np.linalg.norm(error.mean(0)) < 0.5)


STEPS = {
    "straight": pose(3.0, 12.0),
    "turn": pose(2.0, 6.0, yaw_deg=9.0),
    "climb": pose(0.0, 8.0, agl_m=106.0),
    "tilt": (rotation(0.0, 4.0, -5.0), np.array([2.0, 5.0, AGL_M])),
    "far": pose(10.0, 55.0, yaw_deg=20.0),  # about half of the image overlaps
    "turned round": pose(5.0, 5.0, yaw_deg=170.0),
}


@pytest.mark.parametrize("name", STEPS)
def test_tracking_recovers_the_motion(ground: np.ndarray, name: str) -> None:
    tracker, first, second = FrameTracker(PINHOLE), pose(0.0, 0.0), STEPS[name]
    start = tracker.track(4, picture(ground, first))
    assert (start.keyframe_id, start.becomes_keyframe, len(start.two_view)) == (4, True, 0)
    motion = tracker.track(5, picture(ground, second))
    assert (motion.verdict, motion.keyframe_id) == (Verdict.ACCEPTED, 4)
    assert 15 <= len(motion.two_view) <= MAX_ODOMETRY_PAIRS and motion.inliers >= len(motion.two_view)
    assert is_right(motion, first, second)
    spread = np.ptp(motion.two_view[:, :2], axis=0) * PINHOLE.fx
    assert spread[0] > 0.3 * PINHOLE.width  # matches cover the overlap, not one roof
    assert 0.2 / PINHOLE.fx < motion.sigma_norm < 5.0 / PINHOLE.fx


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(CameraCalibration(1440, 810, 855.0, 855.0, 719.5, 404.5), id="large frames are downscaled"),
        pytest.param(
            CameraCalibration(640, 360, 380.0, 380.0, 319.5, 179.5, (-0.15, 0.03, 0.0, 0.0)),
            id="lens distortion is removed",
        ),
    ],
)
def test_matches_of_any_camera_are_those_of_the_ground(ground: np.ndarray, camera: CameraCalibration) -> None:
    tracker, first, second = FrameTracker(camera), pose(0.0, 0.0), pose(3.0, 12.0, yaw_deg=4.0)
    tracker.track(0, picture(ground, first, camera))
    motion = tracker.track(1, picture(ground, second, camera))
    assert motion.verdict is Verdict.ACCEPTED
    assert is_right(motion, first, second)


def test_a_long_flight_is_one_chain_of_keyframes(ground: np.ndarray) -> None:
    """Each frame refers to a frame that became a keyframe, and every match is right."""
    tracker = FrameTracker(PINHOLE)
    track = [pose(-80.0 + 9.0 * i, 0.05 * (9.0 * i) ** 1.2, yaw_deg=3.0 * i) for i in range(18)]
    keyframes = set()
    for i, at in enumerate(track):
        motion = tracker.track(i, picture(ground, at))
        assert motion.verdict is Verdict.ACCEPTED
        if i:
            assert motion.keyframe_id in keyframes and motion.keyframe_id < i
            assert is_right(motion, track[motion.keyframe_id], at)
        if motion.becomes_keyframe:
            keyframes.add(i)
    assert 3 <= len(keyframes) <= 12  # not every frame, and not too few for the overlap


def test_corners_are_carried_over_keyframes_and_give_three_view_matches(ground: np.ndarray) -> None:
    tracker, at, keyframes, seen = FrameTracker(PINHOLE), dict[int, Pose](), list[int](), 0
    for i in range(18):
        at[i] = pose(-80.0 + 9.0 * i, 0.4 * i, yaw_deg=2.0 * i)
        motion = tracker.track(i, picture(ground, at[i]))
        if len(motion.three_view):
            assert motion.becomes_keyframe and [motion.previous_keyframe_id, motion.keyframe_id] == keyframes[-2:]
            views = motion.three_view.reshape(-1, 3, 2)
            for which, before in enumerate(keyframes[-2:]):
                error = (views[:, 2] - apply(homography(at[before], at[i]), views[:, which])) * PINHOLE.fx
                # A frame-to-frame track drifts by 0.3 to 0.9 px.
                assert np.median(np.linalg.norm(error, axis=1)) < 0.4
            seen += 1
        if motion.becomes_keyframe:
            keyframes.append(i)
    assert seen == len(keyframes) - 2 > 1


def test_a_new_fragment_has_no_matches_with_earlier_keyframes(ground: np.ndarray) -> None:
    tracker = FrameTracker(PINHOLE)
    for i in range(6):
        tracker.track(i, picture(ground, pose(9.0 * i, 0.0)))
    for i in range(MAX_TRACK_FAILURES + 1):
        tracker.track(6 + i, foreign())
    assert len(tracker.track(20, foreign()).three_view) == 0


def test_a_foreign_frame_loses_one_frame_only(ground: np.ndarray) -> None:
    tracker = FrameTracker(PINHOLE)
    track = [pose(0.0, 8.0 * i) for i in range(5)]
    for i in range(2):
        tracker.track(i, picture(ground, track[i]))
    stranger = tracker.track(2, foreign())
    assert (stranger.verdict, stranger.becomes_keyframe, len(stranger.two_view)) == (Verdict.FEW_INLIERS, False, 0)
    after = tracker.track(3, picture(ground, track[3]))
    assert after.verdict is Verdict.ACCEPTED and after.keyframe_id < 2
    assert is_right(after, track[after.keyframe_id], track[3])
    assert tracker.track(4, picture(ground, track[4])).verdict is Verdict.ACCEPTED


def test_after_a_run_of_foreign_frames_tracking_returns_to_the_previous_keyframe(ground: np.ndarray) -> None:
    """Foreign frames that match each other give a keyframe; the next own frame returns to the previous keyframe."""
    tracker, other = FrameTracker(PINHOLE), texture(33, 190.0)
    track = [pose(0.0, 4.0 * i) for i in range(16)]
    for i in range(4):
        tracker.track(i, picture(ground, track[i]))
    theirs = [tracker.track(i, picture(other, pose(0.0, 5.0 * i))) for i in range(4, 10)]
    assert [m.verdict for m in theirs[1:]] == [Verdict.ACCEPTED] * 5 and all(m.keyframe_id >= 4 for m in theirs[1:])
    back = tracker.track(10, picture(ground, track[10]))
    assert back.verdict is Verdict.ACCEPTED and back.keyframe_id < 4
    assert is_right(back, track[back.keyframe_id], track[10])
    assert tracker.track(11, picture(ground, track[11])).keyframe_id >= 10


def test_tracking_can_return_to_a_frame_that_was_registered_to_a_keyframe(ground: np.ndarray) -> None:
    """A large step makes the frame a keyframe; foreign frames follow before any frame was registered to it."""
    tracker, other = FrameTracker(PINHOLE), texture(33, 190.0)
    tracker.track(0, picture(ground, pose(0.0, 0.0)))
    far = tracker.track(1, picture(ground, STEPS["far"]))
    assert far.verdict is Verdict.ACCEPTED and far.becomes_keyframe
    for i in (2, 3):
        tracker.track(i, picture(other, pose(0.0, 5.0 * i)))
    assert tracker.track(4, picture(ground, STEPS["far"])).keyframe_id == 1


def test_after_foreign_frames_without_matches_tracking_returns_to_the_previous_keyframe(ground: np.ndarray) -> None:
    tracker = FrameTracker(PINHOLE)
    for i in range(4):
        tracker.track(i, picture(ground, pose(0.0, 4.0 * i)))
    alone = [tracker.track(4 + i, foreign(40 + i)) for i in range(MAX_TRACK_FAILURES)]
    assert alone[-1].verdict is Verdict.ACCEPTED and alone[-1].keyframe_id == 3 + MAX_TRACK_FAILURES
    back = tracker.track(4 + MAX_TRACK_FAILURES, picture(ground, pose(0.0, 16.0)))
    assert back.verdict is Verdict.ACCEPTED and back.keyframe_id < 4


def test_tracking_does_not_return_to_a_frame_without_matches(ground: np.ndarray) -> None:
    tracker = FrameTracker(PINHOLE)
    tracker.track(0, foreign(20))  # alone
    for i in range(1, 4):
        tracker.track(i, picture(ground, pose(0.0, 6.0 * i)))
    for i in range(4, 6):
        assert tracker.track(i, foreign(20 + i)).verdict is Verdict.FEW_INLIERS
    assert tracker.track(6, foreign(20)).verdict is Verdict.FEW_INLIERS


@pytest.mark.parametrize("gray_value", [0, 128, 255])
def test_a_uniform_frame_is_not_registered(ground: np.ndarray, gray_value: int) -> None:
    blank = np.full((PINHOLE.height, PINHOLE.width, 3), gray_value, np.uint8)
    tracker = FrameTracker(PINHOLE)
    tracker.track(0, picture(ground, pose(0.0, 0.0)))
    assert tracker.track(1, blank).verdict is Verdict.FEW_INLIERS
    assert tracker.track(2, picture(ground, pose(0.0, 10.0))).verdict is Verdict.ACCEPTED


def test_uniform_frames_from_the_start_are_not_registered(ground: np.ndarray) -> None:
    blank = np.zeros((PINHOLE.height, PINHOLE.width, 3), np.uint8)
    tracker = FrameTracker(PINHOLE)
    for i in range(3):
        assert len(tracker.track(i, blank).two_view) == 0
    found = [tracker.track(3 + i, picture(ground, pose(0.0, 9.0 * i))) for i in range(MAX_TRACK_FAILURES + 3)]
    assert found[-1].verdict is Verdict.ACCEPTED and len(found[-1].two_view) > 0


def test_repeated_registration_failures_start_a_new_fragment() -> None:
    """Frames without matches: the last one starts a fragment, and later frames refer to it."""
    tracker = FrameTracker(PINHOLE)
    tracker.track(0, foreign(20))
    motions = [tracker.track(1 + i, foreign(21 + i)) for i in range(MAX_TRACK_FAILURES)]
    assert [m.verdict for m in motions[:-1]] == [Verdict.FEW_INLIERS] * (MAX_TRACK_FAILURES - 1)
    last = motions[-1]
    assert (last.verdict, last.keyframe_id, last.becomes_keyframe, len(last.two_view)) == (
        Verdict.ACCEPTED,
        MAX_TRACK_FAILURES,
        True,
        0,
    )
    place = texture(21 + MAX_TRACK_FAILURES - 1, 190.0)
    again = tracker.track(MAX_TRACK_FAILURES + 1, picture(place, pose(0.0, 6.0)))
    assert (again.verdict, again.keyframe_id) == (Verdict.ACCEPTED, MAX_TRACK_FAILURES)


def test_two_failed_frames_that_match_each_other_start_a_new_fragment(ground: np.ndarray) -> None:
    tracker = FrameTracker(PINHOLE)
    first, second = pose(-150.0, -150.0, 40.0), pose(-146.0, -141.0, 45.0)
    tracker.track(0, picture(ground, pose(100.0, 120.0)))
    tracker.track(1, picture(ground, pose(100.0, 128.0)))
    assert tracker.track(2, picture(ground, first)).verdict is Verdict.FEW_INLIERS
    motion = tracker.track(3, picture(ground, second))
    assert (motion.verdict, motion.keyframe_id) == (Verdict.ACCEPTED, 2)
    assert is_right(motion, first, second)


def test_tracking_is_deterministic(ground: np.ndarray) -> None:
    frames = [picture(ground, pose(0.0, 14.0 * i, 6.0 * i)) for i in range(4)] + [foreign()]
    runs = []
    for _ in range(2):
        tracker = FrameTracker(PINHOLE)
        runs.append([tracker.track(i, f) for i, f in enumerate(frames)])
    for a, b in zip(*runs, strict=True):
        assert np.array_equal(a.two_view, b.two_view)
        assert (a.verdict, a.keyframe_id, a.sigma_norm, a.inliers) == (
            b.verdict,
            b.keyframe_id,
            b.sigma_norm,
            b.inliers,
        )


def test_tracking_is_robust_to_noise_and_illumination(ground: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    tracker, first, second = FrameTracker(PINHOLE), pose(0.0, 0.0), pose(3.0, 12.0)
    tracker.track(0, picture(ground, first))
    darker = cv2.convertScaleAbs(picture(ground, second), alpha=0.9, beta=-2)
    noisy = cv2.add(darker, rng.normal(0.0, 4.0, darker.shape).round().astype(np.int16), dtype=cv2.CV_8U)
    motion = tracker.track(1, noisy)
    assert motion.verdict is Verdict.ACCEPTED and is_right(motion, first, second)


LINE_M = [(0.0, 50.0 * i, 0.0) for i in range(4)] + [(70.0, 150.0 - 50.0 * i, 180.0) for i in range(4)]  # a U-turn


def photos(ground: np.ndarray, places: list[tuple[float, float, float]]) -> list[tuple[Pose, np.ndarray]]:
    """Photos at (east, north, heading), each with another exposure."""
    found = []
    for i, (e_m, n_m, yaw_deg) in enumerate(places):
        at = pose(e_m - 35.0, n_m - 75.0, yaw_deg)
        found.append((at, cv2.convertScaleAbs(picture(ground, at), alpha=(1.0, 0.7, 1.2)[i % 3], beta=8 * (i % 3))))
    return found


def test_a_photo_is_registered_to_the_line_beside_it_that_was_flown_before(ground: np.ndarray) -> None:
    """A photo that the one before does not overlap, while the line before does; and further keyframes are linked."""
    tracker = FrameTracker(PINHOLE)
    places = [*LINE_M[:4], *LINE_M[5:]]  # the first photo of the second line is missing
    shots = photos(ground, places)
    motions = [tracker.track(i, shot) for i, (_, shot) in enumerate(shots)]
    assert [m.verdict for m in motions] == [Verdict.ACCEPTED] * 7
    assert {m.fragment_id for m in motions} == {0}
    assert motions[4].keyframe_id < 3  # the photo before, 3, is 86 m away
    for i, motion in enumerate(motions[1:], 1):
        assert is_right(motion, shots[motion.keyframe_id][0], shots[i][0])
        for link in motion.links:
            assert link.keyframe_id < i and link.keyframe_id != motion.keyframe_id
            seen = replace(motion, two_view=link.two_view)
            assert is_right(seen, shots[link.keyframe_id][0], shots[i][0])
            assert 15 <= len(link.two_view) <= MAX_ODOMETRY_PAIRS and link.inliers >= len(link.two_view)
            assert link.sigma_norm >= 0.75 / PINHOLE.fx
    assert sum(len(m.links) for m in motions) >= 3


@pytest.mark.parametrize(("frame_id", "verdict"), [(3, Verdict.ACCEPTED), (1 + WINDOW_NODES, Verdict.FEW_INLIERS)])
def test_a_photo_is_not_registered_to_one_that_the_estimator_no_longer_holds(
    ground: np.ndarray, frame_id: int, verdict: Verdict
) -> None:
    """Only the first photo shows the ground of the last one."""
    tracker = FrameTracker(PINHOLE)
    for i, (_, shot) in enumerate(photos(ground, LINE_M[:3])):
        tracker.track(i, shot)
    motion = tracker.track(frame_id, picture(ground, pose(-35.0, -123.0, 10.0)))
    assert motion.verdict is verdict
    assert verdict is Verdict.FEW_INLIERS or motion.keyframe_id == 0


def test_foreign_photos_are_linked_to_none(ground: np.ndarray) -> None:
    """Photos of another place, and mirrored ones, between the photos of a survey."""
    tracker, other = FrameTracker(PINHOLE), texture(33, 190.0)
    shots = photos(ground, LINE_M)
    strange = [picture(other, pose(0.0, 0.0)), np.ascontiguousarray(shots[1][1][:, ::-1])]
    motions = []
    for i, (_, shot) in enumerate(shots):
        motions.append(tracker.track(10 * i, shot))
        if i in (2, 5):
            stranger = tracker.track(10 * i + 1, strange[i == 5])
            assert (stranger.verdict, stranger.links) == (Verdict.FEW_INLIERS, ())
    assert all(m.verdict is Verdict.ACCEPTED and m.keyframe_id % 10 == 0 for m in motions)


def test_a_weak_pair_of_large_photos_is_compared_in_detail(monkeypatch: pytest.MonkeyPatch) -> None:
    """A strip of a fifth of the image overlaps: the larger copies show more of it, and at the right places."""
    camera = CameraCalibration(1440, 810, 855.0, 855.0, 719.5, 404.5)
    rng, ground = np.random.default_rng(0), texture(4, 420.0)
    ground = np.clip(ground + rng.normal(0.0, 20.0, (*ground.shape[:2], 1)), 0, 255).astype(np.uint8)  # gravel
    first, second = pose(0.0, -80.0, agl_m=200.0), pose(8.0, 75.0, yaw_deg=5.0, agl_m=200.0)
    images = [picture(ground, at, camera) for at in (first, second)]
    found = []
    for weak in (0, 1000):
        monkeypatch.setattr(covisibility, "WEAK_INLIERS", weak)
        tracker = FrameTracker(camera)
        for i, image in enumerate([picture(texture(9, 190.0), pose(0.0, 0.0), camera), *images]):
            found.append(tracker.track(i, image))
    assert found[5].inliers > 1.3 * found[2].inliers >= 15
    assert is_right(found[5], first, second)


def test_klt_tries_a_sample_of_the_corners_of_a_photo_and_follows_again_where_it_can(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried, flow = list[int](), feature_tracker.there_and_back

    def tries(*given: Any) -> tuple[np.ndarray, np.ndarray]:
        tried.append(len(given[2]))
        ahead, came_back = flow(*given)
        return ahead, came_back & (len(tried) > 3)

    monkeypatch.setattr(feature_tracker, "there_and_back", tries)
    tracker = FrameTracker(PINHOLE)
    for i in range(5):
        assert tracker.track(i, picture(ground, pose(2.0 * i, 0.0))).verdict is Verdict.ACCEPTED
    assert tried[0] == tried[4] > 300 and tried[1:4] == [-(-tried[0] // 8)] * 3
