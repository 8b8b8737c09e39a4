"""Relocalisation in vision: frames that see the ground of an older keyframe, and frames that do not."""

import numpy as np
import pytest

from terrafix.core.frames import MemoryFrameStore
from terrafix.messages import OVERTAKEN, Frame, Message, Odometry, Relocalization, Verdict
from terrafix.vision.node import VisionNode
from terrafix_lab.sim.true_messages import apply, homography
from textured_ground import PINHOLE, rotation, texture, view
from vision_origin import PINHOLE_ORIGIN as ORIGIN

AGL_M = 100.0
Place = tuple[float, float, float]  # east, north [m], yaw [degrees]


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(1, 1500.0)


def line(from_m: tuple[float, float], to_m: tuple[float, float], yaw_deg: float, step_m: float = 20.0) -> list[Place]:
    count = round(float(np.hypot(*np.subtract(to_m, from_m))) / step_m)
    return [(*(np.array(from_m) + np.subtract(to_m, from_m) * i / count), yaw_deg) for i in range(count)]


OUT = line((0.0, -300.0), (0.0, 300.0), 0.0)
ASIDE = line((0.0, 300.0), (400.0, 300.0), 90.0)
BACK = line((400.0, -100.0), (-200.0, -100.0), -90.0)  # crosses the way out
AWAY = line((400.0, 300.0), (400.0, -100.0), 180.0)
BEYOND = line((-200.0, -100.0), (-200.0, -600.0), 180.0)
CROSSING = range(len(OUT + ASIDE + AWAY), len(OUT + ASIDE + AWAY + BACK))  # frames of BACK


