"""Vehicles of MAVLink: the firmware that a vehicle type runs, and the choice of one of several in a log."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

# MAV_TYPE of common.xml by the firmware of ArduPilot that reports it; a type that is in none of them has no mode names.
# [spec: MAVLink common.xml MAV_TYPE; get_mav_type of the ArduPilot vehicles, 19 to 25 are VTOLs, which run ArduPlane]
ARDUPILOT_TYPES: dict[str, frozenset[int]] = {
    "ArduCopter": frozenset({2, 3, 4, 13, 14, 15, 29, 35}),
    "ArduPlane": frozenset({1, *range(19, 26)}),
    "Rover": frozenset({10, 11}),
    "ArduSub": frozenset({12}),
    "Blimp": frozenset({7}),
    "AntennaTracker": frozenset({5}),
}
NO_VEHICLES = frozenset({5, 6, 18, 26, 27, *range(30, 35), *range(36, 43), 44, 48})  # trackers, stations, components
# MAV_COMP_ID_AUTOPILOT1; ground stations, cameras and gimbals send heartbeats as well [spec: MAVLink]
AUTOPILOT_COMPONENT = 1
ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT
ARMED_FLAG = 128  # MAV_MODE_FLAG_SAFETY_ARMED
# A vehicle whose attitude swings by more than this, or which is faster, is not standing. Compass and level of a
# standing one wander by a degree or two; GNSS velocity has a noise of some 0.1 m/s.
MIN_SWING_RAD, MIN_MOVING_MPS = math.radians(6.0), 2.0
SWING_SHARE = 0.02  # of the attitudes at each end that do not count, of a vehicle that is being handled


def firmware_of(autopilot: int, vehicle_type: int) -> str:
    """Firmware by MAV_AUTOPILOT and MAV_TYPE of a heartbeat; "" where it is not known."""
    if autopilot == PX4:
        return "PX4"
    if autopilot != ARDUPILOT:
        return ""
    return next((name for name, types in ARDUPILOT_TYPES.items() if vehicle_type in types), "")


@dataclass
class HeardVehicle:
    """What a log has of the autopilot of one system."""

    system_id: int
    firmware: str = ""
    vehicle_type: int | None = None  # MAV_TYPE of its first heartbeat
    packets: int = 0
    armed: bool = False  # at some time
    readings: int = 0  # attitudes, heights, headings
    angles_rad: list[tuple[float, float, float]] = field(default_factory=list)  # roll, pitch, yaw
    speed_mps: float = 0.0  # highest

    @property
    def moves(self) -> bool:
        """Whether it does not just stand."""
        return self.speed_mps > MIN_MOVING_MPS or _swing_rad(self.angles_rad) > MIN_SWING_RAD

    def name(self) -> str:
        """ "1 (ArduCopter)"; of a vehicle without a known firmware its type."""
        unknown = "no heartbeat" if self.vehicle_type is None else f"MAV_TYPE {self.vehicle_type}"
        return f"{self.system_id} ({self.firmware or unknown})"

    def text(self) -> str:
        state = ("moves" if self.moves else "stands") if self.readings else "sends no telemetry"
        armed = ", armed" if self.armed else ""
        return f"{self.name()[:-1]}, {len(self.angles_rad)} attitudes, {state}{armed})"


@dataclass(frozen=True)
class Choice:
    """``vehicle``: None when several could be meant. ``why``: in words; empty for the only one that was heard."""

    vehicle: HeardVehicle | None
    why: str = ""


def choose_vehicle(heard: Sequence[HeardVehicle], system_id: int) -> Choice:
    """The vehicle to read: that of ``system_id``; with 0 the only one, or the only one that moves."""
    if system_id:
        chosen = next((v for v in heard if v.system_id == system_id), None)
        return Choice(chosen, "as chosen" if len(heard) > 1 else "")
    vehicles = [v for v in heard if v.readings and v.vehicle_type not in NO_VEHICLES] or list(heard)
    if len(vehicles) == 1:
        return Choice(vehicles[0], "the only vehicle with telemetry" if len(heard) > 1 else "")
    moving = [v for v in vehicles if v.moves]
    if len(moving) > 1:
        moving = [v for v in moving if v.armed]
    return Choice(moving[0], "the only one that moves") if len(moving) == 1 else Choice(None)


def _swing_rad(angles_rad: Sequence[tuple[float, float, float]]) -> float:
    """Largest range of roll, pitch or yaw, without SWING_SHARE at each end; yaw as its distance from the first one."""
    if not angles_rad:
        return 0.0
    cut = int(SWING_SHARE * len(angles_rad))
    columns = [[a[k] for a in angles_rad if math.isfinite(a[k])] for k in range(3)]
    columns[2] = [math.remainder(yaw - columns[2][0], math.tau) for yaw in columns[2]]
    swings = [0.0]
    for column in columns:
        kept = sorted(column)[cut : len(column) - cut]
        swings.append(kept[-1] - kept[0] if kept else 0.0)
    return max(swings)
