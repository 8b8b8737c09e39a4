"""Edits of a flight by scenarios: their effect, and the absence of side effects."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import transform as warped

from terrafix.core.errors import EvaluationError
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import Camera, Frame, Health, MapMatch, Message, Origin, Prediction, VehicleState, Verdict
from terrafix.vision.sources import Shot
from terrafix.vision.sources.contract import SourceBase
from terrafix_lab.accept.false_inputs.maps import stale_along
from terrafix_lab.accept.flight import AcceptFlight, FrameRef, read_any_truth
from terrafix_lab.accept.long_route import ThereAndBack, original
from terrafix_lab.accept.plan import Plan
from terrafix_lab.accept.scenarios import BY_NAME
from terrafix_lab.faults import edits, pictures
from terrafix_lab.faults.edits import Span
from terrafix_lab.faults.messages import AlteredAnchor, HotComputer, outliers
from terrafix_lab.faults.source import AlteredSource
from terrafix_tools.evaluate import Truth

CAMERA = Camera(width=8, height=4, fx=8.0, fy=8.0, cx=3.5, cy=1.5)
ORIGIN = Origin(
    t_ns=0, camera=CAMERA, lat_deg=48.0, lon_deg=11.0, ground_amsl_m=None, start_sigma_m=10.0, yaw_sigma_deg=3.0,
    agl_sigma_m=3.0, attitude_sigma_deg=1.0)  # fmt: skip
FRAMES = 12


class Counting(SourceBase):
    """A source whose picture number i is grey value i on the left and zero on the right."""

    _origin = ORIGIN

    def length(self) -> int | None:
        return FRAMES

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        for i in range(FRAMES):
            if i >= from_s:
                image = np.zeros((4, 8, 3), np.uint8)
                image[:, :4] = i + 1
                state = VehicleState(t_ns=i * 10**9, source="test", yaw_rad=3.0, agl_m=100.0 + i)
                frame = Frame(t_ns=i * 10**9, frame_id=i, file=f"{i}.jpg", width=8, height=4)
                yield Shot(frame, (state,), image)

    def name(self) -> str:
        return "counting"


def altered(edit: edits.Edit, **more: object) -> list[Shot]:
    source = AlteredSource(Counting(), edit, **more)  # type: ignore[arg-type]
    return list(source.shots())


def files(shots: list[Shot]) -> list[str]:
    return [shot.frame.file for shot in shots]


def grey(shot: Shot) -> int:
    assert shot.image is not None
    return int(shot.image[0, 0, 0])


def test_an_altered_source_limits_and_renumbers_frames() -> None:
    shots = altered(edits.without_frames(frozenset({"1.jpg", "2.jpg"})), frames=6)
    assert files(shots) == ["0.jpg", "3.jpg", "4.jpg", "5.jpg"]
    assert [s.frame.frame_id for s in shots] == [0, 1, 2, 3]
    assert [len(s.states) for s in shots] == [1, 3, 1, 1]  # telemetry continues


def test_a_foreign_frame_is_inserted_between_two_others() -> None:
    stranger = np.full((4, 8, 3), 99, np.uint8)
    shots = altered(edits.foreign_frames({"5.jpg": stranger}))
    assert len(shots) == FRAMES + 1
    foreign = shots[5]
    assert foreign.frame.file == edits.foreign_name("5.jpg") and shots[6].frame.file == "5.jpg"
    assert shots[4].frame.t_ns < foreign.frame.t_ns < shots[6].frame.t_ns
    assert foreign.image is stranger and foreign.states == ()


def test_black_and_frozen_pictures() -> None:
    span = Span(3.0, 5.0, "")
    assert [grey(s) for s in altered(pictures.black(span))] == [1, 2, 3, 0, 0, 0, *range(7, 13)]
    assert [grey(s) for s in altered(pictures.frozen(span))] == [1, 2, 3, 3, 3, 3, *range(7, 13)]


def test_edits_of_telemetry() -> None:
    assert altered(edits.telemetry(edits.height_times(1.1)))[5].states[0].agl_m == pytest.approx(115.5)
    turned = altered(edits.telemetry(edits.turned(15.0)))[0].states[0].yaw_rad
    assert turned is not None and np.degrees(turned) == pytest.approx(np.degrees(3.0) + 15.0 - 360.0)
    unknown = altered(edits.telemetry(edits.yaw_unknown))[0].states[0]
    assert unknown.yaw_rad is None and unknown.agl_m == 100.0


def test_a_moved_start_keeps_its_stated_sigma() -> None:
    moved = edits.start_moved(700.0, -300.0)(ORIGIN)
    east_m, north_m = LocalFrame(48.0, 11.0).to_local(moved.lat_deg, moved.lon_deg)
    assert (east_m, north_m) == pytest.approx((700.0, -300.0), abs=0.01)
    assert moved.start_sigma_m == ORIGIN.start_sigma_m


def test_a_long_route_is_the_flight_forwards_and_backwards() -> None:
    states = [shot.states[0] for shot in Counting().shots()]
    source = ThereAndBack(Counting(), [FrameRef(f"{i}.jpg", float(i), s) for i, s in enumerate(states)], 30)
    shots = list(source.shots())
    assert [grey(s) for s in shots[9:14]] == [10, 11, 12, 11, 10]  # reverses at the last frame
    times = [s.frame.t_ns for s in shots]
    assert len(shots) == 30 and times == [i * 10**9 for i in range(30)]
    assert len(set(files(shots))) == 30 and original(files(shots)[11:13]) == ["11.jpg", "10.jpg"]
    assert all(s.states[0].t_ns == s.frame.t_ns for s in shots)
    assert [s.states[0].agl_m for s in shots[10:13]] == [110.0, 111.0, 110.0]


class Saying:
    """A node that publishes the same messages for every input, and stores its inputs."""

    def __init__(self, *answers: Message) -> None:
        self.answers, self.received = answers, list[Message]()

    def on(self, message: Message) -> Iterator[Message]:
        self.received.append(message)
        return iter(self.answers)

    def tick(self, now_ns: int) -> Iterator[Message]:
        return iter(())


def test_a_wrong_fix_is_350_m_away_with_a_small_covariance() -> None:
    published = MapMatch(t_ns=0, frame_id=1, verdict=Verdict.AMBIGUOUS, matcher="gradient")
    anchor = AlteredAnchor(Saying(published), outliers())
    prediction = Prediction(
        t_ns=0, frame_id=1, p_c_in_w_m=(10.0, 20.0, 100.0), q_w_c=(1.0, 0.0, 0.0, 0.0), cov=(0.0,) * 36, agl_m=100.0,
        agl_sigma_m=1.0, step_m=(0.0, 0.0), step_cov_m2=(0.0,) * 4)  # fmt: skip
    assert list(anchor.on(prediction)) == [published]
    (wrong,) = anchor.on(msgspec.structs.replace(prediction, frame_id=15))
    assert isinstance(wrong, MapMatch) and wrong.verdict is Verdict.ACCEPTED and wrong.pose is not None
    assert np.hypot(wrong.pose.p_c_in_w_m[0] - 10.0, wrong.pose.p_c_in_w_m[1] - 20.0) == pytest.approx(350.0)


def test_throttling_is_reported_within_its_span() -> None:
    inner = Saying()
    node = HotComputer(inner, Span(1.0, 2.0, ""))
    for i in range(4):
        list(node.on(Frame(t_ns=i * 10**9, frame_id=i, file="", width=8, height=4)))
    assert [m.throttled for m in inner.received if isinstance(m, Health)] == [False, True, True, False]


def straight(frames: int = 40, step_m: float = 20.0, map_path: Path | None = None) -> AcceptFlight:
    """North, then sharply east after half of the frames."""
    place = LocalFrame(48.0, 11.0)
    half = frames // 2
    at = [(0.0, i * step_m) if i <= half else ((i - half) * step_m, half * step_m) for i in range(frames)]
    truth = {f"{i}.jpg": Truth(*place.to_wgs84(*p)) for i, p in enumerate(at)}
    frame_refs = [FrameRef(f"{i}.jpg", i * 0.5, None) for i in range(frames)]
    return AcceptFlight("flight", map_path, None, truth, frame_refs, footprint_m=100.0)


def test_the_gap_is_at_the_turn_of_the_track_and_leaves_no_overlap() -> None:
    flight = straight()
    plan = BY_NAME["sharp turn"].plan(flight)
    assert isinstance(plan, Plan)
    gone = [f"{i}.jpg" for i in range(40) if plan.marks.spans[0].has(i * 0.5) and i * 0.5 < plan.marks.breaks_s[0]]
    numbers = [int(name.split(".")[0]) for name in gone]
    before, after = numbers[0] - 1, numbers[-1] + 1
    assert before < 20 <= after  # the corner is frame 20
    track = flight.track_m()
    assert np.hypot(*(track[after] - track[before])) >= 100.0


def test_a_far_frame_is_inserted_350_m_from_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = straight()
    monkeypatch.setattr(AcceptFlight, "picture", lambda _, number: np.full((4, 8, 3), number, np.uint8))
    plan = BY_NAME["350 m frame"].plan(flight)
    assert isinstance(plan, Plan) and len(plan.marks.wrong_files) == 3
    track = flight.track_m()
    own = (Frame(t_ns=i, frame_id=i, file=stop.file, width=8, height=4) for i, stop in enumerate(flight.frame_refs))
    shots = list(plan.edit(Shot(frame, (), None) for frame in own))
    assert len(shots) == len(flight.frame_refs) + 3
    for before, shot in pairwise(shots):
        if before.frame.file in plan.marks.wrong_files:
            away = np.hypot(*(track - track[shot.frame.frame_id]).T)
            assert away[grey(before)] == min(away[away >= 350.0])
    assert "350 m apart" in str(BY_NAME["350 m frame"].plan(straight(frames=10)))


def test_a_flight_that_is_too_short_gives_a_reason() -> None:
    short = straight(frames=10, step_m=2.0)
    assert BY_NAME["three fragments"].plan(short) == "no part of the flight is long enough to leave ground out"
    blackout = BY_NAME["60 s blackout"].plan(short)
    assert isinstance(blackout, str) and "lasts 4 s" in blackout
    assert "GeoTIFF" in str(BY_NAME["20 % unmatchable"].plan(straight(map_path=Path("map.gpkg"))))


def test_the_unmatchable_fifth_is_not_visible_in_other_frames() -> None:
    """Two thirds of it circle over one place; a map that is stale there would be stale for all of them."""
    place, frames = LocalFrame(48.0, 11.0), 60
    turns = [(50.0 * np.sin(i), 50.0 * np.cos(i)) for i in range(40)]
    at = [*turns, *((100.0 * (i + 1), 0.0) for i in range(20))]
    truth = {f"{i}.jpg": Truth(*place.to_wgs84(*p)) for i, p in enumerate(at)}
    frame_refs = [FrameRef(f"{i}.jpg", i * 0.5, None) for i in range(frames)]
    plan = BY_NAME["20 % unmatchable"].plan(
        AcceptFlight("flight", Path("map.tif"), None, truth, frame_refs, footprint_m=100.0)
    )
    assert isinstance(plan, Plan)
    assert plan.marks.spans[0].from_s >= 0.5 * 40 and plan.marks.spans[0].to_s < 0.5 * 58


def test_a_stale_map_differs_only_along_its_part_of_the_route(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (3, 400, 600), dtype=np.uint8)
    profile = {"driver": "GTiff", "width": 600, "height": 400, "count": 3, "dtype": "uint8", "crs": "EPSG:32632"}
    transform = Affine(1.0, 0.0, 690_000.0, 0.0, -1.0, 5_320_000.0)
    with rasterio.open(tmp_path / "map.tif", "w", transform=transform, **profile) as file:
        file.write(image)
    to_wgs84 = warped("EPSG:32632", "EPSG:4326", [690_100.0, 690_150.0], [5_319_900.0, 5_319_900.0])
    stretch = [Truth(lat, lon) for lon, lat in zip(*to_wgs84, strict=True)]
    assert stale_along(tmp_path / "map.tif", tmp_path / "stale.tif", stretch, footprint_m=40.0) == ""
    with rasterio.open(tmp_path / "stale.tif") as file:
        stale = file.read()
        assert file.transform == transform and file.crs.to_epsg() == 32632
    changed = (stale != image).any(axis=0)
    assert changed[100, 100:150].mean() > 0.95  # row 100 is 100 m south of the upper edge
    assert changed[100, 75:].sum() < 110 + 1 and not changed[:65].any() and not changed[:, 185:].any()
    assert (stale[:, 100, 120] == image[:, 299, 479]).all()  # the point opposite


def test_coordinates_csv_is_read_as_truth(tmp_path: Path) -> None:
    path = tmp_path / "coordinates.csv"
    path.write_text("image, lat, lon\nAD000001.jpg, 48.275292, 37.385220\nAD000002, 48.275001, 37.382922\n")
    found = read_any_truth(path, ["AD000001.jpg", "AD000002.jpg", "AD000003.jpg"])
    assert found == {"AD000001.jpg": Truth(48.275292, 37.385220), "AD000002.jpg": Truth(48.275001, 37.382922)}
    with pytest.raises(EvaluationError, match="none of its names is a frame of the flight"):
        read_any_truth(path, ["0001.jpg"])
    path.write_text("image,lat,lon\na.jpg,37.4,148.2\nb.jpg,148.2,37.4\n")
    with pytest.raises(EvaluationError, match=r"line 3.*no place on earth"):
        read_any_truth(path, ["a.jpg"])
