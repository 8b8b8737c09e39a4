"""Descriptor store: an anchor restarted in flight reads the map descriptors that the previous process computed."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from single_map_place import ORIGIN, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.descriptor_store import DescriptorStore
from terrafix.anchor.node import AnchorNode
from terrafix.core.frames import MemoryFrameStore
from terrafix.messages import MapMatch
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, view

WINDOW = (-60.0, 60.0, 200, 200, 0.5)


class ReadMap(SingleMapPackage):
    """Counts its reads."""

    def __init__(self, ground: np.ndarray, path: Path) -> None:
        super().__init__(ground)
        self.path, self.reads = path, 0

    def window(self, *of: Any) -> tuple[np.ndarray, np.ndarray]:
        self.reads += 1
        return super().window(*of)


@pytest.fixture
def read_map(ground: np.ndarray, tmp_path: Path) -> ReadMap:
    path = tmp_path / "map.gpkg"
    path.touch()
    return ReadMap(ground, path)


def described(read_map: ReadMap, store: DescriptorStore | None) -> tuple[list[np.ndarray], int]:
    """Descriptors of a window from a new process, and the number of map reads for them."""
    before = read_map.reads
    descriptors, valid, *_ = MapFeatures(read_map, GradientDescriber(), store=store).window(*WINDOW)
    return [descriptors, valid], read_map.reads - before


def test_the_next_process_reads_the_same_descriptors(read_map: ReadMap, tmp_path: Path) -> None:
    plain, reads = described(read_map, None)
    assert reads > 1
    for expected in (reads, 0):
        found, read = described(read_map, DescriptorStore(tmp_path / "store", "here"))
        assert read == expected
        assert all(np.array_equal(a, b) for a, b in zip(found, plain, strict=True))
    assert described(read_map, DescriptorStore(tmp_path / "store", "elsewhere"))[1] == reads


@pytest.mark.parametrize("damage", [b"", b"\x93", msgspec.msgpack.encode({"shape": (8, 256, 256)})])
def test_a_damaged_tile_is_computed_again(read_map: ReadMap, tmp_path: Path, damage: bytes) -> None:
    plain, reads = described(read_map, DescriptorStore(tmp_path, "here"))
    torn, *_ = tmp_path.glob("*.tile")
    torn.write_bytes(damage)
    found, read = described(read_map, DescriptorStore(tmp_path, "here"))
    assert read == 1 < reads
    assert np.array_equal(found[0], plain[0])
    cut = msgspec.msgpack.decode(torn.read_bytes()) | {"valid": b"\0"}
    torn.write_bytes(msgspec.msgpack.encode(cut))
    assert described(read_map, DescriptorStore(tmp_path, "here"))[1] == 1


def test_the_least_recently_used_tiles_are_deleted_across_processes(tmp_path: Path) -> None:
    tile = np.zeros((2, 4, 4), np.float16), np.ones((4, 4), bool)
    for first in (0, 2):
        store = DescriptorStore(tmp_path, "here", max_tiles=3)
        for i in range(first, first + 2):
            store.write(str(i), *tile)
    stored = [i for i in range(4) if store.read(str(i)) is not None]
    assert stored == [1, 2, 3]


def test_a_tile_in_use_is_not_deleted(read_map: ReadMap, tmp_path: Path) -> None:
    features = MapFeatures(read_map, GradientDescriber(), store=DescriptorStore(tmp_path, "here", max_tiles=3))
    for i in range(6):  # another tile further east each time, and the first one
        for e_m in (0.0, 200.0 * i):
            features.window(e_m, 0.0, 1, 1, 0.5)
    before = read_map.reads
    MapFeatures(read_map, GradientDescriber(), store=DescriptorStore(tmp_path, "here")).window(0.0, 0.0, 1, 1, 0.5)
    assert read_map.reads == before


def test_a_store_without_space_stores_nothing(read_map: ReadMap, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    store = DescriptorStore(tmp_path / "file" / "store", "here")
    plain, reads = described(read_map, None)
    found, read = described(read_map, store)
    assert read == reads and np.array_equal(found[0], plain[0])


def test_a_restarted_anchor_gives_the_same_match_without_reading_the_map(
    ground: np.ndarray, read_map: ReadMap, tmp_path: Path
) -> None:
    def first_match(store: Path | None) -> tuple[MapMatch, int]:
        package: Any = read_map
        before, frames = read_map.reads, MemoryFrameStore(8)
        frames.put(1, view(ground, PINHOLE, R, TRUE_M))
        node = AnchorNode(frames, package, GradientDescriber(), 1.0, cache_dir=store)
        list(node.on(ORIGIN))
        match, *_ = node.on(predicted(1, 10.0))
        assert isinstance(match, MapMatch)
        return match, read_map.reads - before

    without, reads = first_match(None)
    before, first_reads = first_match(tmp_path / "store")
    after, second_reads = first_match(tmp_path / "store")
    assert without == before == after
    assert first_reads == reads > second_reads == 0
    read_map.path.write_bytes(b"built anew")
    assert first_match(tmp_path / "store")[1] == reads
