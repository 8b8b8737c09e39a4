"""A MAVLink autopilot in lock-step: readings and packets in, packets and a belief out; no thread, socket or clock.

It stands in for ArduPilot 4.6 where GPS is concerned; it is not one. Tests compare it with what was measured on the
firmware. Not simulated: several filter lanes and their switching, yaw and attitude as states (the readings have
them), blending of two GPS, ODOMETRY and other external navigation, flight modes. So a fail-safe is said and counted,
and the vehicle flies on.

Measured on the firmware and not shown here (docs/closed-loop.md says more): how little of a step of 200 m is taken over
in 30 s at an accuracy of 100 m; LAND after a reset onto 120 m, and when a copter's velocity is ignored; the overshoot
of position alone after a step; 40 ms of DCM at the first fix after a silence; a silent GPS1 left in 2.5 s (here 4)."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.geodesy import LocalFrame
from terrafix.link.output.gps_time import GPS_EPOCH_UNIX_S, gps_minus_utc_s
from terrafix_tools.sim.autopilot.align import Alignment, complaints
from terrafix_tools.sim.autopilot.ekf import Ekf, Fusion
from terrafix_tools.sim.autopilot.gps import WEEK_S, Fix, GpsInputDriver, GpsInstance
from terrafix_tools.sim.autopilot.parameters import Kind, parameters_of
from terrafix_tools.sim.autopilot.receivers import Receivers
from terrafix_tools.sim.autopilot.status import CRITICAL, EXTERNAL_AFTER_S, INFO, Said, Sources, Status
from terrafix_tools.sim.autopilot.streams import Snapshot
from terrafix_tools.sim.autopilot.wire import Wire
from terrafix_tools.sim.interfaces import Navigation, Readings

BOOTED_BEFORE_S = 42.0  # the autopilot's clock is not ours: another start,
CLOCK_DRIFT = 20e-6  # and another crystal
PREARM_PERIOD_S = 30.0
AIRBORNE_M = 3.0  # above home by the barometer: whoever is there was armed
SOURCE_GPS = 3  # EK3_SRCn_POSXY, VELXY
SOURCE_SETS = 3
NO_DCM = 1  # AHRS_OPTIONS
GLOBAL_FRAMES = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)


@dataclass
class Counts:
    """GPS_INPUT only."""

    received: int = 0
    other_instance: int = 0  # for a gps_id that is not a GPS of this type
    no_fix: int = 0  # below 3D: not offered to the filter
    accepted: int = 0
    rejected: int = 0
    resets: int = 0
    not_in_use: int = 0  # another GPS is
    waiting_for_alignment: int = 0


def own_clock_ns(now_s: float) -> int:
    """Seconds of the flight -> nanoseconds since the autopilot's boot."""
    return round((now_s * (1.0 + CLOCK_DRIFT) + BOOTED_BEFORE_S) * 1e9)


