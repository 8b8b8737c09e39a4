"""Sensor model of the simulated camera: each error has the configured effect, the same seed gives the same bytes."""

import cv2
import numpy as np
import pytest

from terrafix_lab.sim.camera.film import Developer, Film
from terrafix_lab.sim.camera.schedule import Schedule

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


def test_the_schedule_drops_delays_and_stalls_images() -> None:
    plan = Schedule(
        rate_hz=4.0, jitter_s=0.01, drop_share=0.1, delay_s=0.05, late_share=0.2, late_s=1.0, stalls_s=((100.0, 160.0),)
    )
    pictures = list(plan.exposures(1000.0))
    assert [p.index for p in pictures] == list(range(4000))
    assert max(abs(p.t_s - p.index / 4.0) for p in pictures) < 0.05
    stalled = [p for p in pictures if 100.0 <= p.t_s < 160.0]
    others = [p for p in pictures if not 100.0 <= p.t_s < 160.0]
    assert len(stalled) == pytest.approx(240, abs=2) and all(np.isinf(p.arrives_s) for p in stalled)
    arrived = [p for p in others if np.isfinite(p.arrives_s)]
    assert len(arrived) / len(others) == pytest.approx(0.9, abs=0.03)
    delays = np.array([p.arrives_s - p.t_s for p in arrived])
    assert delays.min() == pytest.approx(0.05) and delays.max() <= 1.05 + 1e-9
    assert float(np.mean(delays > 0.0501)) == pytest.approx(0.2, abs=0.03)
    assert list(plan.exposures(10.0)) == pictures[:40]
