"""The generated place: a function of the seed, seamless, and dates that share structure but not brightness."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from terrafix.core.errors import OutputError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.ground.detail import detail
from terrafix_lab.sim.world import place as world
from terrafix_lab.sim.world.noise import smooth, white
from terrafix_lab.sim.world.paint import Painter
from terrafix_lab.sim.world.season import SEASONS

SMALL = {"width_m": 900.0, "height_m": 700.0}


@pytest.fixture(scope="module")
def place() -> world.World:
    return world.generate(5, **SMALL)


@pytest.fixture(scope="module")
def looks(place: world.World) -> tuple[np.ndarray, np.ndarray]:
    return place.render("summer"), place.render("autumn")


def test_the_same_seed_gives_the_same_place(place: world.World, looks: tuple[np.ndarray, np.ndarray]) -> None:
    again = world.generate(5, **SMALL)
    assert np.array_equal(again.render("summer"), looks[0])
    assert np.array_equal(again.dem_amsl_m, place.dem_amsl_m)


def test_another_seed_gives_another_place(looks: tuple[np.ndarray, np.ndarray]) -> None:
    other = world.generate(6, **SMALL).render("summer")
    assert float(np.mean(other != looks[0])) > 0.8


def test_the_relief_has_tens_of_metres() -> None:
    relief = np.ptp(world.generate(5).dem_amsl_m)
    assert 25.0 < relief < 120.0


def nearly_equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal except for the rounding of sub-pixel edges, which depends on the origin of the canvas."""
    off = np.abs(a.astype(int) - b)
    return bool(off.max() <= 4 and np.mean(off > 0) < 1e-3)


def test_pieces_of_any_size_fit_without_a_seam(place: world.World, looks: tuple[np.ndarray, np.ndarray]) -> None:
    painter = Painter(place.layout, SEASONS["summer"], place.gsd_m)
    for column, row, width, height in ((0, 0, 300, 200), (777, 431, 512, 333), (1300, 900, 500, 500)):
        part = painter.paint(column, row, width, height)
        assert nearly_equal(part, looks[0][row : row + height, column : column + width])


def test_a_larger_place_contains_the_smaller_one(looks: tuple[np.ndarray, np.ndarray]) -> None:
    larger = world.generate(5, width_m=1500.0, height_m=800.0)
    part = Painter(larger.layout, SEASONS["summer"], larger.gsd_m).paint(0, 0, 1800, 1400)
    assert float(np.mean(part == looks[0])) > 0.999  # the illumination at the edge of the elevation model differs


def test_the_ground_of_a_flight_equals_the_rendered_image(
    place: world.World, looks: tuple[np.ndarray, np.ndarray]
) -> None:
    ground = place.ground("summer", LocalFrame(*place.wgs84(450.0, 350.0)))
    assert nearly_equal(ground.picture.window(0, 900, 950, 700, 400), looks[0][950:1350, 900:1600])
    halved = cv2.resize(looks[0][:1400, :1800], (900, 700), interpolation=cv2.INTER_AREA)
    assert np.abs(ground.picture.window(1, 0, 0, 900, 700).astype(int) - halved).max() <= 1
    x, y = ground.px_from_local(np.array([0.0]), np.array([0.0]))
    assert (x[0], y[0]) == pytest.approx((899.5, 699.5), abs=0.01)


@pytest.mark.slow
def test_every_season_is_a_different_image_of_one_place(place: world.World) -> None:
    pictures = {name: place.render(name).astype(float).mean(axis=2).ravel() for name in SEASONS}
    assert len(pictures) >= 3
    for first in pictures:
        for second in pictures:
            assert first == second or np.corrcoef(pictures[first], pictures[second])[0, 1] < 0.75


