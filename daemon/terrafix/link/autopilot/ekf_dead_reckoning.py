"""Dead reckoning of the autopilot's EKF since our last fix, published as EkfDeadReckoning while there is no new fix.

Without GPS the EKF dead reckons with its inertial sensors and, in a plane, with its airspeed. Over six seconds the
error of ArduPilot's plane was 3 m, in turns as well. After a restart in flight the estimator continues from there
(estimator/measurements/ekf_dead_reckoning.py). Only the displacement of the EKF and its change of velocity are used;
its position before was our own fix.

Nothing is published while any other receiver has a fix, because a spoofed one would displace the EKF, nor while the EKF
reports that its velocity is invalid."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.admission.boot_clock import boot_step_ms
from terrafix.link.autopilot.ekf_status_monitor import NO_POSITION_FLAGS
from terrafix.link.autopilot.gnss_receiver import RECEIVERS
from terrafix.link.integrity.output_predictor import metres_per_degree, offset
from terrafix.messages import FIX_2D, FIX_3D, EkfDeadReckoning, GpsInput

MAX_DEAD_RECKONING_MS = 60_000  # the time for which a restart counts as the same flight (runtime/run_dir.py) [tuned]
MAX_FIX_INTERVAL_NS = 300_000_000  # longest interval between two fixes for interpolation between them [tuned]
STATUS_REPORT_TIMEOUT_NS = 1_500_000_000  # EKF_STATUS_REPORT arrives at 1 Hz [tuned]
RECEIVER_TIMEOUT_NS = 1_500_000_000  # receiver messages arrive at 5 Hz [tuned]
REQUEST_PERIOD_NS, MAX_REQUESTS = 200_000_000, 10  # of the slow messages, after a restart [tuned]
VELOCITY_FLAG = mavlink.EKF_VELOCITY_HORIZ

Vec3 = tuple[float, float, float]


class EkfState(msgspec.Struct, frozen=True):
    """State of the autopilot's EKF, from GLOBAL_POSITION_INT. ``boot_ms``: its time since boot."""

    boot_ms: int
    lat_deg: float
    lon_deg: float
    velocity_enu_mps: Vec3


class LastFix(msgspec.Struct, frozen=True):
    """Our last 3D fix in the frame of the map with its 1-sigma, and the autopilot's EKF at the same time."""

    filter: EkfState
    lat_deg: float
    lon_deg: float
    velocity_enu_mps: Vec3
    position_sigma_m: float
    velocity_sigma_mps: float
    receivers: frozenset[str]  # the autopilot's other receivers, as names of their MAVLink messages


