"""The likely cause of a flight that found nothing on the map, from the monitors and verdicts of its record."""

import pytest

from terrafix.messages import CalibrationFault
from terrafix_tools.estimates import Row
from terrafix_tools.flight_verdict import flight_verdict
from terrafix_tools.likely_cause import likely_cause

LOST = {"map": {"few_inliers": 40}, "odometry": {"accepted": 38, "few_inliers": 2}}


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
