"""The list of training places: co-registration by georeference, held-out places. Needs no PyTorch."""

import hashlib
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rasterio.transform import Affine

import map_rasters
from terrafix_lab.train import ground as ground_module
from terrafix_lab.train.errors import TrainingError
from terrafix_lab.train.ground import MIN_SIDE_PX, Place, inputs_of, read_list, read_places
from terrafix_tools.models.matching import read_sets

GSD_M = 0.5


def geotiff(path: Path, picture: np.ndarray, west_m: float, north_m: float, gsd_m: float = GSD_M) -> None:
    """``picture`` (H, W, 3) RGB."""
    corner = Affine(gsd_m, 0, west_m, 0, -gsd_m, north_m)
    map_rasters.write_tif(path, picture.transpose(2, 0, 1), "EPSG:32633", corner)


def ground(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def test_dates_of_a_place_are_cropped_to_their_common_area(tmp_path: Path) -> None:
    whole = ground(1, 800, 900)
    geotiff(tmp_path / "a.tif", whole[:700, :850], 1000.0, 5000.0)
    geotiff(tmp_path / "b.tif", whole[20:, 31:], 1000.0 + 31 * GSD_M, 5000.0 - 20 * GSD_M)
    levels = read_places([Place(name="here", pictures=["a.tif", "b.tif"])], tmp_path)
    assert levels[0].pictures.shape == (2, 3, 680, 819)
    expected = whole[20:700, 31:850].transpose(2, 0, 1)
    np.testing.assert_array_equal(levels[0].pictures[0], expected)
    np.testing.assert_array_equal(levels[0].pictures[1], expected)


def test_a_large_place_has_several_scale_levels(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), ground(1, 1400, 1300))
    levels = read_places([Place(name="here", pictures=["a.png"])], tmp_path)
    assert [level.pictures.shape for level in levels] == [(1, 3, 1400, 1300), (1, 3, 700, 650)]
    assert levels[0].heights_px is None


def test_a_generated_place_has_its_seasons_and_its_relief_at_every_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground_module, "GENERATED_M", 400.0)
    fine, coarse = read_places([Place(name="here", generated=7)], Path())
    assert fine.pictures.shape == (4, 3, 800, 800) and coarse.pictures.shape == (4, 3, 400, 400)
    assert fine.heights_px is not None and coarse.heights_px is not None
    assert abs(float(fine.heights_px.mean())) < 2.0 < float(np.ptp(fine.heights_px))
    assert np.ptp(coarse.heights_px) == pytest.approx(0.5 * np.ptp(fine.heights_px), rel=0.1)
    assert len({picture.tobytes() for picture in fine.pictures}) == 4


def test_every_input_is_listed_with_its_licence_and_checksum(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground_module, "GENERATED_M", 200.0)
    (tmp_path / "a.tif").write_bytes(b"image")
    places = [Place(name="a", pictures=["a.tif"], licence="CC0"), Place(name="b", generated=7, held_out=True)]
    image, generated = inputs_of(places, tmp_path)
    assert image == {
        "name": "a.tif",
        "use": "trained on",
        "licence": "CC0",
        "sha256": hashlib.sha256(b"image").hexdigest(),
    }
    assert generated["use"] == "held out" and len(generated["sha256"]) == 64


@pytest.mark.parametrize(
    "second, reason",
    [
        ({"west_m": 1000.0, "gsd_m": 0.6}, "another size"),
        ({"west_m": 1000.0 + 600 * GSD_M}, f"less than {MIN_SIDE_PX} px"),
        ({"west_m": 90_000.0}, f"less than {MIN_SIDE_PX} px"),
    ],
)
def test_dates_with_mismatching_grids_are_rejected(tmp_path: Path, second: dict[str, float], reason: str) -> None:
    geotiff(tmp_path / "a.tif", ground(1, 800, 800), 1000.0, 5000.0)
    geotiff(tmp_path / "b.tif", ground(2, 800, 800), north_m=5000.0, **second)
    with pytest.raises(TrainingError, match=reason):
        read_places([Place(name="here", pictures=["a.tif", "b.tif"])], tmp_path)


def test_images_without_georeference_must_have_one_size(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), ground(1, 800, 800))
    cv2.imwrite(str(tmp_path / "b.png"), ground(1, 800, 801))
    with pytest.raises(TrainingError, match="not georeferenced"):
        read_places([Place(name="here", pictures=["a.png", "b.png"])], tmp_path)


def listed(*places: tuple[str, str, bool]) -> str:
    return "".join(
        f'[[place]]\nname = "{name}"\nlicence = "mine"\npictures = ["{picture}"]\nheld_out = {str(held_out).lower()}\n'
        for name, picture, held_out in places
    )


@pytest.mark.parametrize(
    "text, reason",
    [
        (listed(("a", "a.tif", False), ("b", "b.tif", False)), "held_out = true"),
        (listed(("a", "a.tif", True)), "to train on"),
        (listed(("a", "a.tif", False), ("a", "b.tif", True)), "one name"),
        (listed(("a", "a.tif", False), ("b", "a.tif", True)), "a.tif is trained on and held out"),
        ("[[place]]\nname = 'a'\n", "pictures"),
        ("[[place]]\nname = 'a'\npictures = ['a.tif']\n", "a states no licence"),
        ("[[place]]\nname = 'a'\npictures = ['a.tif']\ngenerated = 3\n", "state one"),
        ("[place", "no list of places"),
    ],
)
def test_an_invalid_place_list_is_rejected(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "places.toml"
    path.write_text(text)
    with pytest.raises(TrainingError, match=reason):
        read_list(path)


def test_what_judges_weights_neither_trains_them_nor_stops_the_training() -> None:
    lists = Path(__file__).parents[3] / "config/training"
    judges = {path for one in read_sets(lists / "judges.toml") for path in (one.camera, one.map) if path}
    assert judges and judges.isdisjoint(path for place in read_list(lists / "places.toml") for path in place.pictures)


def test_without_pytorch_the_error_names_the_package_to_install() -> None:
    code = (
        "import runpy, sys; sys.modules['torch'] = None; sys.argv = ['train', 'x.toml', '--out', 'y'];"
        "runpy.run_module('terrafix_lab.train', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr == "training needs PyTorch; install it: pip install 'terrafix[train]'\n"
