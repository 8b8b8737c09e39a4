"""Points of the ground from the features of odometry."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from terrafix.core.errors import OutputError
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import KeyframeLink, Odometry, Verdict
from terrafix_tools.finalise.lens import Lens
from terrafix_tools.finalise.point_cloud import MIN_ANGLE_RAD, VERTEX, FeatureTracks, cloud_name, write_ply

DOWN = np.diag([1.0, -1.0, -1.0])
SIGMA = 1e-3
GROUND_M = np.array([[x, y, 20.0 + 0.1 * x] for x in (-30.0, -10.0, 12.0, 31.0) for y in (-25.0, 3.0, 28.0)])


def camera_at(east_m: float, north_m: float, up_m: float = 120.0) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(DOWN), np.array([east_m, north_m, up_m]))


def seen(pose: gtsam.Pose3, points_m: np.ndarray = GROUND_M) -> np.ndarray:
    """(N, 2), normalised."""
    in_camera = (points_m - pose.translation()) @ pose.rotation().matrix()
    return np.asarray(in_camera[:, :2] / in_camera[:, 2:])


def in_order(points: np.ndarray) -> np.ndarray:
    """(N, 3) positions, in the order of GROUND_M."""
    at_m = np.column_stack([points[name] for name in "xyz"])
    return at_m[np.lexsort(np.round(at_m[:, [1, 0]], 3).T)]


def odometry(frame_id: int, keyframe: np.ndarray, frame: np.ndarray, **more: object) -> Odometry:
    pairs = [tuple(row) for row in np.hstack([keyframe, frame]).tolist()]
    fields = {"t_ns": 0, "verdict": Verdict.ACCEPTED, "keyframe_id": 0, "fragment_id": 3, "sigma_norm": SIGMA}
    return Odometry(frame_id=frame_id, two_view=pairs, **{**fields, **more})  # type: ignore[arg-type]


def test_features_that_several_frames_show_are_triangulated() -> None:
    cameras = {0: camera_at(0.0, 0.0), 1: camera_at(20.0, 2.0), 2: camera_at(40.0, 5.0, 125.0)}
    tracks, keyframe = FeatureTracks(), seen(cameras[0])
    tracks.add(odometry(1, keyframe, seen(cameras[1])))
    tracks.add(odometry(2, keyframe[:5], seen(cameras[2])[:5]))
    points = tracks.triangulated(cameras, Lens())
    assert in_order(points) == pytest.approx(GROUND_M, abs=1e-6)
    assert sorted(points["views"].tolist()) == [2] * 7 + [3] * 5
    assert set(points["fragment"].tolist()) == {3} and set(points["keyframe"].tolist()) == {0}


def test_a_link_to_another_keyframe_makes_points_of_that_keyframe() -> None:
    cameras = {0: camera_at(0.0, 0.0), 4: camera_at(15.0, -9.0), 7: camera_at(30.0, 2.0)}
    pairs = [tuple(row) for row in np.hstack([seen(cameras[4]), seen(cameras[7])]).tolist()]
    link = KeyframeLink(keyframe_id=4, two_view=pairs, sigma_norm=SIGMA, inliers=12, tracked=12)
    tracks = FeatureTracks()
    tracks.add(odometry(7, seen(cameras[0])[:2], seen(cameras[7])[:2], links=[link]))
    points = tracks.triangulated(cameras, Lens())
    assert sorted(points["keyframe"].tolist()) == [0] * 2 + [4] * 12


def test_the_focal_length_of_the_solution_scales_the_rays() -> None:
    """Rays of a lens that is a tenth longer than described are narrower: the described coordinates are too wide."""
    cameras = {0: camera_at(0.0, 0.0), 1: camera_at(25.0, 0.0)}
    tracks = FeatureTracks()
    tracks.add(odometry(1, 1.1 * seen(cameras[0]), 1.1 * seen(cameras[1])))
    points = tracks.triangulated(cameras, Lens(log_focal=np.log(1.1)))
    assert in_order(points) == pytest.approx(GROUND_M, abs=1e-6)


def test_the_stated_sigma_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(5)
    cameras = {i: camera_at(12.0 * i, 3.0 * i) for i in range(4)}
    normalised = []
    for _ in range(30):
        tracks, keyframe = FeatureTracks(), seen(cameras[0]) + rng.normal(0.0, SIGMA, (12, 2))
        for i in (1, 2, 3):
            tracks.add(odometry(i, keyframe, seen(cameras[i]) + rng.normal(0.0, SIGMA, (12, 2))))
        points = tracks.triangulated(cameras, Lens())
        true_m = GROUND_M[[int(np.argmin(np.hypot(*(GROUND_M[:, :2] - (p["x"], p["y"])).T))) for p in points]]
        off_m = np.linalg.norm(np.column_stack([points[name] for name in "xyz"]) - true_m, axis=1)
        normalised += (off_m / points["sigma"]).tolist()
    assert len(normalised) > 340
    assert float(np.sqrt(np.mean(np.square(normalised)))) == pytest.approx(0.95, abs=0.15)


@pytest.mark.parametrize(("angle", "count"), [(0.8 * MIN_ANGLE_RAD, 0), (1.3 * MIN_ANGLE_RAD, 12)])
def test_rays_that_meet_at_a_small_angle_give_no_point(angle: float, count: int) -> None:
    cameras = {0: camera_at(0.0, 0.0, 1000.0), 1: camera_at(980.0 * float(np.tan(angle)), 0.0, 1000.0)}
    tracks = FeatureTracks()
    tracks.add(odometry(1, seen(cameras[0]), seen(cameras[1])))
    assert len(tracks.triangulated(cameras, Lens())) == count


def test_a_wrong_match_and_a_point_behind_the_camera_are_left_out() -> None:
    cameras = {0: camera_at(0.0, 0.0), 1: camera_at(20.0, 0.0)}
    frame = seen(cameras[1])
    frame[2, 1] += 6 * SIGMA  # across the motion: the rays do not meet, by three sigma each
    frame[5, 0] = seen(cameras[0])[5, 0] + 0.1  # against the motion: they meet above the cameras
    tracks = FeatureTracks()
    tracks.add(odometry(1, seen(cameras[0]), frame))
    assert len(tracks.triangulated(cameras, Lens())) == 10


def test_frames_without_a_position_give_no_points() -> None:
    tracks = FeatureTracks()
    tracks.add(odometry(1, GROUND_M[:, :2] / 100.0, GROUND_M[:, :2] / 100.0 + 0.1))
    assert len(tracks.triangulated({0: camera_at(0.0, 0.0)}, Lens())) == 0
    assert len(tracks.triangulated({1: camera_at(0.0, 0.0)}, Lens())) == 0


def test_the_file_is_a_binary_ply_with_the_place_of_its_axes(tmp_path: Path) -> None:
    axes = LocalFrame(48.25, 14.5)
    points = np.zeros(2, VERTEX)
    points[1] = (12.5, -3.25, 310.0, 0.5, 4, 2, 77)
    write_ply(tmp_path / "points.ply", points, axes)
    header, body = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and "element vertex 2" in lines
    assert any("latitude 48.25000000, longitude 14.50000000" in line for line in lines)
    assert [line for line in lines if line.startswith("property")] == [
        *(f"property double {name}" for name in "xyz"),
        "property float sigma",
        "property ushort views",
        "property int fragment",
        "property uint keyframe",
    ]
    assert np.frombuffer(body, VERTEX).tolist() == points.tolist()
    with pytest.raises(OutputError, match="cannot be written"):
        write_ply(tmp_path / "absent" / "points.ply", points, axes)


def test_each_flight_of_a_record_has_a_cloud_of_its_own() -> None:
    assert [cloud_name(i) for i in range(3)] == ["points.ply", "points-2.ply", "points-3.ply"]
