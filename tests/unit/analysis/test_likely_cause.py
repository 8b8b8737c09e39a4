"""The likely cause of a flight that found nothing on the map, from the monitors and verdicts of its record."""

import math
from pathlib import Path

import pytest

from terrafix.messages import CalibrationFault, Camera, Origin
from terrafix_tools.estimates import Row
from terrafix_tools.flight_verdict import flight_verdict
from terrafix_tools.likely_cause import likely_cause
from terrafix_tools.map_probe import best_index, likely_factor

LOST = {"map": {"few_inliers": 40}, "odometry": {"accepted": 8, "degenerate": 30, "few_inliers": 2}}


def fault(quantity: str, factor: float | None = None, *, active: bool = True) -> CalibrationFault:
    return CalibrationFault(t_ns=0, quantity=quantity, factor=factor, detail="it was measured", active=active)


@pytest.mark.parametrize(
    ("faults", "says"),
    [
        ([fault("scale", 2.0)], "the height is 2.00 times the true one, or the focal length 0.50 times"),
        (
            [fault("registration"), fault("scale", 0.5)],
            "the height is 0.50 times the true one, or the focal length 2.00",
        ),
        ([fault("heading", -35.0)], "the heading is off by -35 degrees"),
        ([fault("mount yaw", 90.0)], "the camera is mounted at a yaw that is off by +90 degrees"),
        ([fault("mirrored picture")], "the images are mirrored"),
        ([fault("attitude")], "the reported attitude is wrong"),
        ([fault("scale", 2.0), fault("heading", 20.0)], "the height is 2.00 times"),
        ([fault("scale", 2.0), fault("scale", 2.0, active=False), fault("heading", 20.0)], "the heading is off by +20"),
        ([fault("registration")], "38 of 40 frames match each other, and none the map: focal length, height, mount"),
        ([], "38 of 40 frames match each other, and none the map"),
    ],
)
def test_the_monitors_best_guess_is_named_with_its_factor(faults: list[CalibrationFault], says: str) -> None:
    assert likely_cause(40, 0, faults, LOST).startswith(says)


@pytest.mark.parametrize(
    ("verdicts", "says"),
    [
        ({"map": {"outside_map": 30}, "odometry": {"accepted": 39}}, "the map does not show where the flight is said"),
        ({"map": {"too_low": 30}, "odometry": {"accepted": 39}}, "the frames are too low above the ground"),
        (
            {"map": {"few_inliers": 40}, "odometry": {"few_inliers": 35, "accepted": 5}},
            "the frames do not match each other",
        ),
    ],
)
def test_without_a_monitor_the_verdicts_of_the_frames_tell_what_is_left(
    verdicts: dict[str, dict[str, int]], says: str
) -> None:
    assert likely_cause(40, 0, [], verdicts).startswith(says)


@pytest.mark.parametrize(("frames", "anchored"), [(40, 20), (40, 3), (7, 0)])
def test_a_flight_that_found_the_map_or_is_short_has_no_cause(frames: int, anchored: int) -> None:
    assert likely_cause(frames, anchored, [fault("scale", 2.0)], LOST) == ""


def test_the_verdict_on_the_flight_ends_with_the_cause() -> None:
    rows = [Row(file=f"{i}.jpg", t_s=float(i), anchor_age_ms=-1) for i in range(40)]
    verdict = flight_verdict(rows, [(3.0, fault("scale", 2.0))], LOST)
    assert verdict.text().endswith(
        "Likely cause: the height is 2.00 times the true one, or the focal length 0.50 times (it was measured)."
    )
    assert verdict.as_json()["cause"] == verdict.cause


@pytest.mark.parametrize(
    ("scores", "wraps", "best"),
    [
        ([[4.0, 4.1, 7.3, 4.0], [4.2, 4.0, 5.4, 3.9], [4.1, 4.0, 3.9, 4.0]], False, 2),
        ([[4.0, 4.1, 7.3, 4.0], [4.2, 4.0, 3.9, 4.9]], False, 2),  # a step beside it agrees
        ([[4.0, 4.1, 7.3, 4.0], [5.4, 4.0, 3.9, 4.0]], False, None),  # one frame alone
        ([[4.0, 4.1, 5.9, 4.0], [4.0, 4.1, 5.9, 4.0]], False, None),  # as high as by chance
        ([[7.0, 4.1, 4.0, 4.0], [4.0, 4.1, 4.0, 5.0]], True, 0),  # turns close to a circle
        ([[7.0, 4.1, 4.0, 4.0], [4.0, 4.1, 4.0, 5.0]], False, None),
        ([], False, None),
    ],
)
def test_a_factor_needs_one_clear_frame_and_another_that_agrees(
    scores: list[list[float]], wraps: bool, best: int | None
) -> None:
    assert best_index(scores, wraps=wraps) == best


def test_without_a_start_the_map_is_not_asked() -> None:
    camera = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    unknown = Origin(
        t_ns=0, camera=camera, lat_deg=48.0, lon_deg=11.0, ground_amsl_m=None, start_sigma_m=math.inf,
        yaw_sigma_deg=5.0, agl_sigma_m=5.0, attitude_sigma_deg=2.0,
    )  # fmt: skip
    assert likely_factor(iter(()), unknown, Path("nowhere.gpkg")) == ""
