"""Place index: written by ``terrafix map index``, opened in flight, several packages in one, checksums, positions."""

import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

import map_rasters
from terrafix.anchor.node import make_node
from terrafix.anchor.place_index import index as place_index
from terrafix.anchor.place_index.faiss_ivf import FaissSearch
from terrafix.anchor.place_index.format import FAISS, HEADER_FILE, POSITIONS, VECTORS, Header, read_header
from terrafix.anchor.place_index.index import PlaceIndex
from terrafix.anchor.place_index.recognizer import PlaceMemory
from terrafix.core.config import Places, load
from terrafix.core.errors import MapError, ModelError, OutputError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import NodeContext
from terrafix.map.package import MapPackage
from terrafix_engines.retrieval.places import PooledGradientPlaces
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.place_index import IndexOptions, write_index

AGL_M, SIDE_M, STEP_M = 60.0, 45.0, 11.25
OPTIONS = IndexOptions(AGL_M, "pooled-gradient", faiss=True)


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two maps of 300 x 200 m of different ground; the second has a hole."""
    folder = tmp_path_factory.mktemp("maps")
    made = []
    for seed, name in ((1, "a"), (2, "b")):
        bands = map_rasters.texture(400, 600, seed=seed)
        if name == "b":
            bands[:, 150:250, 200:300] = 0
        tif = map_rasters.utm(folder / f"{name}.tif", bands, nodata=0)
        made.append(build(tif, folder / f"{name}.gpkg"))
    return made


@pytest.fixture(scope="module")
def folder(packages: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("index") / "places"
    write_index(packages, out, OPTIONS)
    return out


def disc_at(path: Path, lat_deg: float, lon_deg: float) -> np.ndarray:
    """Descriptor of the map's ground around a position."""
    describer = PooledGradientPlaces()
    local = MapPackage.open(path).bind(LocalFrame(lat_deg, lon_deg))
    side_px = describer.side_px
    image, _ = local.window(-SIDE_M / 2, SIDE_M / 2, side_px, side_px, SIDE_M / side_px)
    return describer.describe(image[None])


@pytest.mark.parametrize("search", ["exact", "faiss"])
def test_the_ground_at_the_position_of_a_disc_is_that_disc(folder: Path, packages: list[Path], search: str) -> None:
    index = PlaceIndex.open(folder, search)  # type: ignore[arg-type]
    for disc in (0, 40, index.header.layers[1].first + 5, index.header.count - 1):
        layer = index.layer_of(disc)
        path = next(p for p in packages if p.name == layer.package)
        found = index.find(disc_at(path, *index.position_deg(disc)), 3)
        assert found[0].id == disc and found[0].score > 0.97
        assert found[1].score < found[0].score


def test_the_discs_cover_the_map_except_its_hole(folder: Path, packages: list[Path]) -> None:
    first, second = PlaceIndex.open(folder).header.layers
    columns, rows = (300 - SIDE_M) // STEP_M + 1, (200 - SIDE_M) // STEP_M + 1
    assert first.count == pytest.approx(columns * rows, abs=columns + rows)
    assert second.first == first.count
    assert first.count - second.count == pytest.approx((50 + 0.7 * SIDE_M) ** 2 / STEP_M**2, rel=0.35)
    assert (first.package, second.package) == ("a.gpkg", "b.gpkg")


def test_a_layer_and_a_prior_filter_the_search(folder: Path, packages: list[Path]) -> None:
    index = PlaceIndex.open(folder)
    second = index.layer(MapPackage.open(packages[1]).manifest.checksum, "imagery")
    assert second is not None and index.layer("of another build", "imagery") is None
    query = disc_at(packages[0], *index.position_deg(40))
    within = index.within(second)
    assert within is not None and within.sum() == second.count
    assert all(one.id >= second.first for one in index.find(query, 5, within))
    lat_deg, lon_deg = index.position_deg(40)
    near = index.near(lat_deg, lon_deg, (2e-4, 2e-4))  # 22 m and 20 m: discs of both packages, which overlap
    assert 10 < near.sum() < 40 and near[40]
    assert [one.id for one in index.find(query, 1, near)] == [40]
    away = index.near(lat_deg + 0.001, lon_deg, (2e-4, 2e-4))
    assert not away[40]


def test_a_prior_beside_the_antimeridian_includes_both_sides(folder: Path) -> None:
    header = PlaceIndex.open(folder).header
    positions = np.full((header.count, 2), [-170_000_000, 1_799_999_000], np.int32)
    positions[3] = [-170_000_000, -1_799_999_000]
    index = PlaceIndex(header, PlaceIndex.open(folder).backend, positions)
    assert index.near(-17.0, -179.9999, (1e-3, 1e-3)).all()
    assert index.near(-17.0, -179.9999, (1e-3, 5e-5)).sum() == 1


def test_each_disc_is_found_once_with_its_best_query(folder: Path) -> None:
    index = PlaceIndex.open(folder, "exact")
    vectors = np.load(folder / VECTORS).astype(np.float32)
    mixed = vectors[4] + 0.4 * vectors[90]
    found = index.find(np.array([mixed / np.linalg.norm(mixed), vectors[4]]), 200)
    assert len({one.id for one in found}) == len(found)
    assert (found[0].id, found[0].query) == (4, 1)
    assert [one.score for one in found] == sorted((one.score for one in found), reverse=True)
    assert next(one for one in found if one.id == 90).query == 0


