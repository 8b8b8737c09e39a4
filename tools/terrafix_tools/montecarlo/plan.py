"""What a flight of the Monte Carlo run is, drawn from its seed: vehicle, weather, ground, camera, errors, faults."""

import math
from dataclasses import dataclass, replace

import numpy as np

from terrafix.map.format import CE90_SIGMAS
from terrafix.messages import Camera
from terrafix_tools.montecarlo.fault import LIES, Fault
from terrafix_tools.sim.autopilot.parameters import Kind
from terrafix_tools.sim.vehicle.wind import Wind

DURATION_S = 600.0
HALTON = (5, 7)  # bases of the map errors' sequence (Halton 1960); they share no factor with the round of faults
# Cameras of the real flights and of the simulated ones: width, height, focal length in pixels.
CAMERAS = ((1280, 720, 684.0), (1600, 900, 1164.4), (960, 540, 560.0))
FLAT_M = 2.0  # 1-sigma of the relief over which a map without elevation may be flown: the ground must be flat then
PHOTOS_HZ = 0.2
HEIGHT_SCALES = (0.7, 1.3, 3.28084, 1.0 / 3.28084)  # of a lie: 30 % off, and feet for metres both ways
FOCAL_FACTORS = (0.5, 2.0)  # described over true, by a lie; the logarithm is uniform between them
LAG_S = (0.2, 1.0)  # how old the pictures of a lie are
START_OFF_M, START_CLAIM_M = 300.0, 50.0
FOCAL_SIGMA, K1_SIGMA = 0.01, 0.005  # of a lens that was calibrated once, or whose maker's numbers were taken


# Of twelve flights. A third are without fault: rates there are what a customer sees.
ROUND = (
    Fault.NONE,
    Fault.WRONG,
    Fault.NONE,
    Fault.BLACKOUT,
    Fault.NONE,
    Fault.HEIGHT,
    Fault.LATE,
    Fault.JUMPS,
    Fault.COMPASS,
    Fault.NONE,
    Fault.ROWS,
    Fault.DRIFT,
)


@dataclass(frozen=True)
class FlightPlan:
    """Everything that is drawn. The same seed and number give the same flight."""

    seed: int  # of all that is random in it
    number: int
    kind: Kind
    fault: Fault
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
    map_sigma_m: float  # what the map's package states
    map_offset_m: tuple[float, float]
    start_sigma_m: float
    start_error_m: tuple[float, float]
    height_scale: float
    compass_rad: float | None  # None: of ordinary size
    lies: frozenset[Fault] = frozenset()  # of LIES
    picture_lag_s: float = 0.0  # so much older than its time says is each picture


def plan(
    run_seed: int,
    number: int,
    *,
    fault: Fault | None = None,
    duration_s: float = DURATION_S,
    lie_share: float = 0.0,
) -> FlightPlan:
    """Flight ``number`` of a run. ``fault``: this one, instead of the round's. ``lie_share``: probability of each of
    LIES in a flight, on top of its fault."""
    rng = np.random.default_rng([run_seed, number, 50])
    chosen = ROUND[number % len(ROUND)] if fault is None else fault
    kind = Kind.PLANE if rng.uniform() < 0.5 else Kind.COPTER
    width, height, focal = CAMERAS[int(rng.integers(len(CAMERAS)))]
    gimbal = kind is Kind.COPTER and rng.uniform() < 0.5
    tolerance_deg = float(rng.choice([2.0, 5.0]))
    camera = Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        focal_sigma=FOCAL_SIGMA,
        mount_tolerance_deg=tolerance_deg,
    )
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
        camera=camera,
        has_imu=bool(number % 2),
        focal_error=float(rng.normal(0.0, FOCAL_SIGMA)),
        k1_error=float(rng.normal(0.0, K1_SIGMA)),
        mount_error_rad=(float(tilt[0]), float(tilt[1])),
        gimbal=gimbal,
        map_sigma_m=ce90_m / CE90_SIGMAS,
        map_offset_m=_map_offset(run_seed, number, ce90_m / CE90_SIGMAS),
        start_sigma_m=start_sigma_m,
        start_error_m=tuple((start_sigma_m * rng.normal(size=2)).tolist()),
        height_scale=1.0 + float(rng.normal(0.0, 0.01)),
        compass_rad=None,
    )
    drawn = _lying(drawn, _lies(run_seed, number, chosen, lie_share))
    if chosen is Fault.HILLS:
        return replace(drawn, hills_m=20.0, has_dem=False)
    if chosen is Fault.PHOTOS:
        return replace(drawn, frame_hz=PHOTOS_HZ, has_imu=False)
    if chosen is Fault.HEIGHT:
        return replace(drawn, height_scale=1.0 + sign * 0.1)
    if chosen is Fault.COMPASS:
        return replace(drawn, compass_rad=sign * math.radians(float(rng.uniform(10.0, 15.0))))
    return drawn


def _lies(run_seed: int, number: int, chosen: Fault, share: float) -> frozenset[Fault]:
    draws = np.random.default_rng([run_seed, number, 59]).uniform(size=len(LIES))
    return frozenset(lie for lie, draw in zip(LIES, draws.tolist(), strict=True) if draw < share or lie is chosen)


def _lying(drawn: FlightPlan, lies: frozenset[Fault]) -> FlightPlan:
    """With the lies that are there from the first frame to the last; montecarlo/lies.py has the others."""
    rng = np.random.default_rng([drawn.seed, 60])
    scale = float(rng.choice(HEIGHT_SCALES))
    factor = math.exp(float(rng.uniform(*np.log(FOCAL_FACTORS))))
    turn_rad = math.radians(float(rng.choice([-90.0, 90.0, 180.0])))
    lag_s, towards = float(rng.uniform(*LAG_S)), float(rng.uniform(0.0, 2.0 * math.pi))
    changes: dict[str, object] = {"lies": lies}
    if Fault.SCALE in lies:
        changes |= {"height_scale": scale}
    if Fault.FOCAL in lies:
        changes |= {"focal_error": 1.0 / factor - 1.0}
    if Fault.HEADING in lies:
        changes |= {"compass_rad": turn_rad}
    if Fault.STALE in lies:
        changes |= {"picture_lag_s": lag_s}
    if Fault.START in lies:
        off_m = (START_OFF_M * math.sin(towards), START_OFF_M * math.cos(towards))
        changes |= {"start_sigma_m": START_CLAIM_M, "start_error_m": off_m}
    return replace(drawn, **changes)  # type: ignore[arg-type]


def _map_offset(run_seed: int, number: int, sigma_m: float) -> tuple[float, float]:
    """One draw of the map's registration holds for a whole flight and would make the result a lottery of a hundred
    tickets: radius and direction come from a low-discrepancy sequence, which covers the distribution evenly."""
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
