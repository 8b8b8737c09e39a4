"""The estimator's store of keyframes that have left the window."""

import gtsam
import numpy as np

from terrafix.estimator.integrity.fragments import Fragment
from terrafix.estimator.keyframe_store import MAX_STORED_KEYFRAMES, KeptKeyframe, KeyframeStore
from terrafix.estimator.keyframe_view import KeyframeView


def keyframe(i: int) -> KeptKeyframe:
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.01 * i), np.array([12.5 * i, -3.0, 100.0 + i]))
    return KeptKeyframe(KeyframeView(pose, np.diag(np.arange(1.0, 7.0) + i), 400.0 + i), Fragment.joined_at(float(i)))


def same(first: KeptKeyframe, second: KeptKeyframe) -> bool:
    a, b = first.view, second.view
    matrices = np.array_equal(a.pose.matrix(), b.pose.matrix()) and np.array_equal(a.cov, b.cov)
    return matrices and a.ground_m == b.ground_m and first.fragment is second.fragment


def test_a_keyframe_comes_back_bit_by_bit_with_its_own_fragment() -> None:
    store, added = KeyframeStore(5), [keyframe(i) for i in range(5)]
    for i, one in enumerate(added):
        store.add(10 * i, one)
    for i, one in enumerate(added):
        found = store.get(10 * i)
        assert found is not None
        assert same(found, one)
    assert store.get(7) is None


def test_the_oldest_are_dropped_and_the_memory_stays_what_it_was_at_the_start() -> None:
    store, added = KeyframeStore(5), [keyframe(i) for i in range(17)]
    reserved = store.size_bytes
    for i, one in enumerate(added):
        store.add(i, one)
    assert [i for i in range(17) if store.get(i) is not None] == [12, 13, 14, 15, 16]
    newest = store.get(16)
    assert newest is not None
    assert same(newest, added[16])
    assert store.size_bytes == reserved == 5 * 392
    assert KeyframeStore().size_bytes == MAX_STORED_KEYFRAMES * 392


def test_after_clear_there_is_none_and_new_ones_are_kept() -> None:
    store = KeyframeStore(3)
    for i in range(3):
        store.add(i, keyframe(i))
    store.clear()
    assert len(store) == 0
    assert store.get(1) is None
    store.add(9, keyframe(9))
    found = store.get(9)
    assert found is not None
    assert same(found, keyframe(9)) is False  # another fragment object
    assert found.view.ground_m == 409.0
