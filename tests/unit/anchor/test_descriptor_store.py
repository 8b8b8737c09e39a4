"""An anchor that is started again in flight finds what the one before it had computed of the map."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ground import PINHOLE, texture, view
from one_place import ORIGIN, SIDE_M, TRUE_M, OnlyMap, R, predicted
from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.descriptor_store import DescriptorStore
from terrafix.anchor.node import AnchorNode
from terrafix.core.frames import MemoryFrameStore
from terrafix.messages import MapMatch
from terrafix_engines.features.gradient import GradientDescriber

WINDOW = (-60.0, 60.0, 200, 200, 0.5)


class ReadMap(OnlyMap):
    """Counts how often it is read."""

    def __init__(self, ground: np.ndarray, path: Path) -> None:
        super().__init__(ground)
        self.path, self.reads = path, 0

    def window(self, *of: Any) -> tuple[np.ndarray, np.ndarray]:
        self.reads += 1
        return super().window(*of)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, SIDE_M)


@pytest.fixture
def read_map(ground: np.ndarray, tmp_path: Path) -> ReadMap:
    path = tmp_path / "map.gpkg"
    path.touch()
    return ReadMap(ground, path)


def described(read_map: ReadMap, shelf: DescriptorStore | None) -> tuple[list[np.ndarray], int]:
    """A window, by a process that has computed nothing yet, and how often the map was read for it."""
    before = read_map.reads
    descriptors, valid, *_ = MapFeatures(read_map, GradientDescriber(), shelf=shelf).window(*WINDOW)
    return [descriptors, valid], read_map.reads - before


def test_what_was_computed_is_there_for_the_next_one_bit_for_bit(read_map: ReadMap, tmp_path: Path) -> None:
    plain, reads = described(read_map, None)
    assert reads > 1
    for expected in (reads, 0):
        found, read = described(read_map, DescriptorStore(tmp_path / "shelf", "here"))
        assert read == expected
        assert all(np.array_equal(a, b) for a, b in zip(found, plain, strict=True))
    assert described(read_map, DescriptorStore(tmp_path / "shelf", "elsewhere"))[1] == reads


@pytest.mark.parametrize("damage", [b"", b"\x93", msgspec.msgpack.encode({"shape": (8, 256, 256)})])
def test_what_is_not_whole_is_computed_anew(read_map: ReadMap, tmp_path: Path, damage: bytes) -> None:
    plain, reads = described(read_map, DescriptorStore(tmp_path, "here"))
    torn, *_ = tmp_path.glob("*.tile")
    torn.write_bytes(damage)
    found, read = described(read_map, DescriptorStore(tmp_path, "here"))
    assert read == 1 < reads
    assert np.array_equal(found[0], plain[0])
    cut = msgspec.msgpack.decode(torn.read_bytes()) | {"valid": b"\0"}
    torn.write_bytes(msgspec.msgpack.encode(cut))
    assert described(read_map, DescriptorStore(tmp_path, "here"))[1] == 1


def test_the_oldest_give_way_also_those_of_the_process_before(tmp_path: Path) -> None:
    tile = np.zeros((2, 4, 4), np.float16), np.ones((4, 4), bool)
    for first in (0, 2):
        shelf = DescriptorStore(tmp_path, "here", most=3)
        for i in range(first, first + 2):
            shelf.put(str(i), *tile)
    held = [i for i in range(4) if shelf.take(str(i)) is not None]
    assert held == [1, 2, 3]


def test_what_is_used_again_and_again_does_not_give_way(read_map: ReadMap, tmp_path: Path) -> None:
    features = MapFeatures(read_map, GradientDescriber(), shelf=DescriptorStore(tmp_path, "here", most=3))
    for i in range(6):  # a tile further east each time, and the first one
        for e_m in (0.0, 200.0 * i):
            features.window(e_m, 0.0, 1, 1, 0.5)
    before = read_map.reads
    MapFeatures(read_map, GradientDescriber(), shelf=DescriptorStore(tmp_path, "here")).window(0.0, 0.0, 1, 1, 0.5)
    assert read_map.reads == before


def test_where_there_is_no_room_nothing_is_kept(read_map: ReadMap, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    shelf = DescriptorStore(tmp_path / "file" / "shelf", "here")
    plain, reads = described(read_map, None)
    found, read = described(read_map, shelf)
    assert read == reads and np.array_equal(found[0], plain[0])


def test_an_anchor_that_is_started_again_says_the_same_and_reads_nothing(
    ground: np.ndarray, read_map: ReadMap, tmp_path: Path
) -> None:
    def first_look(shelf: Path | None) -> tuple[MapMatch, int]:
        package: Any = read_map
        before, frames = read_map.reads, MemoryFrameStore(8)
        frames.put(1, view(ground, PINHOLE, R, TRUE_M))
        node = AnchorNode(frames, package, GradientDescriber(), 1.0, shelf=shelf)
        list(node.on(ORIGIN))
        match, *_ = node.on(predicted(1, 10.0))
        assert isinstance(match, MapMatch)
        return match, read_map.reads - before

    without, reads = first_look(None)
    before, first_reads = first_look(tmp_path / "shelf")
    after, second_reads = first_look(tmp_path / "shelf")
    assert without == before == after
    assert first_reads == reads > second_reads == 0
    read_map.path.write_bytes(b"built anew")
    assert first_look(tmp_path / "shelf")[1] == reads
