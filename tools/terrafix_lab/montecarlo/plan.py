"""Parameters of one flight of the Monte Carlo run, drawn from its seed: vehicle, weather, ground, errors, faults."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from msgspec import UNSET

from terrafix.map.format import CE90_SIGMAS
from terrafix.messages import Camera, Gimbal
from terrafix_lab.faults.fault import Need
from terrafix_lab.faults.table import FAULTS
from terrafix_lab.montecarlo.fault import LIES, DrawnFault
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.vehicle.wind import Wind

DURATION_S = 600.0
HALTON = (5, 7)  # bases of the sequence of map errors (Halton 1960), coprime to the length of ROUND
# Cameras of the real flights and of the simulated ones: width, height, focal length in pixels.
CAMERAS = ((1280, 720, 684.0), (1600, 900, 1164.4), (960, 540, 560.0))
FLAT_M = 2.0  # largest 1-sigma of the relief for a map without elevation
PHOTOS_HZ = 0.2
HEIGHT_SCALES = (
    0.7,
    1.3,
    3.28084,
    1.0 / 3.28084,
)  # false: 30 % wrong, and feet confused with metres in both directions
FOCAL_FACTORS = (0.5, 2.0)  # false, stated over true; log-uniform between them
LAG_S = (0.2, 1.0)  # range of the age of late pictures
START_ERROR_M, START_SIGMA_M = 300.0, 50.0  # of a false start: error and stated 1-sigma
FOCAL_SIGMA, K1_SIGMA = 0.01, 0.005  # of a lens with a single calibration or the manufacturer's data


# Faults of twelve successive flights. A third has none: their rates are those of ordinary operation.
ROUND = (
    DrawnFault.NONE,
    DrawnFault.WRONG,
    DrawnFault.NONE,
    DrawnFault.BLACKOUT,
    DrawnFault.NONE,
    DrawnFault.HEIGHT,
    DrawnFault.LATE,
    DrawnFault.JUMPS,
    DrawnFault.COMPASS,
    DrawnFault.NONE,
    DrawnFault.ROWS,
    DrawnFault.DRIFT,
)


@dataclass(frozen=True)
class FlightPlan:
    """All drawn parameters. The same seed and number give the same flight."""

    seed: int  # of all random numbers of this flight
    number: int
    kind: Kind
    fault: str  # a DrawnFault, or a row of the table of faults
    duration_s: float
    frame_hz: float
    agl_m: float
    cruise_mps: float
    wind: Wind
    hills_m: float
    settled: float
    has_dem: bool
    camera: Camera
    focal_error: float  # relative
    k1_error: float  # of the first radial coefficient of the distortion
    has_imu: bool  # the autopilot streams inertial readings
    mount_error_rad: tuple[float, float]  # about the camera's x and y
    gimbal: bool
    gimbal_reports: bool
    map_sigma_m: float  # stated by the map package
    map_offset_m: tuple[float, float]
    start_sigma_m: float
    start_error_m: tuple[float, float]
    height_scale: float
    compass_rad: float | None  # constant error of the heading; None: drawn by the sensor model
    lies: frozenset[DrawnFault] = frozenset()  # of LIES
    picture_lag_s: float = 0.0  # age of each picture at its time stamp


def plan(
    run_seed: int,
    number: int,
    *,
    fault: str | None = None,
    duration_s: float = DURATION_S,
    lie_share: float = 0.0,
) -> FlightPlan:
    """Flight ``number`` of a run. ``fault``: instead of that of ROUND. ``lie_share``: probability of each of LIES in a
    flight, in addition to its fault."""
    rng = np.random.default_rng([run_seed, number, 50])
    chosen = ROUND[number % len(ROUND)] if fault is None else fault
    reports = chosen in FAULTS and Need.GIMBAL in FAULTS[chosen].needs
    kind = Kind.PLANE if rng.uniform() < 0.5 and not reports else Kind.COPTER
    width, height, focal = CAMERAS[int(rng.integers(len(CAMERAS)))]
    gimbal = kind is Kind.COPTER and (rng.uniform() < 0.5 or reports)
    tolerance_deg = float(rng.choice([2.0, 5.0]))
    tilt = np.radians(tolerance_deg) * rng.normal(size=2)
    wind_mps, wind_from = float(rng.uniform(0.0, 8.0)), float(rng.uniform(0.0, 2.0 * math.pi))
    ce90_m = float(rng.choice([3.0, 5.0, 10.0]))
    start_sigma_m = float(rng.choice([5.0, 10.0, 25.0]))
    hills_m = float(rng.choice([1.0, 5.0, 20.0]))
    sign = 1.0 if rng.uniform() < 0.5 else -1.0
    drawn = FlightPlan(
        seed=int(rng.integers(1 << 31)),
        number=number,
        kind=kind,
        fault=chosen,
        duration_s=duration_s,
        frame_hz=1.0,
        agl_m=float(rng.uniform(80.0, 180.0)),
        cruise_mps=float(rng.uniform(18.0, 26.0) if kind is Kind.PLANE else rng.uniform(6.0, 14.0)),
        wind=Wind(wind_mps * math.sin(wind_from), wind_mps * math.cos(wind_from)),
        hills_m=hills_m,
        settled=float(rng.uniform(0.02, 0.35)),
        has_dem=hills_m > FLAT_M or bool(rng.uniform() < 0.5),
        camera=_camera(width, height, focal, tolerance_deg, reports),
        has_imu=bool(number % 2),
        focal_error=float(rng.normal(0.0, FOCAL_SIGMA)),
        k1_error=float(rng.normal(0.0, K1_SIGMA)),
        mount_error_rad=(float(tilt[0]), float(tilt[1])),
        gimbal=gimbal,
        gimbal_reports=reports,
        map_sigma_m=ce90_m / CE90_SIGMAS,
        map_offset_m=_map_offset(run_seed, number, ce90_m / CE90_SIGMAS),
        start_sigma_m=start_sigma_m,
        start_error_m=tuple((start_sigma_m * rng.normal(size=2)).tolist()),
        height_scale=1.0 + float(rng.normal(0.0, 0.01)),
        compass_rad=None,
    )
    drawn = _with_lies(drawn, _lies(run_seed, number, chosen, lie_share))
    return _with_fault(drawn, sign, rng)


def _camera(width: int, height: int, focal_px: float, mount_tolerance_deg: float, gimbal: bool) -> Camera:
    return Camera(
        width=width,
        height=height,
        fx=focal_px,
        fy=focal_px,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        focal_sigma=FOCAL_SIGMA,
        mount_tolerance_deg=mount_tolerance_deg,
        gimbal=Gimbal() if gimbal else UNSET,
    )


def _with_fault(drawn: FlightPlan, sign: float, rng: np.random.Generator) -> FlightPlan:
    """With the parameters that the fault of the flight changes. ``sign``: of an error of height or heading."""
    changes: dict[str, dict[str, Any]] = {
        DrawnFault.HILLS: {"hills_m": 20.0, "has_dem": False},
        DrawnFault.PHOTOS: {"frame_hz": PHOTOS_HZ, "has_imu": False},
        DrawnFault.HEIGHT: {"height_scale": 1.0 + sign * 0.1},
        DrawnFault.COMPASS: {"compass_rad": sign * math.radians(float(rng.uniform(10.0, 15.0)))},
    }
    return replace(drawn, **changes.get(drawn.fault, {}))


def _lies(run_seed: int, number: int, chosen: str, share: float) -> frozenset[DrawnFault]:
    draws = np.random.default_rng([run_seed, number, 59]).uniform(size=len(LIES))
    return frozenset(lie for lie, draw in zip(LIES, draws.tolist(), strict=True) if draw < share or lie is chosen)


def _with_lies(drawn: FlightPlan, lies: frozenset[DrawnFault]) -> FlightPlan:
    """With the false inputs that last for the whole flight; montecarlo/lies.py has the others."""
    rng = np.random.default_rng([drawn.seed, 60])
    scale = float(rng.choice(HEIGHT_SCALES))
    factor = math.exp(float(rng.uniform(*np.log(FOCAL_FACTORS))))
    turn_rad = math.radians(float(rng.choice([-90.0, 90.0, 180.0])))
    lag_s, towards = float(rng.uniform(*LAG_S)), float(rng.uniform(0.0, 2.0 * math.pi))
    start_error_m = (START_ERROR_M * math.sin(towards), START_ERROR_M * math.cos(towards))
    changes: dict[DrawnFault, dict[str, Any]] = {
        DrawnFault.SCALE: {"height_scale": scale},
        DrawnFault.FOCAL: {"focal_error": 1.0 / factor - 1.0},
        DrawnFault.HEADING: {"compass_rad": turn_rad},
        DrawnFault.STALE: {"picture_lag_s": lag_s},
        DrawnFault.START: {"start_sigma_m": START_SIGMA_M, "start_error_m": start_error_m},
    }
    changed = {name: value for lie in lies for name, value in changes.get(lie, {}).items()}
    return replace(drawn, lies=lies, **changed)


def _map_offset(run_seed: int, number: int, sigma_m: float) -> tuple[float, float]:
    """Registration error (east, north) [m] of the map of one flight, normally distributed with ``sigma_m`` per axis.

    It is constant in a flight, so that a hundred flights have only a hundred draws. Radius and direction come from a
    low-discrepancy sequence, which covers the distribution evenly."""
    radius = sigma_m * math.sqrt(-2.0 * math.log(1.0 - _halton(number + 1, HALTON[0])))
    first = float(np.random.default_rng([run_seed, 53]).uniform())
    towards = 2.0 * math.pi * (first + _halton(number + 1, HALTON[1]))
    return radius * math.sin(towards), radius * math.cos(towards)


def _halton(number: int, base: int) -> float:
    """Radical inverse: the digits of ``number``, mirrored at the point."""
    value, place = 0.0, 1.0
    while number:
        place /= base
        number, digit = divmod(number, base)
        value += place * digit
    return value
