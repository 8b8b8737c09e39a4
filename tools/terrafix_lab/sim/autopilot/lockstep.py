"""A simulated MAVLink autopilot in lock-step: readings and packets in, packets and a navigation solution out.

It models the GPS-related behaviour of ArduPilot 4.6; tests compare it with measurements on the firmware. It has no
thread, socket or clock. Not simulated: several filter lanes and their switching, yaw and attitude as states (the
readings contain them), blending of two GPS, ODOMETRY and other external navigation, flight modes, pre-arm checks. A
fail-safe is therefore reported and counted, but the vehicle continues.

Measured on the firmware and not reproduced here (docs/closed-loop.md has details): the small share of a step of 200 m
that is taken over in 30 s at an accuracy of 100 m; LAND after a reset onto 120 m, and when a copter's velocity is
ignored; the overshoot with position alone after a step; 40 ms of DCM at the first fix after a gap; switching from a
silent GPS1 in 2.5 s (here 4).
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.geodesy import LocalFrame
from terrafix.link.output.gps_time import GPS_EPOCH_UNIX_S, gps_minus_utc_s
from terrafix_lab.sim.autopilot.navigation.align import STOPPED_AFTER_S, Alignment
from terrafix_lab.sim.autopilot.navigation.ekf import Ekf, Fusion
from terrafix_lab.sim.autopilot.navigation.gps import WEEK_S, Fix, GpsInputDriver, GpsInstance
from terrafix_lab.sim.autopilot.navigation.receivers import Receivers
from terrafix_lab.sim.autopilot.navigation.status import (
    EXTERNAL_AFTER_S,
    INFO,
    Sources,
    Status,
    StatusMessage,
)
from terrafix_lab.sim.autopilot.parameters import Kind, parameters_of
from terrafix_lab.sim.autopilot.streams import Snapshot
from terrafix_lab.sim.autopilot.wire import Wire
from terrafix_lab.sim.interfaces import Navigation, Readings

BOOT_OFFSET_S = 42.0  # The autopilot's clock differs from ours by its start
CLOCK_DRIFT = 20e-6  # and by the drift of its oscillator.
AIRBORNE_M = 3.0  # barometric height above home from which the vehicle counts as armed and flying
SOURCE_GPS = 3  # EK3_SRCn_POSXY, VELXY
SOURCE_SETS = 3
NO_DCM = 1  # AHRS_OPTIONS
GLOBAL_FRAMES = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)


@dataclass
class Counts:
    """Counters of GPS_INPUT."""

    received: int = 0
    other_instance: int = 0  # for a gps_id that is not a GPS of this type
    no_fix: int = 0  # below 3D: not offered to the filter
    accepted: int = 0
    rejected: int = 0
    resets: int = 0
    not_in_use: int = 0  # another GPS is in use
    waiting_for_alignment: int = 0


def own_clock_ns(now_s: float) -> int:
    """Converts seconds of the flight to nanoseconds since the autopilot's boot."""
    return round((now_s * (1.0 + CLOCK_DRIFT) + BOOT_OFFSET_S) * 1e9)


