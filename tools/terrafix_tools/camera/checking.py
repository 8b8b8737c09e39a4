"""What a flight says about its lens, its mount and the times of its images."""

import math
from collections.abc import Iterator
from pathlib import Path

from terrafix.core.errors import SourceError
from terrafix.messages import CalibrationEstimate, CalibrationFault, ClaimBudget, Origin
from terrafix.recorder.reader import ReadResult, read_received
from terrafix_tools.before_after import Change
from terrafix_tools.camera_times import CameraTimes
from terrafix_tools.finalised import SUMMARY, read_flights
from terrafix_tools.lens_report import lens_words

SIGNIFICANT = 3.0  # sigmas, as of the lens that is applied in flight
DEG = math.degrees(1.0)
# of CalibrationEstimate.state: what, unit, factor to it
STATES = (
    ("tilt of the mount about the camera's x", "degrees", DEG),
    ("tilt of the mount about the camera's y", "degrees", DEG),
    ("heading, reported less true", "degrees", DEG),
    ("height, reported less true", "m", 1.0),
    ("radial coefficient beyond the description", "", 1.0),
    ("reported over observed heights, logarithm", "", 1.0),
)


def camera_check(record: Path) -> Iterator[str]:
    """Lines about a record, and about its finalised.json where there is one. Raises SourceError."""
    origin: Origin | None = None
    estimate: CalibrationEstimate | None = None
    budget: ClaimBudget | None = None
    faults: dict[str, CalibrationFault] = {}
    times = CameraTimes()
    for _, _, received_ns, message in read_received(record, ReadResult()):
        times.take(received_ns, message)
        if isinstance(message, Origin):
            origin = message
        elif isinstance(message, CalibrationEstimate):
            estimate = message
        elif isinstance(message, CalibrationFault):
            faults[message.quantity] = message
        elif isinstance(message, ClaimBudget):
            budget = message
    if origin is None:
        raise SourceError(f"{record}: the record has no camera; was anything flown?")
    camera = origin.camera
    yield (
        f"camera: {camera.width}x{camera.height} px, focal length {camera.fx:.1f} px "
        f"(1-sigma {100 * camera.focal_sigma:.2g} %), mount tolerance {camera.mount_tolerance_deg:g} degrees"
    )
    if estimate is None:
        yield "learnt: nothing; the flight was too short, or never matched its map"
    else:
        n = len(estimate.state)
        for i, (what, unit, factor) in enumerate(STATES):
            value, sigma = factor * estimate.state[i], factor * math.sqrt(max(estimate.cov[i * n + i], 0.0))
            mark = "  <- differs from the description" if abs(value) > SIGNIFICANT * sigma else ""
            yield f"  {what}: {value:+.3g} +- {sigma:.2g} {unit}".rstrip() + mark
        if words := lens_words(camera, estimate):
            yield f"lens: {words}"
    yield from (f"time: {words}" for words in times.words())
    if budget is not None and (variance := budget.terms_m2.get("time_offset")):
        yield f"time offset of the images: adds {math.sqrt(variance):.2g} m to the claim (1-sigma) at the end"
    for fault in faults.values():
        state = "active at the end" if fault.active else "ended"
        yield f"monitor: {fault.quantity} ({state}): {fault.detail}"
    if not faults:
        yield "monitors: no fault of scale, mount, heading, attitude, image or time"
    folder = record if record.is_dir() else record.parent
    rows = [row for flight in read_flights(folder / SUMMARY) for row in flight.get("before_after") or []]
    for row in rows:
        what, before, after = Change(**row).cells()
        yield f"finalised: {what}: {before} -> {after}"
    if not rows:
        yield f"finalised: not yet; `terrafix finalise {record}` estimates the lens over the whole flight"
