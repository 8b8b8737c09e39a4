"""Scenarios with false inputs: the effect of each edit within its span, and none outside."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import transform as warped

from terrafix.core.geodesy import LocalFrame
from terrafix.core.initial_position import start_is_unknown
from terrafix.messages import Camera, Frame, Imu, Origin, VehicleState
from terrafix.vision.sources import Shot
from terrafix_lab.accept.false_inputs import maps as lying_maps
from terrafix_lab.accept.false_inputs.scenarios import LIES
from terrafix_lab.accept.flight import AcceptFlight, FrameRef
from terrafix_lab.accept.plan import CLOSED_LOOP, Plan
from terrafix_lab.accept.scenarios import BY_NAME, SCENARIOS
from terrafix_lab.faults import edits, pictures
from terrafix_lab.faults.edits import Span
from terrafix_lab.faults.table import FAULTS
from terrafix_tools.evaluate import Truth

CAMERA = Camera(width=8, height=4, fx=8.0, fy=8.0, cx=3.5, cy=1.5)
ORIGIN = Origin(
    t_ns=0, camera=CAMERA, lat_deg=48.0, lon_deg=11.0, ground_amsl_m=None, start_sigma_m=10.0, yaw_sigma_deg=3.0,
    agl_sigma_m=3.0, attitude_sigma_deg=1.0)  # fmt: skip
NS = 10**9
FRAMES, STEP_S, STEP_M = 100, 0.5, 12.0


def flight(frames: int = FRAMES, map_path: Path | None = Path("map.tif")) -> AcceptFlight:
    """Straight north at 24 m/s."""
    place = LocalFrame(48.0, 11.0)
    truth = {f"{i}.jpg": Truth(*place.to_wgs84(0.0, i * STEP_M)) for i in range(frames)}
    frame_refs = [FrameRef(f"{i}.jpg", i * STEP_S, None) for i in range(frames)]
    return AcceptFlight("flight", map_path, None, truth, frame_refs, footprint_m=100.0)


def shots(frames: int = FRAMES) -> Iterator[Shot]:
    """The picture of frame i has grey value i + 1 on the left, and 200 on the right; one state and one IMU message."""
    for i in range(frames):
        t_ns = round(i * STEP_S * NS)
        image = np.full((4, 8, 3), 200, np.uint8)
        image[:, :4] = i + 1
        state = VehicleState(t_ns=t_ns, source="test", yaw_rad=3.0, pitch_rad=0.1, roll_rad=-0.2, agl_m=100.0)
        imu = Imu(t_ns=t_ns, source="test", samples=[(0, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0)])
        yield Shot(Frame(t_ns=t_ns, frame_id=i, file=f"{i}.jpg", width=8, height=4), (state,), image, (imu,))


def flown(edit: edits.Edit, frames: int = FRAMES) -> list[Shot]:
    return list(edit(shots(frames)))


def greys(found: list[Shot]) -> list[int]:
    """Grey value on the left of each picture."""
    return [round(float(np.mean(s.image[:, :4]))) for s in found if s.image is not None]


def planned(name: str, of: AcceptFlight | None = None) -> Plan:
    plan = BY_NAME[name].plan(of or flight())
    assert isinstance(plan, Plan), plan
    return plan


def lie_of(plan: Plan) -> Span:
    assert plan.marks.lie is not None and plan.marks.spans == (plan.marks.lie,)
    return plan.marks.lie


@pytest.fixture
def numbered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AcceptFlight, "picture", lambda _, number: list(shots(number + 1))[-1].image)


@pytest.mark.usefixtures("numbered")
@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("ten foreign frames", list(range(40, 50))),
        ("foreign frames at the start", list(range(10))),
        ("every second frame foreign", list(range(40, 70, 2))),
    ],
)
def test_foreign_frames_are_consecutive_mirrored_pictures_of_half_a_flight_later(name: str, numbers: list[int]) -> None:
    plan = planned(name)
    changed = [i for i, grey in enumerate(greys(flown(plan.edit))) if grey != i + 1]
    assert changed == numbers
    for i in numbers:
        image = flown(plan.edit)[i].image
        assert image is not None and image[0, 0, 0] == 200  # mirrored
        assert image[0, -1, 0] == (i + FRAMES // 2) % FRAMES + 1
    lie = lie_of(plan)
    assert (lie.from_s, lie.to_s) == (numbers[0] * STEP_S, numbers[-1] * STEP_S)


@pytest.mark.usefixtures("numbered")
def test_a_fast_foreign_camera_advances_three_pictures_per_frame() -> None:
    shown = [s.image[0, -1, 0] for s in flown(planned("fast foreign frames").edit)[40:50] if s.image is not None]
    assert [int(b) - int(a) for a, b in pairwise(shown)] == [3] * 3 + [3 - FRAMES] + [3] * 5


@pytest.mark.usefixtures("numbered")
def test_random_foreign_frames_are_about_15_percent_and_reproducible() -> None:
    plan = planned("15 % foreign frames", flight(180))
    changed, again = ([i for i, grey in enumerate(greys(flown(plan.edit, 180))) if grey == 200] for _ in range(2))
    assert changed == again and min(changed) >= 18 and max(changed) <= 144
    assert 0.08 < len(changed) / 126 < 0.22


@pytest.mark.usefixtures("numbered")
def test_frames_of_another_place_are_reversed_and_far_away() -> None:
    found = greys(flown(planned("elsewhere in reverse").edit))[40:50]
    assert [b - a for a, b in pairwise(found)] == [-1] * 9
    assert found[0] == FRAMES  # the last picture is the farthest
    slow = {f"{i}.jpg": Truth(48.0 + i * 1e-5, 11.0) for i in range(FRAMES)}  # 111 m in total
    assert "150 m apart" in str(BY_NAME["elsewhere in reverse"].plan(replace(flight(), truth=slow)))


@pytest.mark.usefixtures("numbered")
def test_the_reversed_part_has_ten_frames_before_it() -> None:
    """A flight that stands still from frame 40 on: its first frame is the farthest, and has none before it."""
    place = LocalFrame(48.0, 11.0)
    truth = {f"{i}.jpg": Truth(*place.to_wgs84(0.0, min(i, 40) * STEP_M)) for i in range(FRAMES)}
    plan = planned("elsewhere in reverse", replace(flight(), truth=truth))
    assert greys(flown(plan.edit))[40:50] == [10, 9, 8, 7, 6, 5, 4, 3, 2, 1]


def test_a_frozen_picture_has_new_noise_in_each_frame() -> None:
    plan = planned("frozen picture with noise")
    found, lie = flown(plan.edit), lie_of(plan)
    assert (lie.from_s, lie.to_s) == (20.0, 35.0)
    assert greys(found)[40:71] == pytest.approx([40] * 31, abs=2)
    assert (greys(found)[39], greys(found)[71]) == (40, 72)
    images = [s.image.astype(float) for s in found[40:71] if s.image is not None]
    noise = np.std([a - b for a, b in pairwise(images)]) / math.sqrt(2.0)
    assert noise == pytest.approx(pictures.NOISE_GREY, rel=0.15)


def test_stale_buffers_are_repeated_in_turn() -> None:
    span = Span(4.0, 8.0, "")
    assert greys(flown(pictures.stale_buffers(span, 4, noise_grey=0.0, seed=0)))[8:18] == [
        5,
        6,
        7,
        8,
        5,
        6,
        7,
        8,
        5,
        18,
    ]


def test_late_pictures_are_a_second_old_with_telemetry_in_time() -> None:
    found = flown(pictures.late_pictures(1.0))
    assert greys(found)[:6] == [1, 1, 1, 2, 3, 4]
    assert all(s.frame.t_ns == s.states[0].t_ns == round(i * STEP_S * NS) for i, s in enumerate(found))


def test_slow_pictures_play_at_half_speed_until_the_end_of_the_span() -> None:
    plan = planned("camera falls behind")
    found, lie = greys(flown(plan.edit)), lie_of(plan)
    assert (lie.from_s, lie.to_s) == (20.0, 35.0)
    assert found[40:47] == [41, 41, 42, 42, 43, 43, 44] and found[69:72] == [55, 56, 72]


def test_the_frozen_half_of_a_picture_is_that_of_the_first_frame() -> None:
    found = flown(planned("half the picture stands still").edit)
    for i, shot in enumerate(found[1:], start=1):
        assert shot.image is not None
        assert (shot.image[:2, :4] == i + 1).all() and (shot.image[2:, :4] < 12).all()
    assert not np.array_equal(found[1].image[2:], found[2].image[2:])  # type: ignore[index]


def test_late_telemetry_has_the_time_stamps_of_its_arrival_and_none_is_lost() -> None:
    found = flown(planned("telemetry 2 s late").edit)
    assert [len(s.states) for s in found[:6]] == [0, 0, 0, 0, 1, 1]
    for name in ("states", "imu"):
        messages = [m for s in found for m in getattr(s, name)]
        assert [m.t_ns for m in messages] == [round(i * STEP_S * NS) for i in range(4, FRAMES)]
    true = list(shots())
    edited = edits.late_telemetry(2.0)(
        replace(s, states=(msgspec.structs.replace(s.states[0], agl_m=float(i)),)) for i, s in enumerate(true)
    )
    assert [s.states[0].agl_m for s in list(edited)[4:7]] == [0.0, 1.0, 2.0]


def test_dropped_and_doubled_frames_keep_all_telemetry() -> None:
    found = flown(edits.dropped_and_doubled(0.15, 0.15, seed=3))
    assert [s.states[0].t_ns for s in found if s.states] == sorted(s.states[0].t_ns for s in found if s.states)
    again = [s for s in found if edits.DOUBLED_SUFFIX in s.frame.file]
    gone = FRAMES - (len(found) - len(again))
    assert 6 <= len(again) <= 25 and 6 <= gone <= 25
    assert sum(len(s.states) for s in found) >= FRAMES - 2 and sum(len(s.imu) for s in found) >= FRAMES - 2
    times = [s.frame.t_ns for s in found]
    assert times == sorted(set(times))
    assert all(a.image is b.image for a, b in pairwise(found) if edits.DOUBLED_SUFFIX in b.frame.file)


def test_photos_have_little_overlap_and_one_state_each() -> None:
    found = flown(planned("photos every 155 m").edit)
    assert [s.frame.frame_id for s in found] == list(range(0, FRAMES, 13))  # 156 m
    assert all(len(s.states) == 1 and not s.imu and s.states[0].t_ns == s.frame.t_ns for s in found)
    assert "only 3 photos" in str(BY_NAME["photos every 155 m"].plan(flight(30)))


def test_the_state_of_a_photo_merges_separate_messages() -> None:
    def apart() -> Iterator[Shot]:
        for shot in shots():
            (state,) = shot.states
            attitude = msgspec.structs.replace(state, agl_m=None)
            height = msgspec.structs.replace(
                state, yaw_rad=None, pitch_rad=None, roll_rad=None, agl_m=state.t_ns * 1e-9
            )
            yield replace(shot, states=(attitude, height))

    found = list(planned("photos every 155 m").edit(apart()))
    assert all(s.states[0].yaw_rad == 3.0 and s.states[0].agl_m == s.frame.t_ns * 1e-9 for s in found)


def test_a_gap_removes_frames_and_telemetry_and_delays_the_rest() -> None:
    plan = planned("gap of minutes")
    found = flown(plan.edit)
    times_s = [s.frame.t_ns / NS for s in found]
    gaps = [b - a for a, b in pairwise(times_s)]
    assert len(found) == FRAMES - 16 and max(gaps) == pytest.approx(170.0 + 17 * STEP_S)
    after = found[40]
    assert after.frame.file == "56.jpg" and after.states[0].t_ns == after.imu[0].t_ns == after.frame.t_ns
    span = plan.marks.spans[0]
    assert not span.has(times_s[40]) and span.has(times_s[40] - 1.0) and plan.marks.lie is None


def test_telemetry_is_forged_within_its_span_only() -> None:
    for name, field, change_rad in (("forged tilt", "roll_rad", 0.2618), ("forged heading", "yaw_rad", 1.5708)):
        plan = planned(name)
        lie = lie_of(plan)
        assert lie.to_s - lie.from_s == 10.0
        for before, after in zip(shots(), flown(plan.edit), strict=True):
            off = math.remainder(getattr(after.states[0], field) - getattr(before.states[0], field), 2 * math.pi)
            assert off == pytest.approx(change_rad if lie.has(before.frame.t_ns / NS) else 0.0, abs=1e-3)
            assert after.imu == before.imu


def test_edits_of_roll_and_pitch() -> None:
    swapped = flown(planned("roll and pitch swapped").edit)[5].states[0]
    assert (swapped.roll_rad, swapped.pitch_rad) == (0.1, -0.2)
    negated = flown(planned("roll and pitch negated").edit)[5].states[0]
    assert (negated.roll_rad, negated.pitch_rad) == (0.2, -0.1)


@pytest.mark.parametrize(
    ("name", "factor"),
    [("height 30 % low", 0.7), ("height 30 % high", 1.3), ("height in feet", 3.28), ("height taken for feet", 0.305)],
)
def test_a_wrong_height_keeps_its_stated_sigma(name: str, factor: float) -> None:
    plan = planned(name)
    assert flown(plan.edit)[3].states[0].agl_m == pytest.approx(100.0 * factor, rel=0.01)
    assert plan.origin(ORIGIN) == ORIGIN


def test_edits_of_the_camera_calibration() -> None:
    half, twice = (planned(f"focal length {word}").origin(ORIGIN).camera for word in ("halved", "doubled"))
    assert (half.fx, half.fy, twice.fx, twice.fy) == (4.0, 4.0, 16.0, 16.0)
    assert half.focal_sigma == twice.focal_sigma == 0.01
    assert planned("camera mounted sideways").origin(ORIGIN).camera.mount_yaw_deg == 90.0
    assert planned("camera mounted backwards").origin(ORIGIN).camera.mount_yaw_deg == 180.0
    mirrored = flown(planned("mirrored pictures").edit)[7].image
    assert mirrored is not None and mirrored[0, 0, 0] == 200 and mirrored[0, -1, 0] == 8


def test_a_wrong_or_unknown_start() -> None:
    off = planned("start 300 m off").origin(ORIGIN)
    # Towards the centre of the flight, which goes north.
    assert LocalFrame(48.0, 11.0).to_local(off.lat_deg, off.lon_deg) == pytest.approx((212.0, 212.0), abs=0.5)
    lie = lie_of(planned("start 300 m off"))
    assert lie.from_s == lie.to_s == 0.0
    assert off.start_sigma_m == 50.0
    assert start_is_unknown(planned("start unknown").origin(ORIGIN))
    other = planned("another town's map, no start")
    assert start_is_unknown(other.origin(ORIGIN)) and other.other_map is not None
    assert flown(planned("height unknown").edit)[0].states[0].agl_m is None


def test_a_false_input_longer_than_the_flight_gives_a_reason() -> None:
    assert str(BY_NAME["frozen picture with noise"].plan(flight(60))) == "the flight lasts only 30 s"
    assert str(BY_NAME["ten foreign frames"].plan(flight(20))) == "the flight has only 20 frames"
    assert "GeoTIFF" in str(BY_NAME["map shifted by 300 m"].plan(flight(map_path=Path("map.gpkg"))))


def write_map(
    path: Path, size: tuple[int, int] = (60, 40), crs: str = "EPSG:32632", pixel_m: float = 2.0
) -> np.ndarray:
    """Random picture around 48 N, 11 E."""
    width, height = size
    image = np.random.default_rng(width).integers(0, 255, (3, height, width), dtype=np.uint8)
    (x,), (y,) = warped("EPSG:4326", crs, [11.0], [48.0])
    corner = Affine(pixel_m, 0.0, x - pixel_m * width / 2, 0.0, -pixel_m, y + pixel_m * height / 2)
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 3, "dtype": "uint8", "crs": crs}
    with rasterio.open(path, "w", transform=corner, **profile) as file:
        file.write(image)
    return image


def test_mirrored_shifted_and_scaled_maps(tmp_path: Path) -> None:
    given, out = tmp_path / "given.tif", tmp_path / "out.tif"
    image = write_map(given)
    with rasterio.open(given) as source:
        true = source.transform
    assert lying_maps.mirrored(given, out) == ""
    with rasterio.open(out) as source:
        assert (source.read() == image[:, :, ::-1]).all() and source.transform == true
    assert lying_maps.shifted(given, out, 212.0, -100.0) == ""
    with rasterio.open(out) as source:
        assert (source.read() == image).all()
        moved = np.array([source.transform.c - true.c, source.transform.f - true.f])
        assert moved == pytest.approx([212.0, -100.0], rel=0.005)
    assert lying_maps.scaled(given, out, 1.1, Truth(48.0, 11.0)) == ""
    with rasterio.open(out) as source:
        assert source.transform.a == pytest.approx(2.2)
        assert source.transform @ (30, 20) == pytest.approx(true @ (30, 20), abs=0.01)


@pytest.mark.parametrize(
    ("name", "east_m", "north_m", "pixel_m"),
    [
        ("map shifted by 300 m", 212.0, -212.0, 2.0),
        ("map in another datum", 100.0, 80.0, 2.0),
        ("map 10 % too large", 0.0, 0.0, 2.2),
    ],
)
def test_a_scenario_writes_the_map_of_its_plan(
    tmp_path: Path, name: str, east_m: float, north_m: float, pixel_m: float
) -> None:
    given, out = tmp_path / "given.tif", tmp_path / "out.tif"
    write_map(given)
    plan = planned(name, flight(map_path=given))
    assert plan.other_map is not None and plan.other_map(given, out) == ""
    with rasterio.open(given) as source:
        middle = source.transform @ (30, 20)
    with rasterio.open(out) as source:
        moved = np.array(source.transform @ (30, 20)) - middle
        assert moved == pytest.approx([east_m, north_m], abs=2.0) and source.transform.a == pytest.approx(pixel_m)
    lie = lie_of(plan)
    assert (lie.from_s, lie.to_s) == (0.0, (FRAMES - 1) * STEP_S) and plan.origin(ORIGIN) == ORIGIN


def test_without_another_map_the_own_one_is_mirrored(tmp_path: Path) -> None:
    given, out = tmp_path / "given.tif", tmp_path / "out.tif"
    image = write_map(given)
    plan = planned("another town's map", flight(map_path=given))
    assert plan.other_map is not None and plan.other_map(given, out) == ""
    with rasterio.open(out) as source:
        assert (source.read() == image[:, :, ::-1]).all()
    assert plan.origin(ORIGIN).start_sigma_m == 50.0


def test_another_map_is_centred_on_the_own_one_and_keeps_its_pixel_size(tmp_path: Path) -> None:
    given, other, out = (tmp_path / name for name in ("given.tif", "other.tif", "out.tif"))
    write_map(given)
    image = write_map(other, (30, 50), crs="EPSG:3857", pixel_m=1.5)  # web Mercator: 1 m on the ground at 48 degrees
    assert lying_maps.put_in_place_of(other, given, out) == ""
    with rasterio.open(out) as placed, rasterio.open(given) as there:
        assert (placed.read() == image).all() and placed.crs == there.crs
        assert placed.transform @ (15, 25) == pytest.approx(there.transform @ (30, 20), abs=0.01)
        assert placed.transform.a == pytest.approx(1.5 * math.cos(math.radians(48.0)), rel=0.01)
    plan = planned("another town's map", replace(flight(map_path=given), other_map=other))
    assert plan.other_map is not None and plan.other_map(given, out) == ""
    with rasterio.open(out) as placed:
        assert placed.width == 30


def test_every_false_input_is_documented_and_has_criteria() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "acceptance.md").read_text(encoding="utf-8")
    names = [scenario.name for scenario in LIES]
    assert len(set(names)) == len(names) and not {s.name for s in SCENARIOS} & set(names)
    for scenario in LIES:
        words = FAULTS[scenario.name].words if scenario.name in FAULTS else ""
        assert words or scenario.name in page, f"neither docs/acceptance.md nor the table explains '{scenario.name}'"
        assert {"late false fixes", "false fixes"} & set(scenario.criteria), scenario.name
        assert scenario.ground in ("base", CLOSED_LOOP)