class SimAutopilot:
    """Implements ``Autopilot`` of interfaces.py."""

    def __init__(
        self,
        frame: LocalFrame,
        kind: Kind,
        *,
        start: Navigation | None = None,
        home_amsl_m: float | None = None,
        parameters: dict[str, float] | None = None,
        sysid: int = 1,
        boot_ns: Callable[[float], int] = own_clock_ns,
    ) -> None:
        """``start``: navigation solution when it starts in the air; None: on the ground without position.
        ``home_amsl_m``: zero of the relative height; None: the first barometric height. Raises UsageError for an
        unknown parameter.
        """
        self.parameters = parameters_of(kind, parameters)
        self.kind, self._frame, self._boot_ns = kind, frame, boot_ns
        self.flying = self.armed = start is not None
        self.ekf = Ekf(frame, start, fixed_wing=kind is Kind.PLANE) if start is not None else None
        self.status = Status(kind, has_position=start is not None)
        self._receivers = Receivers(self.parameters)
        self.counts = Counts()
        self.gps_input_fixes: list[Fix] = []  # 3D fixes from GPS_INPUT; the monitor empties the list
        self._wire = Wire(self.parameters, sysid, boot_ns)
        self._alignment = Alignment(kind, good=start is not None)
        self._source_set = 1
        self._home_amsl_m = home_amsl_m
        self._unix_minus_flight_s: float | None = None
        self._readings: Readings | None = None

    @property
    def wire(self) -> Wire:
        """The MAVLink side, for monitoring."""
        return self._wire

    @property
    def gps(self) -> list[GpsInstance | None]:
        """GPS1 and GPS2; None if not configured."""
        return self._receivers.gps

    @property
    def used_gps(self) -> int:
        """Index of the GPS in use."""
        return self._receivers.used

    # --- interface ---

    def step(self, now_s: float, readings: Readings) -> None:
        dt_s = 0.0 if self._readings is None else max(0.0, readings.t_s - self._readings.t_s)
        self._readings = readings
        if self._home_amsl_m is None:
            self._home_amsl_m = readings.baro_amsl_m
        if readings.baro_amsl_m - self._home_amsl_m > AIRBORNE_M:
            self.flying = self.armed = True
        if self.ekf is not None:
            self.ekf.predict(readings, dt_s, use_airspeed=self.parameters["ARSPD_USE"] > 0)
        if readings.gnss is not None:
            for gps, fix in self._receivers.on_gnss(readings.gnss, now_s):
                self._fuse_if_in_use(gps, fix, now_s)
        self._update_status(now_s)
        self._wire.stream(now_s, lambda: self._snapshot(now_s, readings))

    def receive(self, packets: bytes, now_s: float) -> None:
        for message in self._wire.receive(packets, now_s):
            match message.get_type():
                case "GPS_INPUT":
                    self._on_gps_input(message, now_s)
                case "PARAM_SET":
                    self._set_parameter(message, now_s)
                case "COMMAND_LONG" | "COMMAND_INT":
                    self._wire.acknowledge(message.command, self._execute(message, now_s))

    def transmit(self) -> bytes:
        return self._wire.take()

    def navigation(self) -> Navigation | None:
        if self.ekf is None:
            return None
        filtered = self.ekf.navigation()
        fix = self._receivers.fix_in_use()
        if not self.status.on_dcm or fix is None or self._readings is None:
            return filtered
        e_m, n_m = self._frame.to_local(fix.lat_deg, fix.lon_deg)
        vn, ve, _ = fix.velocity_ned_mps
        age_s = self._readings.t_s - fix.t_s
        raw = np.array([e_m + ve * age_s, n_m + vn * age_s, filtered.p_b_in_w_m[2]])
        return replace(filtered, p_b_in_w_m=raw)

    # --- GPS ---

    def _on_gps_input(self, message: Any, now_s: float) -> None:
        self.counts.received += 1
        instance_fix, texts = self._receivers.on_gps_input(message, now_s)
        self._send_texts(texts, now_s)
        if instance_fix is None:
            self.counts.other_instance += 1
            return
        gps, fix = instance_fix
        if fix is None:
            self.counts.no_fix += 1
        else:
            self.gps_input_fixes.append(fix)
            if message.time_week > 0:
                unix_s = GPS_EPOCH_UNIX_S + message.time_week * WEEK_S + message.time_week_ms / 1e3
                self._unix_minus_flight_s = unix_s - gps_minus_utc_s(int(unix_s)) - now_s
        self._fuse_if_in_use(gps, fix, now_s)

    def _fuse_if_in_use(self, gps: GpsInstance, fix: Fix | None, now_s: float) -> None:
        """Passes a fix to the filter if it is of the GPS in use."""
        counts = self.counts if isinstance(gps, GpsInputDriver) else Counts()
        self._receivers.choose(now_s)
        if self.gps[self.used_gps] is not gps:
            counts.not_in_use += fix is not None
            return
        if fix is None:
            self._alignment.restart()
            return
        self.status.update_speed_accuracy(fix, now_s)
        check, scale = int(self.parameters["EK3_GPS_CHECK"]), self.parameters["EK3_CHECK_SCALE"]
        had_origin = self._alignment.origin_s is not None
        self._alignment.check(fix, now_s, check, scale)
        if self.ekf is None and not had_origin and self._alignment.origin_s is not None:
            self._wire.send_text(INFO, "EKF3 IMU0 origin set", now_s)
        if self.ekf is None and not self._align(fix, now_s):
            counts.waiting_for_alignment += 1
        elif self._has_stopped(now_s) and not self._alignment.good:
            counts.waiting_for_alignment += 1
            return
        if self.ekf is None:
            return
        sources = self._sources()
        match self.ekf.fuse(fix, now_s, position=sources.position, velocity=sources.velocity):
            case Fusion.FUSED:
                counts.accepted += 1
            case Fusion.REJECTED:
                counts.rejected += 1
            case Fusion.RESET:
                counts.resets += 1

    def _align(self, fix: Fix, now_s: float) -> bool:
        ready = self._alignment.ready(now_s)
        if ready and self._readings is not None:
            r, (vn, ve, vd) = self._readings, fix.velocity_ned_mps
            here = np.array([*self._frame.to_local(fix.lat_deg, fix.lon_deg), r.baro_amsl_m])
            there = Navigation(here, np.array([ve, vn, -vd]), r.yaw_rad, r.pitch_rad, r.roll_rad, r.airspeed_mps or 0.0)
            self.ekf = Ekf(self._frame, there, fixed_wing=self.kind is Kind.PLANE)
        return ready

    def _has_stopped(self, now_s: float) -> bool:
        """Whether the filter has stopped aiding. A plane's is aided by airspeed and zero sideslip."""
        last_pass_s = None if self.ekf is None else self.ekf.last_pass_s
        return self.kind is Kind.COPTER and last_pass_s is not None and now_s - last_pass_s > STOPPED_AFTER_S

    def _sources(self) -> Sources:
        wanted = (self.parameters[f"EK3_SRC{self._source_set}_{what}"] == SOURCE_GPS for what in ("POSXY", "VELXY"))
        return Sources(*wanted)

    # --- status ---

    def _update_status(self, now_s: float) -> None:
        self._receivers.update(now_s)
        fix, dcm = self._receivers.fix_in_use() is not None, not int(self.parameters["AHRS_OPTIONS"]) & NO_DCM
        self._send_texts(
            self.status.update(self.ekf, self._sources(), now_s, flying=self.flying, gps_3d=fix, dcm=dcm), now_s
        )
        if not self.status.aiding and self.ekf is not None:
            self.ekf.hold_position()

    def _send_texts(self, texts: Iterable[StatusMessage], now_s: float) -> None:
        for severity, text in texts:
            self._wire.send_text(severity, text, now_s)

    def _snapshot(self, now_s: float, readings: Readings) -> Snapshot:
        unix_us = 0 if self._unix_minus_flight_s is None else round((now_s + self._unix_minus_flight_s) * 1e6)
        ratios = (0.0, 0.0) if self.ekf is None else (self.ekf.velocity_ratio, self.ekf.position_ratio)
        return Snapshot(
            boot_ns=self._boot_ns(now_s),
            unix_us=unix_us,
            kind=self.kind,
            frame=self._frame,
            home_amsl_m=self._home_amsl_m or 0.0,
            readings=readings,
            navigation=self.navigation(),
            gps=self.gps,
            armed=self.armed,
            ekf_flags=self.status.flags(running=self.ekf is not None),
            velocity_variance=math.sqrt(ratios[0]),
            position_variance=math.sqrt(ratios[1]),
        )

    # --- commands ---

    def _set_parameter(self, message: Any, now_s: float) -> None:
        name = message.param_id
        if name not in self.parameters:
            return
        self.parameters[name] = message.param_value
        self._wire.send_parameters([name])
        self._send_texts(self._receivers.on_parameter_change(name), now_s)

    def _execute(self, message: Any, now_s: float) -> int:
        """Executes a command; returns a MAV_RESULT."""
        if message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            if not 1 <= message.param1 <= SOURCE_SETS:
                return int(mavlink.MAV_RESULT_DENIED)
            self._source_set = int(message.param1)
            return int(mavlink.MAV_RESULT_ACCEPTED)
        if message.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE and message.get_type() == "COMMAND_INT":
            return self._external_position(message, now_s)
        return int(mavlink.MAV_RESULT_UNSUPPORTED)

    def _external_position(self, message: Any, now_s: float) -> int:
        """Applies MAV_CMD_EXTERNAL_POSITION_ESTIMATE: a position reset, only while no GPS is fused; it is not an aid
        (the flags still drop).
        """
        if message.frame not in GLOBAL_FRAMES or not math.isnan(message.z):
            return int(mavlink.MAV_RESULT_DENIED)
        last_pass_s = None if self.ekf is None else self.ekf.last_pass_s
        if self.ekf is None or not self.status.aiding or last_pass_s is None or now_s - last_pass_s <= EXTERNAL_AFTER_S:
            return int(mavlink.MAV_RESULT_FAILED)
        here = np.array(self._frame.to_local(message.x / 1e7, message.y / 1e7))
        here += self.ekf.navigation().velocity_enu_mps[:2] * min(5.0, max(0.0, message.param2))
        self.ekf.reset(here, 1.0 if math.isnan(message.param3) else message.param3)
        return int(mavlink.MAV_RESULT_ACCEPTED)
