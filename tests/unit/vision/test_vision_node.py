"""The vision node: verdicts of images that are not usable as measurements."""

import msgspec
import numpy as np

from origins import origin_of
from terrafix.core.camera import CameraCalibration
from terrafix.core.frames import MemoryFrameStore
from terrafix.messages import Camera, Frame, KeyframeLink, Odometry, Origin, Verdict
from terrafix.vision.feature_tracker import FrameTracker, KeyframeMatches, Motion
from terrafix.vision.node import VisionNode
from terrafix.vision.relocalization import RelocalizationSearch

CAMERA = Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
ORIGIN = origin_of(CAMERA)


def picture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    return np.repeat(np.repeat(coarse, 10, axis=0), 10, axis=1)


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 2, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def odometry(
    images: list[np.ndarray], origins: dict[int, Origin] | None = None, *, restarted: bool = False, first_id: int = 0
) -> list[Odometry]:
    """``origins``: published before the frame of that index, after the first one. ``first_id``: of the first frame."""
    store = MemoryFrameStore()
    node = VisionNode(store, restarted=restarted)
    list(node.on(ORIGIN))
    published = []
    for i, image in enumerate(images, first_id):
        if origins and i in origins:
            list(node.on(origins[i]))
        store.put(i, image)
        published += list(node.on(Frame(t_ns=i * 500_000_000, frame_id=i, file=f"{i}.jpg", width=640, height=480)))
    return [m for m in published if isinstance(m, Odometry)]


def verdicts(images: list[np.ndarray]) -> list[Verdict]:
    return [m.verdict for m in odometry(images)]


def test_identical_images_are_stalled_until_a_new_one_arrives() -> None:
    still = picture(1)
    frames = [noisy(still, 1), noisy(still, 2), noisy(still, 2), noisy(still, 2), noisy(still, 3)]
    published = verdicts(frames)
    assert published[2:4] == [Verdict.STALLED, Verdict.STALLED]
    assert published[1] is Verdict.ACCEPTED and published[4] is Verdict.ACCEPTED


def test_a_stationary_camera_is_not_stalled() -> None:
    still = picture(2)
    assert Verdict.STALLED not in verdicts([noisy(still, i) for i in range(5)])


def test_an_image_that_equals_the_previous_one_except_for_noise_is_static() -> None:
    published = odometry([noisy(picture(1), 1), noisy(picture(1), 2), noisy(picture(2), 3)])
    assert [m.static for m in published] == [False, True, False]


def test_a_stale_buffer_is_stalled() -> None:
    published = verdicts([noisy(picture(1), 1), noisy(picture(2), 2), noisy(picture(1), 3)])
    assert published[2] is Verdict.STALLED


def test_a_repeated_origin_changes_nothing_and_a_different_one_resets_the_tracker() -> None:
    still = noisy(picture(1), 1)
    assert odometry([still, still], {1: ORIGIN})[1].verdict is Verdict.STALLED
    other = odometry([still, still], {1: msgspec.structs.replace(ORIGIN, start_sigma_m=20.0)})[1]
    assert other.verdict is Verdict.ACCEPTED and other.becomes_keyframe


def test_three_view_matches_and_links_carry_the_ids_of_their_keyframes() -> None:
    store = MemoryFrameStore()
    node = VisionNode(store)
    list(node.on(ORIGIN))
    seen = np.arange(6.0).reshape(1, 6)
    links = (KeyframeMatches(1, seen[:, 2:], 0.003, 20, 25),)
    motion = Motion(4, Verdict.ACCEPTED, seen[:, :4], 0.001, 30, 40, True, 2, seen, 0.002, fragment_id=3, links=links)
    camera = CameraCalibration.of(ORIGIN.camera)
    node._tracker, node._search = FrameTracker(camera), RelocalizationSearch(camera)
    node._tracker.register = lambda frame_id, gray, image: motion  # type: ignore[method-assign]
    store.put(5, picture(1))
    (published,) = node.on(Frame(t_ns=0, frame_id=5, file="5.jpg", width=640, height=480))
    assert isinstance(published, Odometry)
    assert (published.previous_keyframe_id, published.keyframe_id, published.three_view_sigma_norm) == (2, 4, 0.002)
    assert published.fragment_id == 3
    link = KeyframeLink(keyframe_id=1, two_view=[(2.0, 3.0, 4.0, 5.0)], sigma_norm=0.003, inliers=20, tracked=25)
    assert published.links == [link]
    assert published.two_view == [(0.0, 1.0, 2.0, 3.0)] and published.three_view == [(0.0, 1.0, 2.0, 3.0, 4.0, 5.0)]


def test_frames_that_overlap_are_of_one_fragment_and_one_without_overlap_begins_the_next() -> None:
    first, second = noisy(picture(1), 1), [noisy(picture(2), seed) for seed in (2, 3)]
    assert [m.fragment_id for m in odometry([first, noisy(picture(1), 4), *second])] == [0, 0, -1, 1]


def test_a_process_that_restarts_in_flight_numbers_no_fragment_as_the_one_before_did() -> None:
    images = [noisy(picture(1), 1), noisy(picture(2), 2), noisy(picture(2), 3)]
    assert [m.fragment_id for m in odometry(images, restarted=True, first_id=70)] == [70, -1, 71]
    assert [m.fragment_id for m in odometry(images, first_id=70)] == [0, -1, 1]
