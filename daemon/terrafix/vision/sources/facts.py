"""What a source says of itself before the flight: where each number comes from, its clock, rate and gaps, the vehicles
that its log has, and what is left out and why."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from terrafix.messages import Camera, Fact, Origin, VehicleState

if TYPE_CHECKING:
    from terrafix.core.autopilot_log.own_log import OwnLog
    from terrafix.core.mavlink.tlog import TelemetryLog
    from terrafix.vision.sources.rosbag import BagTelemetry

GAP_TIMES = 3.0  # a gap is longer than this many times the median interval


@runtime_checkable
class WithFacts(Protocol):
    def facts(self) -> list[Fact]: ...


def facts_of(source: object) -> list[Fact]:
    """Facts of a source; none of one that has none to tell."""
    return source.facts() if isinstance(source, WithFacts) else []


def camera_facts(camera: Camera, whence: str, notes: Sequence[str] = ()) -> Iterator[Fact]:
    """``camera``: of the stored images; ``whence``: where its focal length comes from."""
    focal = (
        f"{camera.fx:.1f}" if math.isclose(camera.fx, camera.fy, rel_tol=1e-3) else f"{camera.fx:.1f} x {camera.fy:.1f}"
    )
    lens = f"distortion of {len(camera.distortion)} numbers" if camera.distortion else "distortion not stated: learnt"
    yield Fact(
        "camera",
        f"{camera.width}x{camera.height} px, focal length {focal} px (1-sigma {100 * camera.focal_sigma:.3g} %) from "
        f"{whence}, principal point {camera.cx:.1f}, {camera.cy:.1f}, {lens}",
    )
    yield from (Fact("camera", note) for note in notes)


def mount_fact(camera: Camera, whence: str) -> Fact:
    angles = f"yaw {camera.mount_yaw_deg:g}, pitch {camera.mount_pitch_deg:g}, roll {camera.mount_roll_deg:g}"
    return Fact("mount", f"{angles} degrees, 1-sigma {camera.mount_tolerance_deg:g}, from {whence}")


def start_fact(origin: Origin, whence: str) -> Fact:
    if not math.isfinite(origin.start_sigma_m):
        return Fact("start", "not stated: searched on the map, or by GNSS before arming in a live flight")
    return Fact(
        "start", f"{origin.lat_deg:.6f}, {origin.lon_deg:.6f} (1-sigma {origin.start_sigma_m:g} m) from {whence}"
    )


def rate_facts(times_s: Sequence[float], what: str) -> Iterator[Fact]:
    """``times_s``: increasing."""
    if len(times_s) < 2:
        yield Fact("rate", f"{len(times_s)} {what}")
        return
    steps = sorted(after - before for before, after in pairwise(times_s))
    median_s, span_s = steps[len(steps) // 2], times_s[-1] - times_s[0]
    rate = f", {1 / median_s:.3g} a second" if median_s > 0 else ""
    yield Fact("rate", f"{len(times_s)} {what} in {span_s:.1f} s{rate}")
    gaps = [(after - before, before) for before, after in pairwise(times_s) if after - before > GAP_TIMES * median_s]
    if gaps:
        longest_s, at_s = max(gaps)
        yield Fact("gaps", f"{len(gaps)} gaps between {what}, the longest {longest_s:.1f} s from {at_s:.1f} s on")


def telemetry_facts(states: Sequence[VehicleState], whence: str, origin: Origin) -> Iterator[Fact]:
    """How often height, heading and tilt are stated, and the accuracy that is assumed. ``whence``: file or fields they
    come from."""
    for topic, name, sigma in (
        ("height", "agl_m", f", 1-sigma {origin.agl_sigma_m:g} m"),
        ("heading", "yaw_rad", f", 1-sigma {origin.yaw_sigma_deg:g} degrees"),
        ("tilt", "roll_rad", f", 1-sigma {origin.attitude_sigma_deg:g} degrees"),
        ("airspeed", "airspeed_mps", ""),
    ):
        count = sum(getattr(state, name) is not None for state in states)
        if count or topic != "airspeed":
            yield Fact(topic, f"{count} values from {whence}{sigma}" if count else "not stated")


def log_facts(log: "TelemetryLog | OwnLog | BagTelemetry") -> Iterator[Fact]:
    """Clock, vehicles and damage of a log."""
    yield Fact("clock", f"{log.path.name}: {log.clock}; zero is {log.zero}")
    if len(log.vehicles) == 1:
        yield Fact("vehicles", log.vehicles[0].name())
    for note in log.notes():
        yield Fact("vehicles" if note.startswith("vehicles") else "clock", note)
    if not log.states:
        yield Fact("left out", f"{log.path.name}: holds no attitude, height, heading or airspeed of an autopilot")
    if log.skipped_bytes:
        yield Fact("left out", f"{log.path.name}: {log.skipped_bytes} bytes are damaged or cut off")
    if log.gimbal:
        yield Fact("mount", f"{len(log.gimbal)} attitudes of a gimbal from {log.path.name}")
    if log.imu:
        yield Fact("inertial readings", f"{sum(len(batch.samples) for batch in log.imu)} from {log.path.name}")
