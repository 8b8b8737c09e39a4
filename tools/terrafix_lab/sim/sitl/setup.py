"""The simulated vehicle: firmware parameters, mission, and their position in the generated world.

The parameters that concern Terrafix are in config/vehicles/, so that the tested files are those that users load.
"""

import math
from pathlib import Path

from terrafix.core.errors import OutputError, UsageError
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.world.place import World
from terrafix_tools.mission.items import Do, Item, Mission

CRUISE_M = 120.0  # above home
APPROACH_M = 55.0  # height of the last waypoint before the landing, for a plane
APPROACH_FROM_M = 480.0  # its distance from the landing point: a glide path of 6.5 degrees
WORLD_M = (4000.0, 2000.0)  # east-west, north-south
WEST_EAST_M = (500.0, 3500.0)  # the longest loop, in plan metres of the world: the camera covers
NORTH_SOUTH_M = (500.0, 1500.0)  # about 110 m to each side, and a plane turns wide
HOME_EAST_M = 2000.0  # on the southern side, which leaves room for climb and glide path
EXTRA_M = 2800.0  # distance that may be flown before the GNSS loss, plus what a plane cuts off at the corners
LAPS_MAX = 20
HEADING_DEG = 90.0  # take-off and landing, to the east
SPEED_MPS = {Kind.PLANE: 22.0, Kind.COPTER: 9.0}  # at 12 m/s the copter reaches its lean limit into the wind

# Two accelerometers that count as calibrated (any offset but zero), no radio input, no terrain database: the simulated
# ground is flat at the height of home.
BOTH = {
    "SERIAL1_PROTOCOL": 2,
    "SERIAL2_PROTOCOL": 2,
    "TERRAIN_ENABLE": 0,
    "SIM_TERRAIN": 0,
    "SIM_WIND_SPD": 3,
    "SIM_WIND_DIR": 90,  # from the east: take-off and landing into the wind
    "SIM_WIND_TURB": 0.5,
    **{f"INS_ACC{n}OFFS_{axis}": 0.001 for n in ("", "2") for axis in "XYZ"},
    **{f"INS_ACC{n}SCAL_{axis}": 1.001 for n in ("", "2") for axis in "XYZ"},
    # the simulated compasses have these offsets (SIM_MAG1_OFS); the opposite sign calibrates them
    **{f"COMPASS_OFS{n}_{axis}": v for n in ("", "2", "3") for axis, v in (("X", 5), ("Y", 13), ("Z", -18))},
    **{f"RC{n}_MIN": 1000 for n in range(1, 9)},
    **{f"RC{n}_MAX": 2000 for n in range(1, 9)},
}
PLANE = {
    "RC3_TRIM": 1000,
    "SERVO3_MIN": 1000,  # the simulated motor stands still at 1000, and drives the plane at 1100
    "SERVO3_MAX": 2000,
    "THR_FAILSAFE": 0,
    "AIRSPEED_CRUISE": SPEED_MPS[Kind.PLANE],
    "AIRSPEED_MIN": 14,
    "AIRSPEED_MAX": 30,
    "ARSPD_USE": 1,
    "ARSPD_PIN": 1,
    "ARSPD_BUS": 2,
    "KFF_RDDRMIX": 0.5,
    "WP_RADIUS": 60,
    "NAVL1_PERIOD": 15,
    # rate loops of the simulated airframe, which responds faster than the defaults expect
    "RLL_RATE_P": 0.3,
    "RLL_RATE_I": 0.25,
    "RLL_RATE_D": 0.017,
    "RLL_RATE_FF": 0.24,
    "PTCH_RATE_P": 0.15,
    "PTCH_RATE_I": 0.11,
    "PTCH_RATE_D": 0.007,
    "PTCH_RATE_FF": 0.6,
}
COPTER = {
    "FRAME_CLASS": 1,
    "FRAME_TYPE": 0,
    "FS_THR_ENABLE": 0,
    "AUTO_OPTIONS": 3,  # may be armed in AUTO, and takes off without raised throttle: there is no pilot
    "WPNAV_SPEED": SPEED_MPS[Kind.COPTER] * 100,
    "WPNAV_SPEED_UP": 400,
    "WPNAV_SPEED_DN": 300,
    "LAND_SPEED": 80,
    "ATC_RAT_YAW_P": 0.3,
    "ATC_RAT_YAW_I": 0.02,
}
VEHICLE = {Kind.PLANE: BOTH | PLANE, Kind.COPTER: BOTH | COPTER}


def write_parameters(path: Path, kind: Kind) -> None:
    """Writes the defaults of the simulated vehicle. Raises OutputError."""
    lines = [f"{name},{value:g}" for name, value in VEHICLE[kind].items()]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None


def place_of(world: World) -> tuple[float, float]:
    """Returns the take-off and landing position (lat_deg, lon_deg), on the southern side of the loop."""
    return world.wgs84(HOME_EAST_M, NORTH_SOUTH_M[1])


def laps_for(length_m: float) -> tuple[int, float]:
    """Returns the number of laps that ``length_m`` needs after the GNSS loss, and the length of one lap, m."""
    (west, east), (north, south) = WEST_EAST_M, NORTH_SOUTH_M
    longest_m = 2 * (east - west) + 2 * (south - north)
    shortest_m = 8 * APPROACH_FROM_M + 2 * (south - north)  # a plane's glide path begins inside the loop
    needed_m = max(length_m + EXTRA_M, shortest_m)
    laps = math.ceil(needed_m / longest_m)
    return laps, needed_m / laps


def mission_for(world: World, kind: Kind, length_m: float) -> Mission:
    """Builds the mission: take-off, laps of the loop for ``length_m`` after the GNSS loss, landing at home. Raises
    UsageError.
    """
    north, south = NORTH_SOUTH_M
    laps, lap_m = laps_for(length_m)
    if length_m <= 0.0 or laps > LAPS_MAX:
        raise UsageError(f"--length {length_m / 1e3:g}: choose more than 0 and at most {LAPS_MAX * lap_m / 1e3:.0f} km")
    half_m = lap_m / 4 - (south - north) / 2
    west, east = HOME_EAST_M - half_m, HOME_EAST_M + half_m
    corners = [(east, south), (east, north), (west, north), (west, south)]
    places = [(x, y, CRUISE_M) for _ in range(laps) for x, y in corners]
    if kind is Kind.PLANE:
        places.append((HOME_EAST_M - APPROACH_FROM_M, south, APPROACH_M))
    items = [Item(Do.TAKE_OFF, height_m=CRUISE_M / 2)]
    items += [Item(Do.WAYPOINT, len(items), *world.wgs84(x, y), height_m=up) for x, y, up in places]
    home = place_of(world)
    items.append(Item(Do.LAND, len(items), *home, height_m=0.0))
    return Mission("SITL harness mission", *home, tuple(items))
