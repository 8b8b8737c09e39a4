"""The camera of a frame, from the estimate of the body and the estimated calibration."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

import pointed_flight as rig
from flight_records import write_record
from terrafix import messages as m
from terrafix.core.errors import SourceError, UsageError
from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pose import exp_so3
from terrafix.estimator.filter_state import focal_scale
from terrafix_tools.before_after import FINALISED, REFINED
from terrafix_tools.estimates import numbers
from terrafix_tools.finalised import FinalRow, write
from terrafix_tools.locate.views import CameraView, FlightViews, read_views


def views_of(tmp_path: Path, *after_frame: m.Message, given: m.NavEstimate | None = None) -> FlightViews:
    frame = m.Frame(t_ns=0, frame_id=0, file="0000.jpg", width=800, height=600)
    messages = [rig.origin(), frame, rig.attitude(), given or rig.estimate(0), *after_frame]
    write_record(tmp_path / "flight.mcap", messages)
    return read_views(tmp_path)


def view_of(tmp_path: Path, *after_frame: m.Message, given: m.NavEstimate | None = None) -> CameraView:
    return views_of(tmp_path, *after_frame, given=given).views[0]


def test_camera_stands_at_the_body_and_looks_as_mounted(tmp_path: Path) -> None:
    view = view_of(tmp_path, rig.calibration(0))
    assert view.p_c_in_w_m == pytest.approx([0.0, 0.0, 600.0], abs=1e-6)
    assert view.r_w_c == pytest.approx(rig.r_w_c(), abs=1e-9)
    assert view.ground_m == pytest.approx(500.0) and view.height_m == pytest.approx(100.0)


def test_estimated_mount_tilt_turns_the_camera(tmp_path: Path) -> None:
    view = view_of(tmp_path, rig.calibration(0, (0.02, -0.01, 0.5, 3.0, 0.0, 0.0)))
    assert view.r_w_c == pytest.approx(rig.r_w_c() @ exp_so3(np.array([0.02, -0.01, 0.0])), abs=1e-9)


def test_nearest_calibration_in_time_counts(tmp_path: Path) -> None:
    near, far = rig.calibration(1, (0.01, 0.0, 0.0, 0.0, 0.0, 0.0)), rig.calibration(4, (0.3, 0.0, 0.0, 0.0, 0.0, 0.0))
    view = view_of(tmp_path, near, far)
    assert view.r_w_c == pytest.approx(rig.r_w_c() @ exp_so3(np.array([0.01, 0.0, 0.0])), abs=1e-9)


def test_estimated_lens_distortion_is_in_the_rays(tmp_path: Path) -> None:
    assert view_of(tmp_path, rig.calibration(0, (0.0, 0.0, 0.0, 0.0, -0.1, 0.0))).calibration.radial_k1 == -0.1


def test_height_is_that_in_which_the_rays_of_the_described_focal_length_meet_the_ground(tmp_path: Path) -> None:
    view = view_of(tmp_path, rig.calibration(0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.3)))
    assert focal_scale(rig.CAMERA, 0.3) > 1.01
    assert view.height_m == pytest.approx(100.0 / focal_scale(rig.CAMERA, 0.3))
    assert view.ground_m == pytest.approx(500.0)


def test_tilt_covariance_is_that_of_the_camera_without_the_error_of_the_body(tmp_path: Path) -> None:
    heights_only = m.VehicleState(t_ns=0, source="mavlink", agl_m=100.0)
    frame = m.Frame(t_ns=0, frame_id=0, file="0000.jpg", width=800, height=600)
    messages = [rig.origin(), frame, rig.attitude(), heights_only, rig.estimate(0), rig.calibration(0)]
    write_record(tmp_path / "flight.mcap", messages)
    expected = rig.TILT_SIGMA_RAD**2 - math.radians(rig.origin().attitude_sigma_deg) ** 2
    view = read_views(tmp_path).views[0]
    assert np.diag(view.cov)[3:] == pytest.approx([expected, expected, rig.TILT_SIGMA_RAD**2])


def test_without_a_calibration_the_tolerance_of_the_mount_is_in_the_tilt_covariance(tmp_path: Path) -> None:
    expected = rig.TILT_SIGMA_RAD**2 + math.radians(rig.CAMERA.mount_tolerance_deg) ** 2
    view = view_of(tmp_path)
    assert np.diag(view.cov)[3:] == pytest.approx([expected, expected, rig.TILT_SIGMA_RAD**2])


def test_estimated_principal_point_moves_the_camera_to_where_described_rays_start(tmp_path: Path) -> None:
    camera = msgspec.structs.replace(rig.CAMERA, focal_sigma=0.1)
    information = np.diag([1e4, 1e4, 1e8, 1e8, 1e3, 1e6, 1e6])
    lens = m.LensEstimate(value=(0.0, 0.0, 0.0, 0.0, 0.0, 0.02, 0.0), information=tuple(information.ravel().tolist()))
    learnt = msgspec.structs.replace(rig.calibration(0), lens=lens)
    body = msgspec.structs.replace(rig.estimate(0), cov=tuple((10.0 * np.eye(6)).ravel().tolist()))
    frame = m.Frame(t_ns=0, frame_id=0, file="0000.jpg", width=800, height=600)
    flown = [msgspec.structs.replace(rig.origin(), camera=camera), frame, rig.attitude(), body, learnt]
    write_record(tmp_path / "flight.mcap", flown)
    view = read_views(tmp_path).views[0]
    # Heading east, the image's right is south: the camera of the graph is 2 m north of the published one.
    assert view.p_c_in_w_m[:2] == pytest.approx([0.0, 2.0], abs=1e-6)
    assert view.cov[0, 0] == pytest.approx(10.0 - (100.0 * 1e-3) ** 2)
    again = tmp_path / "refined"
    again.mkdir()
    write_record(again / "flight.mcap", [*flown, refined(0.0, None, m.RefinementSource.FLIGHT)])
    # ... and so for a refined pose, here turned by 0.02 rad
    assert read_views(again).views[0].p_c_in_w_m[:2] == pytest.approx([0.0, 2.0], abs=0.05)


def test_last_estimate_of_a_frame_counts(tmp_path: Path) -> None:
    corrected = msgspec.structs.replace(rig.estimate(0), alt_amsl_m=640.0, agl_m=120.0)
    view = view_of(tmp_path, corrected)
    assert view.ground_m == pytest.approx(520.0) and view.height_m == pytest.approx(120.0)


def test_frames_are_named_by_number_or_file(tmp_path: Path) -> None:
    flight = views_of(tmp_path)
    assert flight.view("0") is flight.view("0000.jpg") is flight.views[0]
    with pytest.raises(UsageError, match=r"--frame 17: the flight has no such frame; give a file name, or 0 to 0"):
        flight.view("17")


def test_frame_without_position_is_refused(tmp_path: Path) -> None:
    later = m.Frame(t_ns=1, frame_id=1, file="0001.jpg", width=800, height=600)
    with pytest.raises(SourceError, match="frame 1 has no position"):
        views_of(tmp_path, later).view("1")


def test_record_without_position_is_refused(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", [rig.origin()])
    with pytest.raises(SourceError, match="the record has no position"):
        read_views(tmp_path)


def test_ground_plane_of_the_map_match_is_with_its_frame(tmp_path: Path) -> None:
    ground = m.GroundPlane(amsl_m=500.0, slope_e=0.1, slope_n=-0.2, relief_m=1.5)
    match = m.MapMatch(t_ns=0, frame_id=0, verdict=m.Verdict.ACCEPTED, matcher="gradient", ground=ground)
    assert view_of(tmp_path, match).ground == ground


def refined(east_m: float, up_m: float | None, source: m.RefinementSource) -> m.Refinement:
    """Of frame 0, turned by 0.02 rad, with covariances that no estimate has."""
    lat_deg, lon_deg = rig.ORIGIN.to_wgs84(east_m, 0.0)
    turned = rig.r_w_c() @ exp_so3(np.array([0.0, 0.0, 0.02]))
    pose = m.RefinedPose(
        frame_id=0,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=up_m,
        sigma_e_m=2.0,
        sigma_n_m=2.0,
        q_w_c=quat_from_rot(turned),
        cov=tuple((4.0 * np.eye(6)).ravel().tolist()),
    )
    return m.Refinement(t_ns=9, poses=[pose], source=source)


def test_the_newest_refined_pose_of_a_frame_counts_with_its_orientation_and_covariance(tmp_path: Path) -> None:
    first, last = refined(7.0, 601.0, m.RefinementSource.SMOOTHER), refined(3.0, 603.0, m.RefinementSource.FLIGHT)
    view = view_of(tmp_path, rig.calibration(0), first, last)
    assert view.p_c_in_w_m == pytest.approx([3.0, 0.0, 603.0], abs=1e-5)
    assert view.r_w_c == pytest.approx(rig.r_w_c() @ exp_so3(np.array([0.0, 0.0, 0.02])), abs=1e-9)
    assert view.cov == pytest.approx(4.0 * np.eye(6)) and view.ground_m == pytest.approx(500.0)
    without_height = view_of(tmp_path, rig.calibration(0), refined(3.0, None, m.RefinementSource.FLIGHT))
    assert without_height.p_c_in_w_m[2] == pytest.approx(600.0)


@pytest.mark.parametrize(("solution", "focal"), [(FINALISED, 1.1), (REFINED, 1.0)])
def test_a_finalised_pose_comes_before_a_refined_one_with_the_lens_of_its_solution(
    tmp_path: Path, solution: str, focal: float
) -> None:
    lat_deg, lon_deg = rig.ORIGIN.to_wgs84(0.0, 5.0)
    row = FinalRow("0000.jpg", 0.0, lat_deg, lon_deg, 610.0, fragment_id=0, m_per_unit=1.5)
    row.q_w_c, row.cov = numbers(quat_from_rot(rig.r_w_c())), numbers((9.0 * np.eye(6)).ravel().tolist())
    changes = [("focal length", 1.1 * rig.CAMERA.fx), ("radial coefficient", -0.2)]
    flight = {"solution": solution, "before_after": [{"what": what, "after": after} for what, after in changes]}
    write(tmp_path, [row], {"flights": [flight]})
    view = view_of(tmp_path, rig.calibration(0), refined(3.0, 603.0, m.RefinementSource.FLIGHT))
    assert view.p_c_in_w_m == pytest.approx([0.0, 5.0, 610.0], abs=1e-2)
    # What the focal length leaves open is in the height of a refined pose's row. Its rays have it, too.
    assert np.diag(view.cov) == pytest.approx([9.0 if solution == FINALISED else 4.0] * 6)
    assert view.calibration.fx == pytest.approx(focal * rig.CAMERA.fx)
    assert view.calibration.radial_k1 == (-0.2 if solution == FINALISED else 0.0)