def test_a_small_index_is_searched_exactly_and_a_large_one_by_faiss(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert PlaceIndex.open(folder).backend.name == "exact"
    monkeypatch.setattr(place_index, "MAX_EXACT", 10)
    assert PlaceIndex.open(folder).backend.name == "faiss"
    assert PlaceIndex.open(folder, "exact").backend.name == "exact"


@pytest.mark.parametrize("name", [VECTORS, POSITIONS, FAISS])
def test_an_altered_file_is_refused(folder: Path, tmp_path: Path, name: str) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    content = bytearray((copy / name).read_bytes())
    content[-5] ^= 1
    (copy / name).write_bytes(content)
    with pytest.raises(MapError, match=f"{name}: altered or incomplete.*terrafix map index"):
        PlaceIndex.open(copy)
    read_header(copy, verify=False)  # a restart in flight compares sizes only
    (copy / name).write_bytes(content[:-5])
    with pytest.raises(MapError, match=f"{name}: altered or incomplete"):
        read_header(copy, verify=False)
    (copy / name).unlink()
    with pytest.raises(MapError, match=f"{name}: cannot be read"):
        PlaceIndex.open(copy)


def changed(folder: Path, copy: Path, **fields: object) -> Path:
    """A copy of an index with another header."""
    shutil.copytree(folder, copy)
    header = msgspec.json.decode((folder / HEADER_FILE).read_bytes(), type=Header)
    (copy / HEADER_FILE).write_bytes(msgspec.json.encode(msgspec.structs.replace(header, **fields)))
    return copy


def test_a_header_that_does_not_fit_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no place index"):
        PlaceIndex.open(tmp_path)
    with pytest.raises(MapError, match="version 7, not 1"):
        PlaceIndex.open(changed(folder, tmp_path / "version", version=7))
    with pytest.raises(MapError, match=r"vectors\.npy: is .* not \(.*, 64\)"):
        PlaceIndex.open(changed(folder, tmp_path / "size", size=64))
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / HEADER_FILE).write_text("{")
    with pytest.raises(MapError, match="damaged"):
        PlaceIndex.open(broken)


def test_an_index_without_faiss_file_cannot_be_searched_by_faiss(packages: list[Path], tmp_path: Path) -> None:
    write_index(packages[:1], tmp_path / "small", IndexOptions(AGL_M, "pooled-gradient"))
    assert not (tmp_path / "small" / FAISS).exists()
    with pytest.raises(MapError, match=r"map index --faiss"):
        PlaceIndex.open(tmp_path / "small", "faiss")


def test_the_index_of_the_configuration_is_opened_with_its_descriptor(folder: Path, tmp_path: Path) -> None:
    assert PlaceMemory.open(Places(), "", verify=True) is None
    memory = PlaceMemory.open(Places(index=str(folder), search="faiss"), "", verify=True)
    assert memory is not None and isinstance(memory.index.backend, FaissSearch)
    assert memory.describer.name == PooledGradientPlaces.name
    other = changed(folder, tmp_path / "other", descriptor="pooled-gradient-places-0")
    with pytest.raises(MapError, match="made with pooled-gradient-places-0"):
        PlaceMemory.open(Places(index=str(other)), "", verify=True)
    unknown = changed(folder, tmp_path / "unknown", model="dinov2")
    with pytest.raises(ModelError, match=r"dinov2.*pooled-gradient"):
        PlaceMemory.open(Places(index=str(unknown)), str(tmp_path), verify=True)


def test_a_broken_index_stops_the_start_but_not_a_restart_in_flight(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("terrafix.anchor.node.AnchorNode", lambda *given: given[-2])

    def started(index: Path, epoch_ns: int | None) -> object:
        config = msgspec.structs.replace(load([]), places=Places(index=str(index)))
        return make_node(NodeContext(config, MemoryFrameStore(2), None, tmp_path, epoch_ns=epoch_ns))

    broken = changed(folder, tmp_path / "broken", version=0)
    with pytest.raises(MapError, match="version 0"):
        started(broken, None)
    assert started(broken, 5) is None
    assert started(folder, None) is not None and started(folder, 5) is not None


def test_an_existing_folder_is_not_overwritten_and_an_aborted_build_leaves_nothing(
    folder: Path, packages: list[Path], tmp_path: Path
) -> None:
    with pytest.raises(OutputError, match="exists"):
        write_index(packages, folder, OPTIONS)
    with pytest.raises(MapError, match="no ground of 750 m"):
        write_index(packages, tmp_path / "none", IndexOptions(1000.0, "pooled-gradient"))
    with pytest.raises(OutputError, match="does not exist"):
        write_index(packages, tmp_path / "no" / "none", OPTIONS)
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_an_index_and_reports_errors_in_one_line(packages: list[Path], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "terrafix_tools.program", "map", "index", *map(str, packages), "--agl", "60"]
    done = subprocess.run([*command, "--out", str(tmp_path / "i")], capture_output=True, text=True, check=True)
    assert f"{PlaceIndex.open(tmp_path / 'i').header.count} places of 45 m" in done.stdout
    wrong = [*command, "--out", str(tmp_path / "j"), "--descriptor", "dinov2"]
    done = subprocess.run(wrong, capture_output=True, text=True, check=False)
    assert done.returncode == 8 and len(done.stderr.splitlines()) == 1 and "dinov2" in done.stderr