def test_noise_is_not_periodic_and_has_no_grid() -> None:
    far = white(9, 4096, -2048, 256, 256)
    for dx, dy in ((1024, 0), (0, 1024), (65536, 0), (1024, 1024)):
        assert abs(float(np.corrcoef(far.ravel(), white(9, 4096 + dx, -2048 + dy, 256, 256).ravel())[0, 1])) < 0.02
    assert far.mean() == pytest.approx(0.0, abs=0.01) and far.std() == pytest.approx(1.0, abs=0.01)
    for sigma_px in (0.7, 6.0, 45.0):
        field = smooth(3, sigma_px, -700, 300, 2000, 2000)
        assert field.std() == pytest.approx(1.0, abs=0.15)
        assert np.abs(smooth(3, sigma_px, -200, 500, 300, 300) - field[200:500, 500:800]).max() < 1e-3
    spread = smooth(3, 6.0, 0, 0, 1600, 1600).reshape(400, 4, 400, 4).std(axis=(0, 2))  # by the place in the lattice
    assert spread.max() / spread.min() < 1.03
    tiles = detail(4, 0.05)
    fine = tiles.window(0, 900, 900, 500, 500).astype(float)
    for dx, dy in ((1024, 0), (0, 1024), (1024, 1024), (2048, 0)):
        assert abs(float(np.corrcoef(fine.ravel(), tiles.window(0, 900 + dx, 900 + dy, 500, 500).ravel())[0, 1])) < 0.05
    jump = np.abs(np.diff(fine, axis=1)).mean(axis=0)
    assert jump[1023 - 900] < 1.3 * np.median(jump)  # no seam between tiles


MEMORY = """
import re, sys
from pathlib import Path
import cv2, numpy as np
from terrafix import messages as m
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.world import place as world
from terrafix_lab.sim.camera.render import Renderer
cv2.setNumThreads(1)
place = world.generate(3, width_m=10_000.0, height_m=10_000.0)
ground = place.ground("autumn", LocalFrame(*place.wgs84(5000.0, 5000.0)))
camera = m.Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5)
renderer = Renderer(ground, camera)
for index, at_m in enumerate(np.arange(-4800.0, 4801.0, 800.0)):
    renderer.frame(np.array([at_m, 0.7 * at_m, 520.0]), np.diag([1.0, -1.0, -1.0]), index)
# Not ru_maxrss, which includes the parent process.
print(int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) // 1024)
"""


@pytest.mark.nightly
@pytest.mark.slow
def test_a_hundred_square_kilometres_are_not_held_in_memory() -> None:
    """The image alone would be 1200 MB; the flight crosses all of it."""
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True, timeout=900)
    assert int(done.stdout) < 600


def test_a_place_of_invalid_size_is_one_clear_line() -> None:
    for width_m, height_m in ((0.0, 700.0), (float("nan"), 700.0), (20_000.0, 20_000.0)):
        with pytest.raises(UsageError, match="choose at least 100 m"):
            world.generate(1, width_m=width_m, height_m=height_m)


def oriented(grey: np.ndarray) -> list[np.ndarray]:
    """Edge strength in four directions, independent of the sign of the contrast."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.5)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    strength, angle = np.hypot(gx, gy), np.arctan2(gy, gx)
    strength = np.minimum(strength / (cv2.GaussianBlur(strength, (0, 0), 20) + 1e-3), 2.0)
    return [cv2.GaussianBlur(strength * np.cos(angle - k * np.pi / 4) ** 8, (0, 0), 2) for k in range(4)]


def found(surface: np.ndarray, margin: int) -> bool:
    """True if the maximum is within 5 m of the true position."""
    x, y = cv2.minMaxLoc(surface)[3]
    return bool(np.hypot(x - margin, y - margin) <= 10)


@pytest.mark.slow
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


def test_the_rasters_are_georeferenced(
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


def test_a_place_is_written_piece_by_piece(
    place: world.World, looks: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    place.write_rendering(tmp_path / "map.tif", "summer")
    world.write_image(tmp_path / "whole.tif", place, looks[0])
    with rasterio.open(tmp_path / "map.tif") as pieces, rasterio.open(tmp_path / "whole.tif") as whole:
        assert pieces.transform == whole.transform
        assert np.array_equal(pieces.read(), whole.read())
