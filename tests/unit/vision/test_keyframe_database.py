"""The keyframe database: which keyframes are found again, and which are removed."""

import numpy as np
import pytest

from terrafix.vision.features import Features, SiftMatcher
from terrafix.vision.keyframe_database import VOCABULARY_KEYFRAMES, KeyframeDatabase, StoredKeyframe
from textured_ground import PINHOLE, rotation, texture, view

AGL_M = 100.0


@pytest.fixture(scope="module")
def places() -> list[Features]:
    """Features of twenty pictures that hardly overlap."""
    matcher, ground = SiftMatcher(200), texture(3, 1000.0)
    at = [(e_m, n_m) for e_m in (-320.0, -160.0, 0.0, 160.0, 320.0) for n_m in (-300.0, -100.0, 100.0, 300.0)]
    return [features_at(matcher, ground, e_m, n_m) for e_m, n_m in at]


def features_at(matcher: SiftMatcher, ground: np.ndarray, e_m: float, n_m: float, yaw_deg: float = 0.0) -> Features:
    image = view(ground, PINHOLE, rotation(yaw_deg), np.array([e_m, n_m, AGL_M]))
    return matcher.describe(np.ascontiguousarray(image[:, :, 0]))


def none_recent(_: StoredKeyframe) -> bool:
    return False


def add(database: KeyframeDatabase, frame_id: int, features: Features, fragment_id: int = 0, path: float = 0.0) -> None:
    database.add(frame_id, fragment_id, path, features)


def test_a_place_is_among_the_five_most_similar_keyframes_after_a_turn_and_a_shift(places: list[Features]) -> None:
    database, matcher, ground = KeyframeDatabase(), SiftMatcher(200), texture(3, 1000.0)
    for i, features in enumerate(places):
        add(database, i, features, path=float(i))
    found = []
    for place, (e_m, n_m) in ((2, (-320.0, 100.0)), (9, (0.0, -100.0)), (17, (320.0, -100.0))):
        again = features_at(matcher, ground, e_m + 25.0, n_m - 15.0, yaw_deg=130.0)
        found.append(place in [k.frame_id for k in database.candidates(again, none_recent, 5)])
    assert all(found)


def test_before_there_is_a_vocabulary_all_keyframes_are_candidates(places: list[Features]) -> None:
    database = KeyframeDatabase()
    for i in range(VOCABULARY_KEYFRAMES - 1):
        add(database, i, places[i])
    found = database.candidates(places[-1], none_recent, 20)
    assert [k.frame_id for k in found] == list(range(VOCABULARY_KEYFRAMES - 1))


def test_recent_keyframes_are_no_candidates(places: list[Features]) -> None:
    database = KeyframeDatabase()
    for i, features in enumerate(places):
        add(database, i, features)
    found = database.candidates(places[5], lambda k: k.frame_id in (4, 5), 20)
    assert {k.frame_id for k in found} == set(range(20)) - {4, 5}


def test_stored_descriptors_are_those_of_the_image(places: list[Features]) -> None:
    database = KeyframeDatabase()
    add(database, 0, places[0])
    stored = database.keyframes[0].features
    assert stored.descriptors.dtype == np.uint8
    assert np.array_equal(stored.descriptors.astype(np.float32), places[0].descriptors)


def test_the_memory_is_reserved_at_the_start_and_stays_the_same(places: list[Features]) -> None:
    database = KeyframeDatabase(max_keyframes=6)
    reserved = database.size_bytes
    held = set[int]()
    for i in range(5 * len(places)):
        add(database, i, places[i % len(places)], path=float(i))
        newest = database.keyframes[-1]
        held |= {newest.features.descriptors.ctypes.data, newest.histogram.ctypes.data}
        assert len(database) == min(i + 1, 6)
    assert len(held) == 2 * 7, "arrays lie in the same seven places, one of them for the newest before one is removed"
    assert database.size_bytes == reserved == 7 * (300 * (2 * 4 + 128 + 4) + 512 * 4)


def test_keyframes_that_stay_keep_their_features_when_others_are_removed(places: list[Features]) -> None:
    database = KeyframeDatabase(max_keyframes=10)
    for i, features in enumerate(places):
        add(database, i, features, path=float(i))
    for keyframe in database.keyframes:
        of_its_image = places[keyframe.frame_id]
        assert np.array_equal(keyframe.features.descriptors, of_its_image.descriptors)
        assert np.array_equal(keyframe.features.xy_px, of_its_image.xy_px)
        assert keyframe.histogram.sum() == pytest.approx(1.0)


def test_of_an_image_with_too_many_features_the_strongest_are_kept() -> None:
    many = features_at(SiftMatcher(500), texture(3, 1000.0), 0.0, 0.0)
    assert len(many) > 300
    database = KeyframeDatabase()
    add(database, 0, many)
    assert np.array_equal(database.keyframes[0].features.xy_px, many.xy_px[:300])


def kept(max_keyframes: int, flown: list[tuple[int, float]], features: Features) -> list[int]:
    """Frames that are kept of keyframes (fragment, path)."""
    database = KeyframeDatabase(max_keyframes)
    for frame_id, (fragment_id, path) in enumerate(flown):
        add(database, frame_id, features, fragment_id, path)
    return [k.frame_id for k in database.keyframes]


def test_the_most_redundant_keyframe_is_removed_first_and_the_oldest_of_several(places: list[Features]) -> None:
    dense = [(0, 0.0), (0, 1.0), (0, 1.1), (0, 1.2), (0, 2.2), (0, 3.2)]
    assert kept(5, dense, places[0]) == [0, 1, 3, 4, 5]
    even = [(0, float(i)) for i in range(6)]
    assert kept(5, even, places[0]) == [0, 2, 3, 4, 5]


def test_no_fragment_is_removed_as_a_whole(places: list[Features]) -> None:
    flown = [(0, 0.0), (0, 0.3), (1, 0.0), (2, 0.0), (2, 0.3), (2, 0.6), (3, 0.0), (3, 0.5), (3, 1.0), (3, 1.5)]
    frames = kept(4, flown, places[0])
    assert {flown[i][0] for i in frames} == {0, 1, 2, 3}


def test_the_first_and_the_last_keyframe_of_a_fragment_are_kept_longest(places: list[Features]) -> None:
    flown = [(0, 0.0), (0, 0.3), (0, 0.6), (1, 0.0), (1, 0.9), (1, 1.8)]
    assert kept(4, flown, places[0]) == [0, 2, 3, 5]
