"""The generated place: the seed decides everything, and two dates share structure but not brightness."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from terrafix.core.errors import OutputError
from terrafix_tools.sim import world

SMALL = {"width_m": 900.0, "height_m": 700.0}


@pytest.fixture(scope="module")
def place() -> world.World:
    return world.generate(5, **SMALL)


@pytest.fixture(scope="module")
def looks(place: world.World) -> tuple[np.ndarray, np.ndarray]:
    return place.look("summer"), place.look("autumn")


def test_the_same_seed_gives_the_same_place(place: world.World, looks: tuple[np.ndarray, np.ndarray]) -> None:
    again = world.generate(5, **SMALL)
    assert np.array_equal(again.look("summer"), looks[0])
    assert np.array_equal(again.dem_amsl_m, place.dem_amsl_m)


def test_another_seed_gives_another_place(looks: tuple[np.ndarray, np.ndarray]) -> None:
    other = world.generate(6, **SMALL).look("summer")
    assert float(np.mean(other != looks[0])) > 0.8


def test_there_is_a_relief_of_tens_of_metres() -> None:
    relief = np.ptp(world.generate(5).dem_amsl_m)
    assert 25.0 < relief < 120.0


def oriented(grey: np.ndarray) -> list[np.ndarray]:
    """Edge strength in four directions, blind to the sign of the contrast."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.5)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    strength, angle = np.hypot(gx, gy), np.arctan2(gy, gx)
    strength = np.minimum(strength / (cv2.GaussianBlur(strength, (0, 0), 20) + 1e-3), 2.0)
    return [cv2.GaussianBlur(strength * np.cos(angle - k * np.pi / 4) ** 8, (0, 0), 2) for k in range(4)]


def found(surface: np.ndarray, margin: int) -> bool:
    """The best place is within 5 m of the true one."""
    x, y = cv2.minMaxLoc(surface)[3]
    return bool(np.hypot(x - margin, y - margin) <= 10)


def test_two_dates_agree_in_structure_but_not_in_brightness(looks: tuple[np.ndarray, np.ndarray]) -> None:
    summer, autumn = (cv2.cvtColor(look, cv2.COLOR_BGR2GRAY) for look in looks)
    assert abs(float(np.corrcoef(summer.ravel(), autumn.ravel())[0, 1])) < 0.5
    size, margin, by_edges, by_pixels, tried = 300, 120, 0, 0, 0
    for y in range(margin, summer.shape[0] - size - margin, 200):
        for x in range(margin, summer.shape[1] - size - margin, 200):
            patch = autumn[y : y + size, x : x + size]
            window = summer[y - margin : y + size + margin, x - margin : x + size + margin]
            pairs = zip(oriented(window), oriented(patch), strict=True)
            edges = np.sum([cv2.matchTemplate(a, b - b.mean(), cv2.TM_CCORR) for a, b in pairs], axis=0)
            by_edges += found(edges, margin)
            by_pixels += found(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED), margin)
            tried += 1
    assert tried >= 12
    assert by_edges >= 0.9 * tried
    assert by_pixels < 0.7 * tried


def test_the_rasters_say_where_they_are(
    place: world.World, looks: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    world.write_image(tmp_path / "map.tif", place, looks[0])
    world.write_dem(tmp_path / "dem.tif", place)
    with rasterio.open(tmp_path / "map.tif") as image, rasterio.open(tmp_path / "dem.tif") as dem:
        assert image.crs == dem.crs and image.crs.to_epsg() == world.EPSG
        assert image.bounds.right - image.bounds.left == 900.0
        assert image.bounds.top - image.bounds.bottom == 700.0
        rgb = np.moveaxis(image.read(), 0, 2).astype(float)
        assert float(np.abs(rgb[..., ::-1] - looks[0]).mean()) < 6.0  # JPEG
        east, north = image.bounds.left + 400.0, image.bounds.top - 300.0
        row, column = round((300.0 + 300.0) / 10.0), round((400.0 + 300.0) / 10.0)  # plan: 300 m margin, 10 m posts
        assert float(next(dem.sample([(east, north)]))[0]) == pytest.approx(float(place.dem_amsl_m[row, column]))


def test_an_unwritable_place_is_one_clear_line(place: world.World, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        world.write_dem(tmp_path / "missing" / "dem.tif", place)
