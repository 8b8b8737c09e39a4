"""Sensor model of the simulated camera: each error has the configured effect, the same seed gives the same bytes."""

import cv2
import numpy as np
import pytest

from terrafix_lab.sim.camera.film import Developer, Film

WIDTH, HEIGHT = 320, 240
IDEAL = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, detail=0.0)


def developer(film: Film, seed: int = 3) -> Developer:
    return Developer(film, WIDTH, HEIGHT, (159.5, 119.5), seed)


def grey(value: int = 120) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


def test_a_film_without_errors_leaves_the_image_unchanged() -> None:
    image = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert np.array_equal(developer(IDEAL).develop(image, 5), image)


def test_noise_has_the_configured_sigma_and_differs_between_images() -> None:
    film = Film(noise=3.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0)
    first, second = (developer(film).develop(grey(), i).astype(float) - 120.0 for i in (0, 1))
    assert first.std() == pytest.approx(3.0, rel=0.05)
    assert abs(float(np.corrcoef(first.ravel(), second.ravel())[0, 1])) < 0.02


def test_vignetting_darkens_the_corners() -> None:
    film = Film(noise=0.0, vignette=0.3, blur_px=0.0, exposure_jitter=0.0)
    image = developer(film).develop(grey(200), 0)
    assert image[120, 160, 0] == pytest.approx(200, abs=2) and image[0, 0, 0] == pytest.approx(140, abs=3)


def test_an_automatic_exposure_keeps_its_gain_for_several_images() -> None:
    film = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, exposure_step=0.2)
    means = [float(developer(film).develop(grey(), i).mean()) for i in range(48)]
    assert len(set(means)) == 4  # twelve images each
    assert max(means) / min(means) > 1.05


def test_motion_blur_is_as_long_as_the_motion() -> None:
    edge = grey(40)
    edge[:, 160:] = 200
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow[..., 0] = 1000.0
    film = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, exposure_s=0.012)
    row = developer(film).develop(edge, 0, flow)[100, :, 0].astype(float)
    ramp = np.flatnonzero((row > 44) & (row < 196))
    assert 10 <= np.ptp(ramp) + 1 <= 14  # 12 px
    assert row[160 - 1 : 160 + 1].mean() == pytest.approx(120, abs=10)  # centred on the pose
    across = np.stack([np.zeros_like(flow[..., 0]), flow[..., 0]], axis=-1)
    assert np.array_equal(developer(film).develop(edge, 0, across), edge)  # motion along the edge has no effect


def test_jpeg_compression_equals_that_of_opencv() -> None:
    image = np.random.default_rng(2).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    film = Film(noise=0.0, vignette=0.0, blur_px=0.0, exposure_jitter=0.0, jpeg_quality=60)
    assert np.array_equal(developer(film).develop(image, 0), cv2.imdecode(packed, cv2.IMREAD_COLOR))


def test_the_same_seed_gives_the_same_bytes() -> None:
    film = Film(exposure_step=0.1, jpeg_quality=80)
    image = np.random.default_rng(2).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    first, second = developer(film), developer(film)
    first.develop(image, 1)
    assert np.array_equal(first.develop(image, 9), second.develop(image, 9))
    assert not np.array_equal(first.develop(image, 9), developer(film, seed=4).develop(image, 9))
