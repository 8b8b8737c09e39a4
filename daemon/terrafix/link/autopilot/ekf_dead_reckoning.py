"""Where the autopilot's own filter has gone since our last fix, while it had nothing else to go by.

It coasts: by its inertial sensors, and a plane by its airspeed. Over six seconds ArduPilot's plane was off by 3 m then,
in turns too, where nobody knows better. Who is started again in the flight begins there
(estimator/measurements/ekf_dead_reckoning.py). What counts is how far the filter moved and by how much its velocity
changed: where it believed to be before is our own word.

Not while any other receiver has a fix: it may be spoofed, and lead the filter astray. Nor when the filter itself says
that it has lost its velocity."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.admission.boot_clock import boot_step_ms
from terrafix.link.autopilot.gnss_receiver import FIX_2D, RECEIVERS
from terrafix.link.integrity.fix_type import FIX_3D
from terrafix.link.integrity.output_predictor import metres_per_degree, offset
from terrafix.messages import Coasted, GpsInput

MAX_COAST_MS = 60_000  # as long as it is the same flight (runtime/run_dir.py)
FIXES_APART_NS = 300_000_000  # two between which ours is interpolated
STATUS_FRESH_NS = 1_500_000_000  # it comes once a second
RECEIVER_FRESH_NS = 1_500_000_000  # readings come five times a second
ASK_NS, ASK_TIMES = 200_000_000, 10  # what it says seldom, after a restart
MOVES = mavlink.EKF_VELOCITY_HORIZ
WITHOUT = mavlink.EKF_CONST_POS_MODE | mavlink.EKF_UNINITIALIZED

Vec3 = tuple[float, float, float]


class Filter(msgspec.Struct, frozen=True):
    """What an autopilot believes of itself, from GLOBAL_POSITION_INT; velocity east, north, up [m/s]."""

    boot_ms: int
    lat_deg: float
    lon_deg: float
    velocity_enu_mps: Vec3


class LastFix(msgspec.Struct, frozen=True):
    """Our last 3D fix in the frame of the map, with its 1-sigma, and the autopilot's filter at the same time."""

    filter: Filter
    lat_deg: float
    lon_deg: float
    velocity_enu_mps: Vec3
    position_sigma_m: float
    velocity_sigma_mps: float
    receivers: frozenset[str]  # besides us, that the autopilot has: the messages in which it tells of them


