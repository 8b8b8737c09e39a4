"""Why a flight found nothing on the map: the best guess of its monitors, in words.

Frames that match each other and not the map mean that what describes them is wrong: focal length, height, mount,
heading or map. Monitors measure some of these; where none does, the guess names what is left."""

from collections.abc import Iterable, Mapping

from terrafix.messages import CalibrationFault, Verdict

MIN_FRAMES = 8  # of a flight that is judged
MAX_ANCHORED_SHARE = 0.05  # of the frames, of a flight that found nothing: false matches are rarer
MATCHED_SHARE = 0.5  # of the frames that odometry has registered, for them to match each other
UNMEASURED = "no monitor measured which"  # in a cause that a look at the map may settle (map_probe)
# The scale first: a wrong one misplaces everything, and other monitors may follow it.
_ORDER = ("scale", "mount yaw", "mirrored picture", "attitude", "heading")


def likely_cause(
    frames: int, anchored: int, faults: Iterable[CalibrationFault], verdicts: Mapping[str, Mapping[str, int]]
) -> str:
    """``anchored``: frames with a map match; ``faults``: in order of time; ``verdicts``: number of each verdict by
    measurement. Empty for a flight that found the map, or is too short."""
    of_map, of_odometry = verdicts.get("map", {}), verdicts.get("odometry", {})
    if frames < MIN_FRAMES or anchored > MAX_ANCHORED_SHARE * frames:
        return ""
    newest = {fault.quantity: fault for fault in faults}
    active = {quantity: fault for quantity, fault in newest.items() if fault.active}
    measured = next((active[quantity] for quantity in _ORDER if quantity in active), None)
    if measured is not None:
        return f"{_measured_text(measured)} ({measured.detail})"
    for verdict, text in (
        (Verdict.OUTSIDE_MAP, "the map does not show where the flight is said to be: start or map is wrong"),
        (Verdict.TOO_LOW, "the frames are too low above the ground, or the height is wrong"),
    ):
        if of_map.get(verdict, 0) > 0.5 * frames:
            return text
    # The pictures of the latter agree, too; where the ground lies is not known.
    matched = of_odometry.get(Verdict.ACCEPTED, 0) + of_odometry.get(Verdict.DEGENERATE, 0)
    if matched < MATCHED_SHARE * frames:
        return (
            f"the frames do not match each other either ({matched} of {frames}): they are blurred, empty, too far "
            "apart or out of order"
        )
    return (
        f"{matched} of {frames} frames match each other, and none the map: focal length, height, mount, heading or map "
        f"is wrong, and {UNMEASURED}; `terrafix source info` says where each comes from"
    )


def _measured_text(fault: CalibrationFault) -> str:
    factor = fault.factor
    if fault.quantity == "scale" and factor is not None:
        return f"the height is {factor:.2f} times the true one, or the focal length {1.0 / factor:.2f} times"
    if fault.quantity == "heading" and factor is not None:
        return f"the heading is off by {factor:+.0f} degrees"
    if fault.quantity == "mount yaw" and factor is not None:
        return f"the camera is mounted at a yaw that is off by {factor:+.0f} degrees"
    if fault.quantity == "mirrored picture":
        return "the images are mirrored, or the heading turns the wrong way"
    return f"the reported {fault.quantity} is wrong"
