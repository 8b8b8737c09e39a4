"""Pictures of a moment: geometry of the map crop, of the footprint, of matches and ellipse."""

import base64
import math
import re

import cv2
import numpy as np
import pytest

from flight_records import estimate, origin
from terrafix import messages as m
from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix_tools.estimates import Row
from terrafix_tools.report.map_crop import Crop, crop_around, picture
from terrafix_tools.report.moment_geometry import FARTHEST, Pose, footprint, matched_pose, matches_of
from terrafix_tools.report.moment_picture import pictures
from terrafix_tools.report.moment_record import FrameRecord

CAMERA = CameraCalibration.of(origin().camera)  # 64 x 48 px, focal length 60 px
DOWN = rot_w_b(math.radians(90.0), 0.0, 0.0) @ Mount().r_b_c()  # straight down, image top to the east


class NorthEastIsWhite:
    """A map that is white north east of the origin and black elsewhere."""

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        east = e_min_m + (np.arange(width_px) + 0.5) * gsd_m > 0
        north = n_max_m - (np.arange(height_px) + 0.5) * gsd_m > 0
        white = np.where(north[:, None] & east[None, :], 255, 0).astype(np.uint8)
        return np.repeat(white[:, :, None], 3, axis=2), np.ones((height_px, width_px), bool)


def decoded(uri: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), cv2.IMREAD_GRAYSCALE)


def test_a_crop_has_the_heading_of_the_frame_up() -> None:
    crop = Crop((0.0, 0.0), math.radians(90.0), 100, 80, 2.0)
    assert np.allclose(crop.xy(np.array([[20.0, 0.0], [0.0, 30.0]])), [[50.0, 30.0], [35.0, 40.0]])


@pytest.mark.parametrize(
    ("heading_deg", "white"),
    [(0.0, "upper right"), (90.0, "upper left"), (180.0, "lower left"), (270.0, "lower right")],
)
def test_the_imagery_of_a_crop_is_turned_like_its_coordinates(heading_deg: float, white: str) -> None:
    crop = Crop((0.0, 0.0), math.radians(heading_deg), 60, 40, 1.0)
    uri = picture(crop, NorthEastIsWhite())  # type: ignore[arg-type]
    assert uri is not None
    image = decoded(uri)
    upper, lower, left, right = image[:18], image[22:], slice(0, 28), slice(32, 60)
    means = {
        "upper left": upper[:, left].mean(),
        "upper right": upper[:, right].mean(),
        "lower left": lower[:, left].mean(),
        "lower right": lower[:, right].mean(),
    }
    assert image.shape == (40, 60)
    assert [name for name, mean in means.items() if mean > 245] == [white]
    x, y = crop.xy(np.array([[8.0, 8.0]]))[0]
    assert ("left" if x < 30 else "right") in white and ("upper" if y < 20 else "lower") in white


def test_the_footprint_of_a_camera_that_looks_down_is_its_field_of_view() -> None:
    border_m = footprint(Pose(np.array([10.0, 20.0, 600.0]), DOWN, 500.0), CAMERA)
    # Image top is east: the width of the image lies north to south.
    assert np.ptp(border_m[:, 1]) == pytest.approx(100 * 64 / 60)
    assert np.ptp(border_m[:, 0]) == pytest.approx(100 * 48 / 60)
    assert border_m.mean(axis=0) == pytest.approx([10.0, 20.0], abs=1.0)


def test_the_footprint_of_a_camera_that_sees_the_horizon_ends() -> None:
    level = rot_w_b(0.0, 0.0, 0.0) @ Mount(pitch_deg=0.0).r_b_c()
    border_m = footprint(Pose(np.array([0.0, 0.0, 100.0]), level, 0.0), CAMERA)
    assert np.isfinite(border_m).all()
    assert np.linalg.norm(border_m, axis=1).max() == pytest.approx(100.0 * FARTHEST)


def test_a_crop_holds_the_footprint_and_a_near_estimate() -> None:
    square = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
    near, far = (crop_around(square, np.array([east_m, 50.0]), 0.0) for east_m in (150.0, 5000.0))
    assert near.width_px * near.gsd_m == pytest.approx(150 + 24)
    assert far.width_px * far.gsd_m == pytest.approx(100 + 24)