class ReplayedPlaces:
    """Two frames a second. A place of None is a black image."""

    def __init__(self, ground: np.ndarray) -> None:
        self._ground, self._store, self.places = ground, MemoryFrameStore(), list[Place | None]()
        self.node = VisionNode(self._store)
        list(self.node.on(ORIGIN))
        self.published: list[Message] = []

    def fly(self, places: list[Place] | list[None], error: str = "", interval_s: float = 1.0) -> "ReplayedPlaces":
        for place in places:
            i = len(self.places)
            self.places.append(place)
            image = np.random.default_rng(i).integers(0, 4, (PINHOLE.height, PINHOLE.width, 3)).astype(np.uint8)
            if place is not None:
                image = view(self._ground, PINHOLE, *self.pose(i))
            self._store.put(i, image)
            frame = Frame(
                t_ns=round(i * interval_s * 1e9), frame_id=i, file="", width=PINHOLE.width, height=PINHOLE.height
            )
            if error:
                dropped = Frame(t_ns=frame.t_ns, frame_id=i, file="", width=0, height=0, error=error)
                self.published += self.node.on(dropped)
            self.published += self.node.on(frame)
        return self

    def pose(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        place = self.places[i]
        assert place is not None
        return rotation(place[2]), np.array([place[0], place[1], AGL_M])

    def found(self) -> list[Relocalization]:
        return [m for m in self.published if isinstance(m, Relocalization)]

    def fragments(self) -> list[int]:
        return [m.fragment_id for m in self.published if isinstance(m, Odometry)]


@pytest.fixture(scope="module")
def crossed(ground: np.ndarray) -> ReplayedPlaces:
    return ReplayedPlaces(ground).fly(OUT + ASIDE + AWAY + BACK + BEYOND)


def test_a_crossing_of_the_old_track_at_another_heading_is_found_with_its_motion(crossed: ReplayedPlaces) -> None:
    run = crossed
    crossing = [m for m in run.found() if m.frame_id in CROSSING]
    assert crossing
    for m in crossing:
        pairs = np.array(m.two_view)
        expected = apply(homography(run.pose(m.keyframe_id), run.pose(m.frame_id)), pairs[:, :2])
        error_px = np.linalg.norm(pairs[:, 2:] - expected, axis=1) * PINHOLE.fx
        assert np.median(error_px) < 1.5
        assert 15 <= m.inliers <= m.tracked and len(pairs) <= m.inliers
        assert 0.3 / PINHOLE.fx < m.sigma_norm < 5.0 / PINHOLE.fx
        assert (m.fragment_id, m.keyframe_fragment_id) == (0, 0)
        assert m.t_ns == m.frame_id * 1_000_000_000


def test_ground_that_was_not_seen_before_is_never_relocalised(crossed: ReplayedPlaces) -> None:
    assert [m for m in crossed.found() if m.frame_id not in CROSSING] == []


def test_a_new_fragment_is_connected_to_an_old_one_over_the_same_ground(ground: np.ndarray) -> None:
    run = ReplayedPlaces(ground).fly(OUT)
    run.fly([None] * 8).fly(line((-10.0, -100.0), (-10.0, 100.0), 40.0))
    assert max(run.fragments()) >= 1
    found = run.found()
    assert found and {m.keyframe_fragment_id for m in found} == {0}
    assert {m.fragment_id for m in found} <= {-1, max(run.fragments())}


def test_the_oldest_of_several_keyframes_of_one_place_is_preferred(ground: np.ndarray) -> None:
    there = line((0.0, -100.0), (0.0, 100.0), 0.0)
    away = line((300.0, -100.0), (300.0, 100.0), 0.0)
    run = ReplayedPlaces(ground).fly(there)
    for offset_m in (7.0, 14.0):  # the very same views would be repeated images
        run.fly([None] * 8).fly(away).fly([None] * 8).fly([(e_m + offset_m, n_m, 5.0) for e_m, n_m, _ in there])
    third = [m for m in run.found() if m.frame_id >= len(run.places) - len(there)]
    assert third and all(m.keyframe_id < len(there) for m in third)


def test_the_last_keyframes_of_the_same_fragment_are_not_relocalised(ground: np.ndarray) -> None:
    assert ReplayedPlaces(ground).fly(line((0.0, -300.0), (0.0, 0.0), 0.0, 8.0)).found() == []


def test_at_most_one_search_a_second(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    run, searched = ReplayedPlaces(ground), list[int]()
    run.fly(OUT[:1])
    assert run.node._search is not None
    describe = run.node._search._describe
    monkeypatch.setattr(run.node._search, "_describe", lambda gray: searched.append(1) or describe(gray))
    run.fly(line((0.0, -270.0), (0.0, 270.0), 0.0, 30.0), interval_s=0.25)
    assert 1 <= len(searched) <= 5  # 18 keyframes in 4.5 s


def test_while_frames_are_dropped_nothing_is_searched(ground: np.ndarray) -> None:
    """Not while newer frames come before older ones are done; frames that are broken do not matter."""
    run = ReplayedPlaces(ground).fly(OUT[:15] + line((0.0, 0.0), (400.0, 0.0), 90.0) + AWAY[15:])
    assert run.fly(BACK, error=OVERTAKEN).found() == []
    assert {m.verdict for m in run.published[-len(BACK) :] if isinstance(m, Odometry)} >= {Verdict.OVERTAKEN}
    assert run.fly(BACK[::-1], error="broken JPEG").found() != []


def test_odometry_is_published_before_the_search(crossed: ReplayedPlaces) -> None:
    for m in crossed.found():
        at = crossed.published.index(m)
        before = crossed.published[at - 1]
        assert isinstance(before, Odometry) and before.frame_id == m.frame_id


def test_a_black_frame_is_neither_found_nor_kept(ground: np.ndarray) -> None:
    run = ReplayedPlaces(ground).fly([None] * 12)
    assert run.found() == [] and run.node._search is not None and len(run.node._search.database) == 0
    assert Verdict.ACCEPTED in {m.verdict for m in run.published if isinstance(m, Odometry)}


def test_ground_that_a_kept_keyframe_shows_is_not_kept_again(ground: np.ndarray) -> None:
    there, away = line((0.0, -100.0), (0.0, 100.0), 0.0), line((300.0, -100.0), (300.0, 100.0), 0.0)
    run = ReplayedPlaces(ground).fly(there + away)
    assert run.node._search is not None
    once = len(run.node._search.database)
    run.fly([(e_m + 5.0, n_m, 3.0) for e_m, n_m, _ in [*there, *away, *there]])
    assert len(run.node._search.database) <= once + 4