class DeadReckoningRecorder:
    """Stores the EKF state at our last fix, and publishes EkfDeadReckoning while there is no 3D fix.

    ``last``: None while another receiver has a fix, or before our first fix."""

    def __init__(self, last: LastFix | None, measured_ns: Callable[[int, int], int]) -> None:
        """``last``: from the checkpoint of the previous link process. ``measured_ns``: see ``Telemetry``."""
        self.last = last
        self._measured_ns = measured_ns
        self._has_fix = False
        self._ekf_state: EkfState | None = None
        self._ekf_state_ns = 0
        self._previous_gps: GpsInput | None = None
        self._receivers: dict[str, tuple[int, bool]] = {}  # (time received, has a fix)
        self._status: tuple[int, bool] | None = None  # (time received, EKF velocity is valid)
        self._request_count, self._requested_ns = 0, 0

    def on_message(self, message: Any, now_ns: int, own_receiver: int | None) -> Iterator[EkfDeadReckoning]:
        """Processes a message of the autopilot. ``own_receiver``: see ``AutopilotPeer.on_message``."""
        kind = message.get_type()
        if kind in RECEIVERS and RECEIVERS[kind] != own_receiver:
            self._receivers[kind] = (now_ns, message.fix_type >= FIX_2D)
        elif kind == "EKF_STATUS_REPORT":
            self._status = (now_ns, bool(message.flags & VELOCITY_FLAG) and not message.flags & NO_POSITION_FLAGS)
        elif kind == "GLOBAL_POSITION_INT":
            velocity = (message.vy / 100.0, message.vx / 100.0, -message.vz / 100.0)
            self._ekf_state = EkfState(message.time_boot_ms, message.lat / 1e7, message.lon / 1e7, velocity)
            self._ekf_state_ns = self._measured_ns(message.time_boot_ms * 1_000_000, now_ns)
            if any(has_fix for _, has_fix in self._receivers.values()):
                self.last = None
            elif self.last is not None and not self._has_fix and self._is_dead_reckoning(self.last, now_ns):
                yield from _dead_reckoning_since(self.last, self._ekf_state, self._ekf_state_ns)

    def on_gps_input(self, gps: GpsInput) -> None:
        """Processes each GPS_INPUT that is sent. Two successive 3D fixes around the time of the EKF state are
        interpolated to that time and stored in ``last``."""
        before, self._previous_gps = self._previous_gps, gps
        self._has_fix = gps.fix_type == FIX_3D
        ekf_state = self._ekf_state
        if ekf_state is None or before is None or not self._has_fix or before.fix_type != FIX_3D:
            return
        span_ns = gps.t_ns - before.t_ns
        if not before.t_ns <= self._ekf_state_ns <= gps.t_ns or not 0 < span_ns <= MAX_FIX_INTERVAL_NS:
            return
        if any(has_fix for _, has_fix in self._receivers.values()):
            return
        share = (self._ekf_state_ns - before.t_ns) / span_ns
        values = [
            a + share * (b - a)
            for a, b in zip(_position_and_velocity(before), _position_and_velocity(gps), strict=True)
        ]
        lat_deg, lon_deg, *velocity = values
        accuracy = gps.horiz_accuracy_m, gps.speed_accuracy_mps
        self.last = LastFix(ekf_state, lat_deg, lon_deg, _vec3(velocity), *accuracy, frozenset(self._receivers))

    def requests(self, sysid: int, compid: int, now_ns: int) -> Iterator[Any]:
        """-> after a restart: requests for messages that the autopilot would otherwise send within a second."""
        if self.last is None or self._has_fix or self._request_count == MAX_REQUESTS:
            return
        if self._is_dead_reckoning(self.last, now_ns) or now_ns - self._requested_ns < REQUEST_PERIOD_NS:
            return
        self._request_count, self._requested_ns = self._request_count + 1, now_ns
        for message_id in (
            mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
            mavlink.MAVLINK_MSG_ID_GPS2_RAW,
        ):
            command = mavlink.MAV_CMD_REQUEST_MESSAGE
            yield mavlink.MAVLink_command_long_message(sysid, compid, command, 0, message_id, *(0.0,) * 6)

    def _is_dead_reckoning(self, last: LastFix, now_ns: int) -> bool:
        """True if the EKF has no position source besides us and its velocity is valid: all receivers that were known
        at the last fix were received recently (``on_message`` has checked that they have no fix)."""
        receivers = {
            kind for kind, (received_ns, _) in self._receivers.items() if now_ns - received_ns < RECEIVER_TIMEOUT_NS
        }
        if self._status is None or not last.receivers <= receivers:
            return False
        received_ns, velocity_valid = self._status
        return velocity_valid and now_ns - received_ns < STATUS_REPORT_TIMEOUT_NS


def _dead_reckoning_since(last: LastFix, ekf_state: EkfState, t_ns: int) -> Iterator[EkfDeadReckoning]:
    before = last.filter
    elapsed_ms = boot_step_ms(before.boot_ms, ekf_state.boot_ms)
    if not 0 < elapsed_ms <= MAX_DEAD_RECKONING_MS:
        return  # after a reboot, or in another flight
    duration_s = elapsed_ms / 1e3
    north_m, east_m = metres_per_degree(before.lat_deg)
    moved_m = (
        math.remainder(ekf_state.lon_deg - before.lon_deg, 360.0) * east_m,
        (ekf_state.lat_deg - before.lat_deg) * north_m,
    )
    yield EkfDeadReckoning(
        t_ns=t_ns,
        duration_s=duration_s,
        lat_deg=last.lat_deg,
        lon_deg=last.lon_deg,
        velocity_enu_mps=last.velocity_enu_mps,
        position_sigma_m=last.position_sigma_m,
        velocity_sigma_mps=last.velocity_sigma_mps,
        delta_p_m=(
            moved_m[0] - duration_s * before.velocity_enu_mps[0],
            moved_m[1] - duration_s * before.velocity_enu_mps[1],
        ),
        delta_v_mps=_vec3(np.subtract(ekf_state.velocity_enu_mps, before.velocity_enu_mps)),
    )


def _position_and_velocity(gps: GpsInput) -> tuple[float, ...]:
    """-> latitude and longitude [deg] in the frame of the map (with the map offset), velocity ENU [m/s]."""
    return *offset(gps.lat_deg, gps.lon_deg, *gps.map_offset_m), gps.ve_mps, gps.vn_mps, -gps.vd_mps


def _vec3(v: Sequence[float] | np.ndarray) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])
