"""Rig of the tests of the simulated autopilot: a vehicle in steady flight with almost perfect sensors, and GPS_INPUT
with adjustable errors."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.geodesy import LocalFrame, rot_w_b
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.parameters import GPS_INPUT_ALONE, NO_DCM, Kind
from terrafix_lab.sim.interfaces import GnssFix, Navigation, Readings

LAT, LON, HOME_M, HEIGHT_M = 48.0, 11.0, 500.0, 620.0
STEP_S = 0.02
GRAVITY = 9.80665
FRAME = LocalFrame(LAT, LON)


@dataclass(frozen=True)
class Gps:
    """Fields of GPS_INPUT; the defaults are those of a healthy sender. Position: the truth plus ``north_m``."""

    north_m: float = 0.0
    hacc: float = 1.0
    rate_hz: float = 5.0
    fix_type: int = 3
    satellites: int = 10
    hdop: float = 1.0
    vacc: float = 1.0
    sacc: float = 0.3
    velocity: tuple[float, float, float] | None = None  # None: the true one
    ignore: int = 0
    gps_id: int = 0
    late_s: float = 0.0  # age of the position


Given = Callable[[float], "Gps | None"]


class Rig:
    """``fly`` runs the autopilot for some seconds with a GPS. Results: ``autopilot``, ``error_m``, ``texts``, and
    ``received``, all MAVLink messages of the autopilot."""

    def __init__(
        self,
        kind: Kind,
        *,
        flying: bool = True,
        parameters: dict[str, float] | None = None,
        real_gps: Callable[[float], GnssFix | None] = lambda _: None,
        wind_en_mps: tuple[float, float] = (0.0, 5.0),
        accel_bias_mps2: float = 0.02,
        seed: int = 0,
    ) -> None:
        self.kind, self._real_gps = kind, real_gps
        self.velocity = np.array([22.0, 0.0, 0.0]) if kind is Kind.PLANE and flying else np.zeros(3)
        air = self.velocity[:2] - (wind_en_mps if kind is Kind.PLANE else (0.0, 0.0))
        self.airspeed = float(np.hypot(*air))
        self.yaw = math.atan2(air[0], air[1]) if self.airspeed > 0 else 0.0
        self._rng = np.random.default_rng(seed)
        self._bias = np.array([accel_bias_mps2, accel_bias_mps2, 0.0]) * self._rng.choice([-1.0, 1.0], 3)
        start = Navigation(self.truth(0.0), self.velocity, self.yaw, 0.0, 0.0, self.airspeed) if flying else None
        chosen = GPS_INPUT_ALONE | (NO_DCM if kind is Kind.PLANE else {}) | (parameters or {})
        self.autopilot = SimAutopilot(
            FRAME, kind, start=start, home_amsl_m=HOME_M if flying else HEIGHT_M, parameters=chosen
        )
        self.t_s = 0.0
        self._next_gps_s = 0.0
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
        self._parser = mavlink.MAVLink(None)
        self.received: list[Any] = []

    def truth(self, t_s: float) -> np.ndarray:
        """-> (3,) true position, ENU."""
        return np.array([*(self.velocity[:2] * t_s), HEIGHT_M])

    def fly(self, seconds: float, gps: Gps | Given | None = None, *, until: Callable[[], bool] | None = None) -> float:
        """``gps``: GPS_INPUT, or a function of the seconds since this call; None: not sent. ``until``: ends the run
        early when it is true. -> seconds flown."""
        began_s = self.t_s
        for _ in range(round(seconds / STEP_S)):
            self.t_s = round(self.t_s + STEP_S, 6)
            self.autopilot.step(self.t_s, self._readings())
            sent = gps(self.t_s - began_s) if callable(gps) else gps
            if sent is not None and self.t_s >= self._next_gps_s - 1e-9:
                self._next_gps_s = max(self._next_gps_s + 1.0 / sent.rate_hz, self.t_s)
                self.send(self._message(sent))
            self.received += self._parser.parse_buffer(self.autopilot.transmit()) or []
            if until is not None and until():
                break
        return self.t_s - began_s

    def send(self, message: Any) -> None:
        self.autopilot.receive(bytes(message.pack(self._mav)), self.t_s)
        self._mav.seq = (self._mav.seq + 1) % 256

    def request(self, message: Any, kind: str) -> list[Any]:
        """Sends a message -> the immediate replies of a type."""
        self.autopilot.transmit()
        self.send(message)
        return [m for m in self._parser.parse_buffer(self.autopilot.transmit()) or [] if m.get_type() == kind]

    def error_m(self) -> float:
        return float(np.hypot(*self.error_en_m()))

    def error_en_m(self) -> np.ndarray:
        """-> (2,) error of the autopilot's position, east and north."""
        navigation = self.autopilot.navigation()
        assert navigation is not None
        return navigation.p_b_in_w_m[:2] - self.truth(self.t_s)[:2]

    def north_m(self) -> float:
        """-> error of the autopilot's position to the north."""
        return float(self.error_en_m()[1])

    def texts(self) -> list[str]:
        return [text for _, text in self.autopilot.wire.sent_texts]

    def flags(self) -> int:
        return self.autopilot.status.flags(running=self.autopilot.ekf is not None)

    def last(self, kind: str) -> Any:
        return [m for m in self.received if m.get_type() == kind][-1]

    def _readings(self) -> Readings:
        force = rot_w_b(self.yaw, 0.0, 0.0).T @ np.array([0.0, 0.0, GRAVITY])
        return Readings(
            t_s=self.t_s,
            gyro_b_radps=np.zeros(3),
            accel_b_mps2=force + self._bias + self._rng.normal(0.0, 0.1, 3),
            yaw_rad=self.yaw,
            pitch_rad=0.0,
            roll_rad=0.0,
            baro_amsl_m=HEIGHT_M,
            airspeed_mps=self.airspeed + float(self._rng.normal(0.0, 0.2)) if self.kind is Kind.PLANE else None,
            gnss=self._real_gps(self.t_s),
        )

    def _message(self, gps: Gps) -> Any:
        p = self.truth(self.t_s - gps.late_s)
        lat, lon = FRAME.to_wgs84(float(p[0]), float(p[1]) + gps.north_m)
        vn, ve, vd = gps.velocity if gps.velocity is not None else (self.velocity[1], self.velocity[0], 0.0)
        return mavlink.MAVLink_gps_input_message(
            time_usec=0,
            gps_id=gps.gps_id,
            ignore_flags=gps.ignore,
            time_week_ms=0,
            time_week=0,
            fix_type=gps.fix_type,
            lat=round(lat * 1e7),
            lon=round(lon * 1e7),
            alt=HEIGHT_M,
            hdop=gps.hdop,
            vdop=1.0,
            vn=float(vn),
            ve=float(ve),
            vd=float(vd),
            speed_accuracy=gps.sacc,
            horiz_accuracy=gps.hacc,
            vert_accuracy=gps.vacc,
            satellites_visible=gps.satellites,
        )


GOOD = Gps()


def real_fix(lat_deg: float = LAT, lon_deg: float = LON, *, fix_type: int = 3, satellites: int = 14) -> GnssFix:
    """A fix of a healthy GNSS receiver."""
    return GnssFix(fix_type, lat_deg, lon_deg, HEIGHT_M, (0.0, 0.0, 0.0), 0.5, 0.8, 0.2, satellites, 0.8)


def at_5_hz(fix: Callable[[float], GnssFix | None]) -> Callable[[float], GnssFix | None]:
    """``fix`` at the rate of a receiver: None between the fixes."""
    return lambda t_s: fix(t_s) if round(t_s / STEP_S) % 10 == 0 else None


def changed(**changes: Any) -> Gps:
    """GOOD with other fields."""
    return replace(GOOD, **changes)