class SimAutopilot:
    """The ``Autopilot`` of interfaces.py."""

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
        """``start``: it is in the air and knows where; None: on the ground, nothing known. ``home_amsl_m``: zero of its
        relative height; None: where the barometer first is. Raises UsageError for an unknown parameter."""
        self.parameters = parameters_of(kind, parameters)
        self.kind, self._frame, self._boot_ns = kind, frame, boot_ns
        self.flying = self.armed = start is not None
        self.ekf = Ekf(frame, start, flies_by_air=kind is Kind.PLANE) if start is not None else None
        self.status = Status(kind, placed=start is not None)
        self._receivers = Receivers(self.parameters)
        self.counts = Counts()
        self.taken: list[Fix] = []  # 3D fixes by GPS_INPUT; whoever watches empties it
        self._wire = Wire(self.parameters, sysid, boot_ns)
        self._alignment = Alignment(kind)
        self._source_set = 1
        self._home_amsl_m = home_amsl_m
        self._using_since_s: float | None = None
        self._unix_minus_flight_s: float | None = None
        self._readings: Readings | None = None
        self._prearm_s = -math.inf

    @property
    def wire(self) -> Wire:
        """What was heard and said, for whoever watches."""
        return self._wire

    @property
    def gps(self) -> list[GpsInstance | None]:
        """GPS1 and GPS2; None where there is none."""
        return self._receivers.gps

    @property
    def used_gps(self) -> int:
        """Index of the GPS in use."""
        return self._receivers.used

    # --- the contract ---

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
            for gps, fix in self._receivers.take_gnss(readings.gnss, now_s):
                self._offer(gps, fix, now_s)
        self._look(now_s)
        self._wire.stream(now_s, lambda: self._snapshot(now_s, readings))

    def receive(self, packets: bytes, now_s: float) -> None:
        for message in self._wire.receive(packets, now_s):
            match message.get_type():
                case "GPS_INPUT":
                    self._take_gps_input(message, now_s)
                case "PARAM_SET":
                    self._set_parameter(message, now_s)
                case "COMMAND_LONG" | "COMMAND_INT":
                    self._wire.acknowledge(message.command, self._obey(message, now_s))

    def transmit(self) -> bytes:
        return self._wire.take()

    def navigation(self) -> Navigation | None:
        if self.ekf is None:
            return None
        believed = self.ekf.navigation()
        fix = self._receivers.fix_in_use()
        if not self.status.on_dcm or fix is None or self._readings is None:
            return believed
        e_m, n_m = self._frame.to_local(fix.lat_deg, fix.lon_deg)
        vn, ve, _ = fix.velocity_ned_mps
        age_s = self._readings.t_s - fix.t_s
        raw = np.array([e_m + ve * age_s, n_m + vn * age_s, believed.p_b_in_w_m[2]])
        return replace(believed, p_b_in_w_m=raw)

    def prearm(self, now_s: float) -> list[str]:
        """What stands against arming."""
        return complaints(self.gps, self._alignment, self._using_since_s, self.parameters, self.kind, now_s)

    # --- GPS ---

    def _take_gps_input(self, message: Any, now_s: float) -> None:
        self.counts.received += 1
        heard, said = self._receivers.take_gps_input(message, now_s)
        self._say(said, now_s)
        if heard is None:
            self.counts.other_instance += 1
            return
        gps, fix = heard
        if fix is None:
            self.counts.no_fix += 1
        else:
            self.taken.append(fix)
            if message.time_week > 0:
                unix_s = GPS_EPOCH_UNIX_S + message.time_week * WEEK_S + message.time_week_ms / 1e3
                self._unix_minus_flight_s = unix_s - gps_minus_utc_s(int(unix_s)) - now_s
        self._offer(gps, fix, now_s)

    def _offer(self, gps: GpsInstance, fix: Fix | None, now_s: float) -> None:
        """To the filter, when this is the GPS in use."""
        counts = self.counts if isinstance(gps, GpsInputDriver) else Counts()
        self._receivers.choose(now_s)
        if self.gps[self.used_gps] is not gps:
            counts.not_in_use += fix is not None
            return
        if fix is None:
            self._alignment.broken()
            return
        self.status.heard(fix, now_s)
        if self.ekf is None and not self._align(fix, now_s):
            counts.waiting_for_alignment += 1
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
        check, scale = int(self.parameters["EK3_GPS_CHECK"]), self.parameters["EK3_CHECK_SCALE"]
        had_origin = self._alignment.origin_s is not None
        ready = self._alignment.take(fix, now_s, check, scale)
        if not had_origin and self._alignment.origin_s is not None:
            self._wire.say(INFO, "EKF3 IMU0 origin set", now_s)
        if ready and self._readings is not None:
            r, (vn, ve, vd) = self._readings, fix.velocity_ned_mps
            here = np.array([*self._frame.to_local(fix.lat_deg, fix.lon_deg), r.baro_amsl_m])
            there = Navigation(here, np.array([ve, vn, -vd]), r.yaw_rad, r.pitch_rad, r.roll_rad, r.airspeed_mps or 0.0)
            self.ekf = Ekf(self._frame, there, flies_by_air=self.kind is Kind.PLANE)
        return ready

    def _sources(self) -> Sources:
        wanted = (self.parameters[f"EK3_SRC{self._source_set}_{what}"] == SOURCE_GPS for what in ("POSXY", "VELXY"))
        return Sources(*wanted)

    # --- conclusions ---

    def _look(self, now_s: float) -> None:
        self._receivers.look(now_s)
        fix, dcm = self._receivers.fix_in_use() is not None, not int(self.parameters["AHRS_OPTIONS"]) & NO_DCM
        self._say(self.status.look(self.ekf, self._sources(), now_s, flying=self.flying, gps_3d=fix, dcm=dcm), now_s)
        if not self.status.aiding and self.ekf is not None:
            self.ekf.hold_position()
        if self.status.absolute and self._using_since_s is None:
            self._using_since_s = now_s
        if not self.armed and now_s - self._prearm_s >= PREARM_PERIOD_S:
            self._prearm_s = now_s
            self._say([(CRITICAL, f"PreArm: {text}") for text in self.prearm(now_s)], now_s)

    def _say(self, texts: Iterable[Said], now_s: float) -> None:
        for severity, text in texts:
            self._wire.say(severity, text, now_s)

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

    # --- orders ---

    def _set_parameter(self, message: Any, now_s: float) -> None:
        name = message.param_id
        if name not in self.parameters:
            return
        self.parameters[name] = message.param_value
        self._wire.tell_parameters([name])
        self._say(self._receivers.changed(name), now_s)

    def _obey(self, message: Any, now_s: float) -> int:
        """-> MAV_RESULT"""
        if message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            if not 1 <= message.param1 <= SOURCE_SETS:
                return int(mavlink.MAV_RESULT_DENIED)
            self._source_set = int(message.param1)
            return int(mavlink.MAV_RESULT_ACCEPTED)
        if message.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE and message.get_type() == "COMMAND_INT":
            return self._external_position(message, now_s)
        return int(mavlink.MAV_RESULT_UNSUPPORTED)

    def _external_position(self, message: Any, now_s: float) -> int:
        """A hard reset, taken only while no GPS is fused; it is not an aid (the flags still drop)."""
        if message.frame not in GLOBAL_FRAMES or not math.isnan(message.z):
            return int(mavlink.MAV_RESULT_DENIED)
        passed_s = None if self.ekf is None else self.ekf.passed_s
        if self.ekf is None or not self.status.aiding or passed_s is None or now_s - passed_s <= EXTERNAL_AFTER_S:
            return int(mavlink.MAV_RESULT_FAILED)
        here = np.array(self._frame.to_local(message.x / 1e7, message.y / 1e7))
        here += self.ekf.navigation().velocity_enu_mps[:2] * min(5.0, max(0.0, message.param2))
        self.ekf.reset(here, 1.0 if math.isnan(message.param3) else message.param3)
        return int(mavlink.MAV_RESULT_ACCEPTED)
