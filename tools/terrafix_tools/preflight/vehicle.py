"""Checks of the autopilot other than its parameters: firmware, clock, telemetry, the mission on board."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.config import LinkSection
from terrafix.link.mavlink.message_rates import Streams
from terrafix_tools.preflight.autopilot import Autopilot
from terrafix_tools.preflight.forwarding import WIRE_BYTES
from terrafix_tools.preflight.lines import Line, fail, ok, warn

MIN_FIRMWARE = (4, 6)  # oldest firmware with known behaviour
MAX_CLOCK_ERROR_S = 2.0
MAX_ROUND_TRIP_MS = 100.0
BITS_PER_BYTE = 10  # 8N1
MIN_DELAY_MS, MAX_DELAY_MS = 5, 50
LOOPBACK = ("127.", "localhost")


def delay_advice_ms(link: LinkSection, round_trip_ms: float | None) -> int:
    """Recommended GPSn_DELAY_MS: time between sending and reading, from half the measured round trip or the line's
    speed.
    """
    wire_ms = WIRE_BYTES * BITS_PER_BYTE / link.baud * 1e3 if link.device.startswith("/") else 0.0
    one_way_ms = max(wire_ms, (round_trip_ms or 0.0) / 2)
    return min(MAX_DELAY_MS, max(MIN_DELAY_MS, round(one_way_ms)))


def check_lines(autopilot: Autopilot, link: LinkSection, round_trip_ms: float | None) -> Iterator[Line]:
    version = autopilot.request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, "AUTOPILOT_VERSION")
    kind = "ArduPlane" if autopilot.plane else "ArduCopter"
    yield _firmware(kind, autopilot.sysid, version)
    yield rates(autopilot.rates())
    if round_trip_ms is None:
        yield fail("time", "no answer to TIMESYNC", "is the link one way, or a router in between?")
    elif round_trip_ms > MAX_ROUND_TRIP_MS:
        yield warn("time", f"a round trip takes {round_trip_ms:.0f} ms", "use a faster line, not a radio")
    else:
        yield ok("time", f"a round trip takes {round_trip_ms:.1f} ms")
    yield _clock(autopilot.newest.get(("SYSTEM_TIME", autopilot.sysid)))
    yield _signing(link)
    if autopilot.armed:
        yield warn("armed", "the autopilot is armed", "disarm before parameters are changed")


def save_mission(autopilot: Autopilot, path: Path) -> Line | None:
    """Writes the mission on board to ``path``, a waypoint file. Returns None, or the warning when there is none."""
    items = autopilot.mission()
    if len(items) < 2:  # item 0 is home
        return warn("mission", "none on board", "load one, or give --mission, to check it against the map")
    rows = ["QGC WPL 110"]
    for i in items:
        place = (f"{i.x / 1e7:.8f}", f"{i.y / 1e7:.8f}", f"{i.z:.3f}")
        cells = (i.seq, i.current, i.frame, i.command, i.param1, i.param2, i.param3, i.param4, *place, i.autocontinue)
        rows.append("\t".join(map(str, cells)))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return None


def firmware_version(version: Any) -> tuple[int, int]:
    """Returns major and minor of AUTOPILOT_VERSION; without it the oldest known version."""
    return (
        MIN_FIRMWARE if version is None else (version.flight_sw_version >> 24, version.flight_sw_version >> 16 & 0xFF)
    )


def _firmware(kind: str, sysid: int, version: Any) -> Line:
    if version is None:
        return warn("firmware", f"{kind}, system {sysid}, does not report its version", "is it ArduPilot 4.6 or later?")
    number = version.flight_sw_version
    numbers = (number >> 24, number >> 16 & 0xFF, number >> 8 & 0xFF)
    text = f"{kind} {'.'.join(map(str, numbers))}, system {sysid}"
    if firmware_version(version) < MIN_FIRMWARE:
        return fail("firmware", f"{text}: names and behaviour differ before 4.6", "update the autopilot")
    return ok("firmware", text)


def rates(streams: Streams) -> Line:
    problem = streams.problem()
    if problem:
        return warn("stream rates", problem, "is the line full, or does a router or a ground station set rates, too?")
    attitude = streams.rates_hz.get(mavlink.MAVLINK_MSG_ID_ATTITUDE, 0.0)
    imu = streams.rates_hz.get(mavlink.MAVLINK_MSG_ID_RAW_IMU, 0.0)
    return ok("stream rates", f"all streams as requested: attitude {attitude:.0f} Hz, IMU {imu:.0f} Hz")


def _clock(system_time: Any) -> Line:
    if system_time is None or system_time.time_unix_usec == 0:
        return ok("autopilot clock", "has no date yet; it takes ours with the first fix")
    ahead_s = system_time.time_unix_usec / 1e6 - time.time()
    if abs(ahead_s) <= MAX_CLOCK_ERROR_S:
        return ok("autopilot clock", f"agrees with ours within {MAX_CLOCK_ERROR_S:.0f} s")
    text = f"differs from ours by {ahead_s:+.0f} s"
    return warn("autopilot clock", text, "set this computer's clock (timedatectl), it gives the GPS week")


def _signing(link: LinkSection) -> Line:
    kind, _, rest = link.device.partition(":")
    wire = link.device.startswith("/") or rest.startswith(LOOPBACK)
    if link.signing_key:
        return ok("signing", "packets are signed, and the autopilot replies")
    if wire:
        return ok("signing", "off, on a dedicated wire")
    text = f"off, on a network ({kind}): any host there can send the autopilot a position"
    return warn("signing", text, "set link.signing_key, or use a serial line")
