"""The null model of a package: fitted to mirrored flights over the same map, covered by the signature."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import map_rasters
from map_packages import alter, bound
from terrafix.core.errors import MapError, UsageError
from terrafix.map.format import MANIFEST_TABLE
from terrafix.map.null_model import SCORE_VERSION, null_row_for
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.cli import app
from terrafix_tools.mapping.package import null_model
from terrafix_tools.mapping.package.null_model import CAMERA, Strip, _strip

SIDE_PX, AGL_M = 500, 50.0  # 250 m


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("null")
    return map_rasters.utm(folder / "i.tif", map_rasters.texture(SIDE_PX, SIDE_PX, seed=4))


@pytest.fixture(scope="module")
def measured(image: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package with the null model of two short flights."""
    with pytest.MonkeyPatch.context() as short:
        short.setattr(null_model, "FLIGHTS", 2)
        short.setattr(null_model, "STRETCHES", 2)
        out = tmp_path_factory.mktemp("measured") / "m.gpkg"
        return build_package([layer_of(image)], out, null_agl_m=(AGL_M,))


def test_a_package_stores_its_null_model(measured: Path) -> None:
    opened = MapPackage.open(measured, verify=True)  # checksum and file digest include it
    model = opened.layer().null_model
    assert model is not None and (model.version, model.matcher) == (SCORE_VERSION, "gradient")
    row = null_row_for(model, "gradient", 2.0 * AGL_M)
    assert row is model.rows[0] and row.agl_m == AGL_M
    assert row.places > 100.0  # 12 by 12 neighbours, at several headings and heights
    assert 0.0 < row.search.share < 1.0 and row.search.count > 10.0
    assert row.frame.count > 10.0 and row.frame.above > row.patches[0]
    assert row.detection_threshold(row.places, -8.0) > row.search.above


@pytest.mark.slow
def test_the_null_model_is_deterministic(measured: Path) -> None:
    model = MapPackage.open(measured).layer().null_model
    assert model is not None and null_model.fit_null_row(bound(measured), AGL_M, 2, 2) == model.rows[0]


def test_without_a_height_no_null_model_is_built(image: Path, tmp_path: Path) -> None:
    path = build_package([layer_of(image)], tmp_path / "m.gpkg")
    assert MapPackage.open(path).layer().null_model is None


def test_an_altered_null_model_is_detected(measured: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(measured, tmp_path / "m.gpkg"))
    above = "'$[0].null_model.rows[0].search.above', -50.0"
    alter(path, f"UPDATE {MANIFEST_TABLE} SET value = json_set(value, {above}) WHERE key = 'layers'")
    with pytest.raises(MapError, match="checksum mismatch"):
        MapPackage.open(path)


@pytest.mark.slow
def test_a_map_too_small_for_a_null_model_is_reported_and_leaves_no_file(image: Path, tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match=r"no straight path of 720 m at 300 m above ground fits on the map; give --null-agl"
    ):
        build_package([layer_of(image)], tmp_path / "m.gpkg", null_agl_m=(300.0,))
    assert not list(tmp_path.iterdir())


class InTheMiddle:
    """A random generator that draws the centre of every range, and no rotation."""

    def uniform(self, low: float, high: float) -> float:
        return 0.0 if high == 360.0 else 0.5 * (low + high)


def test_null_model_flights_use_mirrored_map_ground(image: Path, tmp_path: Path) -> None:
    local = bound(build_package([layer_of(image)], tmp_path / "m.gpkg"))
    draw: Any = InTheMiddle()
    strip = _strip(local, AGL_M, 1, draw)
    gsd_m = AGL_M / CAMERA.fx
    h, w = strip.picture.shape[:2]
    e_min, n_min, e_max, n_max = local.bounds_m
    middle = 0.5 * (e_min + e_max), 0.5 * (n_min + n_max)
    as_it_lies, _ = local.window(middle[0] - w / 2 * gsd_m, middle[1] + h / 2 * gsd_m, w, h, gsd_m)

    def alike(a: np.ndarray, b: np.ndarray) -> float:
        inner = (slice(8, -8), slice(8, -8))
        return float(np.corrcoef(a[inner].ravel(), b[inner].ravel())[0, 1])

    assert alike(strip.picture[:, ::-1], as_it_lies) > 0.97 > 0.5 > alike(strip.picture, as_it_lies)


def test_the_null_model_camera_moves_along_the_strip_in_steps() -> None:
    picture = np.random.default_rng(1).integers(0, 255, (CAMERA.height, 2 * CAMERA.width, 3), np.uint8)
    strip = Strip(picture, 20.4)
    assert (strip.frame(0)[:, 41:] == strip.frame(2)[:, :-41]).all()
    assert strip.frame(3).shape == (CAMERA.height, CAMERA.width, 3)


def test_the_null_model_is_built_for_the_heights_of_the_command_line(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heights = list[list[float]]()
    monkeypatch.setattr(
        "terrafix_tools.mapping.build.add_null_models", lambda _part, heights_m: heights.append([*heights_m])
    )
    out = str(tmp_path / "m.gpkg")
    run = CliRunner().invoke(app, ["build", str(image), "--out", out, "--null-agl", "50", "--null-agl", "120"])
    assert run.exit_code == 0 and heights == [[50.0, 120.0]]
    again = CliRunner().invoke(app, ["build", str(image), "--out", str(tmp_path / "n.gpkg")])
    assert again.exit_code == 0 and len(heights) == 1
    assert CliRunner().invoke(app, ["build", str(image), "--out", out, "--null-agl", "10"]).exit_code == 2