def _matched(threshold: float = 0.03) -> FrameRecord:
    """Three matches of a camera 100 m above (0, 0); the third is 10 m wrong."""
    record = FrameRecord(4, estimate=estimate(4, 0.0, 0.0))
    points = [(0.0, 0.0), (20.0, 10.0), (-20.0, 15.0)]
    matches = []
    for i, (e_m, n_m) in enumerate(points):
        x, y, z = (np.array([e_m, n_m, -100.0]) @ DOWN).tolist()
        matches.append((x / z, y / z, e_m + 10.0 * (i == 2), n_m, 500.0, 1.0))
    given = m.PnpInput(
        q_w_c=quat_from_rot(DOWN),
        agl_m=100.0,
        sigma_floor=0.003,
        threshold=threshold,
        search_radius=0.08,
        min_inliers=2,
    )
    record.take(
        m.MapMatch(t_ns=0, frame_id=4, verdict=m.Verdict.ACCEPTED, matcher="gradient", matches=matches, pnp=given)
    )
    pose = m.MapPose(p_c_in_w_m=(0.0, 0.0, 600.0), q_w_c=quat_from_rot(DOWN), cov=())
    record.take(
        m.PoseSolution(
            t_ns=0, frame_id=4, verdict=m.Verdict.ACCEPTED, method=m.PoseMethod.IPPE,
            covariance_mode=m.CovarianceMode.MARGINALS, pose=pose,
        )
    )  # fmt: skip
    return record


def test_matches_beyond_the_threshold_of_the_pose_are_outliers() -> None:
    found, wide = matches_of(_matched()), matches_of(_matched(threshold=0.2))
    assert found is not None and found.inlier is not None and found.inlier.tolist() == [True, True, False]
    assert wide is not None and wide.inlier is not None and wide.inlier.all()
    unsolved = _matched()
    unsolved.solution = None
    none = matches_of(unsolved)
    assert none is not None and none.inlier is None
    assert matched_pose(unsolved, 500.0) is None


def test_the_pictures_show_matches_ellipse_and_footprint_at_one_scale() -> None:
    row = Row("4.jpg", 2.0, 48.0, 11.0, sigma_e_m=10.0, sigma_n_m=2.0, cov_en_m2=0.0)
    drawn = pictures(_matched(), None, origin(), row, None, None)
    assert drawn.shows_rejected and not drawn.has_map
    assert drawn.frame.count('class="pairs outlier"') == 1
    inliers = re.search(r'class="ends inlier" d="([^"]*)"', drawn.ground)
    assert inliers is not None and inliers.group(1).count("M") == 2
    # East is up in this picture, so the long axis, which lies east, is turned from right to up.
    ellipse = re.search(r'rx="([\d.]+)" ry="([\d.]+)" transform="[^"]*rotate\(([-\d.]+)\)', drawn.ground)
    assert ellipse is not None
    long, short, turn_deg = (float(text) for text in ellipse.groups())
    assert long / short == pytest.approx(5.0, rel=0.01)
    assert turn_deg == pytest.approx(-90.0)
    assert drawn.ratio == pytest.approx(1.24, abs=0.01)  # the frame with a margin of 12 % on each side


def test_an_accepted_map_match_is_not_drawn_as_unused() -> None:
    record = _matched()
    record.take(m.MeasurementVerdict(t_ns=0, frame_id=4, measurement="map", verdict=m.Verdict.ACCEPTED))
    row = Row("4.jpg", 2.0, 48.0, 11.0, sigma_e_m=1.0, sigma_n_m=1.0, cov_en_m2=0.0)
    assert "foot other" not in pictures(record, None, origin(), row, None, None).ground


def test_without_a_pose_there_is_no_map() -> None:
    drawn = pictures(FrameRecord(4), None, origin(), Row("4.jpg", 2.0), None, None)
    assert drawn.ground == ""
    assert 'class="void"' in drawn.frame and "<path" not in drawn.frame
