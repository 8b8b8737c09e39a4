"""The vision node: what it says of pictures that are no measurement."""

import numpy as np

from terrafix.core.frames import MemoryFrameStore
from terrafix.messages import Camera, Frame, Odometry, Origin, Verdict
from terrafix.vision.node import VisionNode

CAMERA = Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
ORIGIN = Origin(
    t_ns=0,
    camera=CAMERA,
    lat_deg=47.0,
    lon_deg=8.0,
    ground_amsl_m=0.0,
    start_sigma_m=10.0,
    yaw_sigma_deg=3.0,
    agl_sigma_m=3.0,
    attitude_sigma_deg=1.0,
)


def picture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    return np.repeat(np.repeat(coarse, 10, axis=0), 10, axis=1)


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 2, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def verdicts(images: list[np.ndarray]) -> list[Verdict]:
    store = MemoryFrameStore()
    node = VisionNode(store)
    list(node.on(ORIGIN))
    said = []
    for i, image in enumerate(images):
        store.put(i, image)
        said += list(node.on(Frame(t_ns=i * 500_000_000, frame_id=i, file=f"{i}.jpg", width=640, height=480)))
    return [m.verdict for m in said if isinstance(m, Odometry)]


def test_a_camera_that_repeats_its_picture_is_stalled_until_a_new_one_comes() -> None:
    still = picture(1)
    frames = [noisy(still, 1), noisy(still, 2), noisy(still, 2), noisy(still, 2), noisy(still, 3)]
    said = verdicts(frames)
    assert said[2:4] == [Verdict.STALLED, Verdict.STALLED]
    assert said[1] is Verdict.ACCEPTED and said[4] is Verdict.ACCEPTED


def test_standing_still_over_the_same_ground_is_not_a_stall() -> None:
    still = picture(2)
    assert Verdict.STALLED not in verdicts([noisy(still, i) for i in range(5)])