class DeadReckoningRecorder:
    """``take`` each message of the autopilot, ``sent`` each GPS_INPUT: Coasted comes out while there is no 3D fix.

    ``last``: None while another receiver has a fix, too, or there was none of ours."""

    def __init__(self, last: LastFix | None, measured_ns: Callable[[int, int], int]) -> None:
        """``last``: of a link that this one is started in the place of. ``measured_ns``: see Telemetry."""
        self.last = last
        self._measured_ns = measured_ns
        self._fixed = False
        self._said: Filter | None = None
        self._said_ns = 0
        self._before: GpsInput | None = None
        self._receivers: dict[str, tuple[int, bool]] = {}  # when heard, whether it has a fix
        self._status: tuple[int, bool] | None = None  # when heard, whether the filter knows its velocity
        self._asked, self._asked_ns = 0, 0

    def take(self, message: Any, now_ns: int, our_receiver: int | None) -> Iterator[Coasted]:
        """``our_receiver``: see Partner.take."""
        kind = message.get_type()
        if kind in RECEIVERS and RECEIVERS[kind] != our_receiver:
            self._receivers[kind] = (now_ns, message.fix_type >= FIX_2D)
        elif kind == "EKF_STATUS_REPORT":
            self._status = (now_ns, bool(message.flags & MOVES) and not message.flags & WITHOUT)
        elif kind == "GLOBAL_POSITION_INT":
            velocity = (message.vy / 100.0, message.vx / 100.0, -message.vz / 100.0)
            self._said = Filter(message.time_boot_ms, message.lat / 1e7, message.lon / 1e7, velocity)
            self._said_ns = self._measured_ns(message.time_boot_ms * 1_000_000, now_ns)
            if any(has_fix for _, has_fix in self._receivers.values()):
                self.last = None
            elif self.last is not None and not self._fixed and self._knows(self.last, now_ns):
                yield from _moved(self.last, self._said, self._said_ns)

    def sent(self, gps: GpsInput) -> None:
        before, self._before = self._before, gps
        self._fixed = gps.fix_type == FIX_3D
        said = self._said
        if said is None or before is None or not self._fixed or before.fix_type != FIX_3D:
            return
        span_ns = gps.t_ns - before.t_ns
        if not before.t_ns <= self._said_ns <= gps.t_ns or not 0 < span_ns <= FIXES_APART_NS:
            return
        if any(has_fix for _, has_fix in self._receivers.values()):
            return
        share = (self._said_ns - before.t_ns) / span_ns
        values = [a + share * (b - a) for a, b in zip(_place(before), _place(gps), strict=True)]
        lat_deg, lon_deg, *velocity = values
        accuracy = gps.horiz_accuracy_m, gps.speed_accuracy_mps
        self.last = LastFix(said, lat_deg, lon_deg, _vec3(velocity), *accuracy, frozenset(self._receivers))

    def requests(self, sysid: int, compid: int, now_ns: int) -> Iterator[Any]:
        """After a restart, for what the autopilot would say within a second."""
        if self.last is None or self._fixed or self._asked == ASK_TIMES:
            return
        if self._knows(self.last, now_ns) or now_ns - self._asked_ns < ASK_NS:
            return
        self._asked, self._asked_ns = self._asked + 1, now_ns
        for message_id in (
            mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
            mavlink.MAVLINK_MSG_ID_GPS2_RAW,
        ):
            command = mavlink.MAV_CMD_REQUEST_MESSAGE
            yield mavlink.MAVLink_command_long_message(sysid, compid, command, 0, message_id, *(0.0,) * 6)

    def _knows(self, last: LastFix, now_ns: int) -> bool:
        """Nothing but inertial sensors and airspeed has moved the filter, and it still knows its velocity."""
        heard = {kind for kind, (heard_ns, _) in self._receivers.items() if now_ns - heard_ns < RECEIVER_FRESH_NS}
        if self._status is None or not last.receivers <= heard:
            return False
        heard_ns, moves = self._status
        return moves and now_ns - heard_ns < STATUS_FRESH_NS


def _moved(last: LastFix, said: Filter, t_ns: int) -> Iterator[Coasted]:
    before = last.filter
    coast_ms = boot_step_ms(before.boot_ms, said.boot_ms)
    if not 0 < coast_ms <= MAX_COAST_MS:
        return  # another boot, or another flight
    coast_s = coast_ms / 1e3
    north_m, east_m = metres_per_degree(before.lat_deg)
    moved_m = (math.remainder(said.lon_deg - before.lon_deg, 360.0) * east_m, (said.lat_deg - before.lat_deg) * north_m)
    yield Coasted(
        t_ns=t_ns,
        coast_s=coast_s,
        lat_deg=last.lat_deg,
        lon_deg=last.lon_deg,
        velocity_enu_mps=last.velocity_enu_mps,
        position_sigma_m=last.position_sigma_m,
        velocity_sigma_mps=last.velocity_sigma_mps,
        way_m=(moved_m[0] - coast_s * before.velocity_enu_mps[0], moved_m[1] - coast_s * before.velocity_enu_mps[1]),
        gain_mps=_vec3(np.subtract(said.velocity_enu_mps, before.velocity_enu_mps)),
    )


def _place(gps: GpsInput) -> tuple[float, ...]:
    """On the map, as the estimator knows it, with the map's own error."""
    return *offset(gps.lat_deg, gps.lon_deg, *gps.map_offset_m), gps.ve_mps, gps.vn_mps, -gps.vd_mps


def _vec3(v: Sequence[float] | np.ndarray) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])
