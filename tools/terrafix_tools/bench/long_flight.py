"""Messages of a synthetic live flight of any length, at the rates of a flight, for the benchmark of the report.

A camera that looks down flies a Lissajous figure over flat ground; errors are drawn from the distributions that the
messages state. Five things go wrong in each hour: the map fix is lost for a minute, a map match is rejected, the link
process dies, a calibration fault appears, and a GNSS receiver is spoofed."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafix import messages as m
from terrafix.core.camera import Mount
from terrafix.core.geodesy import LocalFrame, quat_from_rot, rot_w_b

NS = 1_000_000_000
HEIGHT_M, GROUND_AMSL_M = 100.0, 500.0
EXTENT_M = (900.0, 600.0)  # half widths of the figure, east and north
LAP_S = (471.0, 283.0)  # periods east and north; with EXTENT_M about 15 m/s
LOST_S = (1200.0, 1260.0)  # without map fix
REJECTED_S, DIED_S, FAULT_S, SPOOFED_S = 2400.0, 1800.0, (2700.0, 2760.0), (2000.0, 2200.0)
HOT_S = 2500.0
CAMERA = m.Camera(width=960, height=540, fx=560.0, fy=560.0, cx=479.5, cy=269.5, mount_tolerance_deg=2.0)
ORIGIN = LocalFrame(48.0, 11.0)
PAIRS, SIGMA_M, START_NS = 48, 2.0, 100 * NS
DELAYS_MS = {"odometry": 60.0, "prediction": 66.0, "match": 190.0, "estimate": 200.0}  # since the exposure


@dataclass(frozen=True)
class Rates:
    """Hz."""

    frames: float = 10.0
    matches: float = 2.0
    gps: float = 10.0
    attitudes: float = 20.0
    points_per_match: int = 200


def messages(duration_s: float, rates: Rates, rng: np.random.Generator) -> Iterator[tuple[int, m.Message]]:
    """Yields (reception time [ns], message)."""
    yield START_NS, _origin()
    for process in ("link", "vision", "anchor", "estimator"):
        yield START_NS, m.ProcessEvent(t_ns=START_NS, process=process, event="started")
    match_every = max(1, round(rates.frames / rates.matches))
    for i in range(round(duration_s * rates.frames)):
        t_s = i / rates.frames
        yield from _frame(i, t_s, i % match_every == 0, rates.points_per_match, rng)
        yield from _vehicle(t_s, rates, rng)
        if i % max(1, round(rates.frames)) == 0:
            yield from _each_second(t_s, rng)
    end_ns = START_NS + round(duration_s * NS)
    yield end_ns, m.SourceEnded(t_ns=end_ns, frames=round(duration_s * rates.frames))


def _frame(i: int, t_s: float, matched: bool, points: int, rng: np.random.Generator) -> Iterator[tuple[int, m.Message]]:
    t_ns = START_NS + round(t_s * NS)
    truth_m, yaw_rad = np.array([*position_m(t_s), GROUND_AMSL_M + HEIGHT_M]), _yaw_rad(t_s)
    r_w_b = rot_w_b(yaw_rad, 0.0, 0.0)
    r_w_c = r_w_b @ Mount.of(CAMERA).r_b_c()
    lost_s = t_s - LOST_S[0] if LOST_S[0] <= t_s < LOST_S[1] else 0.0
    sigma_m = SIGMA_M + 0.5 * lost_s
    pose = m.MapPose(
        p_c_in_w_m=_vector(truth_m + rng.normal(0.0, sigma_m, 3)),
        q_w_c=quat_from_rot(r_w_c),
        cov=_cov(sigma_m),
    )

    def at(stage: str) -> int:
        return t_ns + round(DELAYS_MS[stage] * float(rng.lognormal(0.0, 0.2)) * 1e6)

    yield t_ns + 10_000_000, m.Frame(t_ns=t_ns, frame_id=i, file=f"{i:06d}.jpg", width=960, height=540)
    yield at("odometry"), _odometry(i, t_ns, rng)
    yield at("odometry"), _verdict(t_ns, i, "odometry", float(rng.chisquare(3)), 16.27, rng.normal(size=3))
    yield (
        at("prediction"),
        m.Prediction(
            t_ns=t_ns,
            frame_id=i,
            p_c_in_w_m=pose.p_c_in_w_m,
            q_w_c=pose.q_w_c,
            cov=pose.cov,
            agl_m=HEIGHT_M,
            agl_sigma_m=2.0,
            step_m=(1.0, 0.0),
            step_cov_m2=(0.1, 0.0, 0.0, 0.1),
        ),
    )
    if matched:
        outlier = abs(t_s - REJECTED_S) < 1.0
        verdict = m.Verdict.FEW_INLIERS if lost_s else m.Verdict.ACCEPTED
        solved = m.MapPose(p_c_in_w_m=_vector(truth_m), q_w_c=pose.q_w_c, cov=pose.cov)
        yield at("match"), _match(i, t_ns, verdict, points, truth_m, r_w_c, rng)
        yield (
            at("match"),
            m.PoseSolution(
                t_ns=t_ns,
                frame_id=i,
                verdict=verdict,
                method=m.PoseMethod.IPPE,
                inliers=points - points // 5,
                residual_px=1.4,
                covariance_mode=m.CovarianceMode.MARGINALS,
                pose=None if lost_s else solved,
            ),
        )
        yield (
            at("match"),
            _verdict(t_ns, i, "map", 90.0 if outlier else float(rng.chisquare(6)), 22.46, rng.normal(size=6)),
        )
    lat_deg, lon_deg = ORIGIN.to_wgs84(*pose.p_c_in_w_m[:2])
    estimate = m.NavEstimate(
        t_ns=t_ns,
        frame_id=i,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=pose.p_c_in_w_m[2],
        agl_m=HEIGHT_M,
        velocity_enu_mps=(12.0, 0.0, 0.0),
        velocity_sigma_mps=0.5,
        q_w_b=quat_from_rot(r_w_b),
        cov=pose.cov,
        source_label=m.SourceLabel.VISUAL_PROPAGATED if lost_s > 1.5 else m.SourceLabel.SATELLITE_ANCHORED,
        covariance_mode=m.CovarianceMode.JACOBIAN if t_s > HOT_S else m.CovarianceMode.MARGINALS,
        last_anchor_age_ms=round(1000 * lost_s),
        emitted_at_ns=t_ns + 200_000_000,
    )
    yield at("estimate"), estimate


def _vehicle(t_s: float, rates: Rates, rng: np.random.Generator) -> Iterator[tuple[int, m.Message]]:
    """What autopilot and link exchange in the period of a frame."""
    period_s = 1.0 / rates.frames
    for k in range(round(period_s * rates.attitudes)):
        t_ns = START_NS + round((t_s + k / rates.attitudes) * NS)
        yield t_ns, m.VehicleState(t_ns=t_ns, source="mavlink", yaw_rad=_yaw_rad(t_s), pitch_rad=0.0, roll_rad=0.0)
        samples = [(j * 10_000_000, 0.0, 0.0, -9.81, 0.0, 0.0, 0.01) for j in range(5)]
        yield t_ns, m.Imu(t_ns=t_ns, source="mavlink", samples=samples)
    lost = LOST_S[0] + 35.0 < t_s < LOST_S[1]
    for k in range(round(period_s * rates.gps)):
        at_s = t_s + k / rates.gps
        if DIED_S < at_s < DIED_S + 1.5:
            continue
        t_ns = START_NS + round(at_s * NS)
        yield t_ns + round(float(rng.uniform(0.0, 5e6))), _gps_input(at_s, t_ns, lost)


def _gps_input(t_s: float, t_ns: int, lost: bool) -> m.GpsInput:
    lat_deg, lon_deg = ORIGIN.to_wgs84(*position_m(t_s))
    return m.GpsInput(
        t_ns=t_ns,
        fix_type=1 if lost else 3,
        time_week=2400,
        time_week_ms=round(t_s * 1000),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=GROUND_AMSL_M + HEIGHT_M,
        hdop=1.0,
        vdop=1.0,
        vn_mps=0.0,
        ve_mps=12.0,
        vd_mps=0.0,
        speed_accuracy_mps=0.5,
        horiz_accuracy_m=100.0 if lost else SIGMA_M * 1.4,
        vert_accuracy_m=4.0,
        satellites_visible=10,
        estimate_age_ms=300.0,
        no_fix_reason="35 s without a map fix" if lost else "",
    )


def _each_second(t_s: float, rng: np.random.Generator) -> Iterator[tuple[int, m.Message]]:
    t_ns = START_NS + round(t_s * NS)
    heat_c = 55.0 + 30.0 * t_s / 3600.0 + float(rng.normal(0.0, 0.5))
    band = m.ThermalBand.HOT if t_s > HOT_S else m.ThermalBand.NORMAL
    zones = [m.TemperatureZone(name=name, temperature_c=heat_c - 3 * k) for k, name in enumerate(("cpu", "gpu", "soc"))]
    clocks = [m.ProcessorClock(name="policy0", mhz=1500.0, limit_mhz=1510.0, max_mhz=1510.0)]
    rails = [m.PowerRail(name="VDD_IN", power_w=9.0)]
    state = m.Health(
        t_ns=t_ns, band=band, temperature_c=heat_c, throttled=False, disk_free_mb=9000, cause="cpu", power_w=9.0
    )
    spoofed = SPOOFED_S[0] <= t_s < SPOOFED_S[1]
    lat_deg, lon_deg = ORIGIN.to_wgs84(*(np.array(position_m(t_s)) + (80.0 if spoofed else 1.0)))
    found: list[m.Message] = [
        m.ThermalReading(t_ns=t_ns, zones=zones, throttling=[], disk_free_mb=9000, clocks=clocks, rails=rails),
        state,
        m.EkfStatus(t_ns=t_ns, flags=831, position_ratio=float(rng.gamma(2.0, 0.05)), velocity_ratio=0.03),
        m.LinkStatus(
            t_ns=t_ns, connected=True, autopilot="ardupilot", sysid=1, sent=1, received=1, bad=0, time_offset_ms=0.0
        ),
        m.GnssReading(
            t_ns=t_ns, receiver=0, fix_type=3, lat_deg=lat_deg, lon_deg=lon_deg, horizontal_m=1.5, speed_mps=12.0,
            satellites=14,
        ),
        m.GnssVerdict(
            t_ns=t_ns, receiver=0, state=m.GnssState.SPOOFED if spoofed else m.GnssState.TRUSTED,
            distance_m=113.0 if spoofed else 1.4, sigmas=30.0 if spoofed else 0.6, reason="far away" if spoofed else "",
        ),
    ]  # fmt: skip
    for active, at_s in ((True, FAULT_S[0]), (False, FAULT_S[1])):
        if t_s == at_s:
            found.append(m.CalibrationFault(t_ns=t_ns, quantity="scale", factor=1.2, detail="stated", active=active))
    if t_s == DIED_S:
        found.append(m.ProcessEvent(t_ns=t_ns, process="link", event="died", detail="signal 9"))
    for message in found:
        yield t_ns + 1_000_000, message


def _match(
    i: int, t_ns: int, verdict: m.Verdict, points: int, p_m: np.ndarray, r_w_c: np.ndarray, rng: np.random.Generator
) -> m.MapMatch:
    """Every fifth point is an outlier of 10 % of the height."""
    xy = np.column_stack([rng.uniform(-0.8, 0.8, points), rng.uniform(-0.45, 0.45, points)])
    ground = p_m + HEIGHT_M * np.column_stack([xy, np.ones(points)]) @ r_w_c.T
    ground[:, 2] = GROUND_AMSL_M
    seen = xy + rng.normal(0.0, 0.003, (points, 2)) + 0.1 * (np.arange(points) % 5 == 0)[:, None]
    given = m.PnpInput(
        q_w_c=quat_from_rot(r_w_c), agl_m=HEIGHT_M, sigma_floor=0.003, threshold=0.03, search_radius=0.08, min_inliers=8
    )
    rows = np.column_stack([seen, ground, np.full(points, 0.1)]).tolist()
    return m.MapMatch(
        t_ns=t_ns, frame_id=i, verdict=verdict, matcher="gradient", inliers=points - points // 5, reprojection_px=1.4,
        matches=[(a, b, c, d, e, f) for a, b, c, d, e, f in rows], map_sigma_m=1.0, pnp=given,
    )  # fmt: skip


def _odometry(i: int, t_ns: int, rng: np.random.Generator) -> m.Odometry:
    pairs = rng.uniform(-0.7, 0.7, (PAIRS, 4)).tolist()
    return m.Odometry(
        t_ns=t_ns, frame_id=i, keyframe_id=max(0, i - 3), verdict=m.Verdict.ACCEPTED,
        two_view=[(a, b, c, d) for a, b, c, d in pairs], sigma_norm=0.002, inliers=PAIRS, tracked=PAIRS,
    )  # fmt: skip


def _verdict(
    t_ns: int, i: int, measurement: str, mahalanobis2: float, gate: float, normalised: np.ndarray
) -> m.MeasurementVerdict:
    ratio = mahalanobis2 / gate
    return m.MeasurementVerdict(
        t_ns=t_ns, frame_id=i, measurement=measurement,
        verdict=m.Verdict.INNOVATION if ratio > 1.0 else m.Verdict.ACCEPTED, mahalanobis2=mahalanobis2,
        innovation=tuple((2.0 * normalised).tolist()), innovation_variance=(4.0,) * len(normalised), test_ratio=ratio,
    )  # fmt: skip


def _origin() -> m.Origin:
    return m.Origin(
        t_ns=START_NS, camera=CAMERA, lat_deg=ORIGIN.lat_deg, lon_deg=ORIGIN.lon_deg, ground_amsl_m=GROUND_AMSL_M,
        start_sigma_m=10.0, yaw_sigma_deg=2.0, agl_sigma_m=2.0, attitude_sigma_deg=1.0,
    )  # fmt: skip


def position_m(t_s: float) -> tuple[float, float]:
    """East and north."""
    return (
        EXTENT_M[0] * math.sin(math.tau * t_s / LAP_S[0]),
        EXTENT_M[1] * math.sin(math.tau * t_s / LAP_S[1]),
    )


def _yaw_rad(t_s: float) -> float:
    (e0, n0), (e1, n1) = position_m(t_s), position_m(t_s + 0.1)
    return math.atan2(e1 - e0, n1 - n0)


def _vector(values: np.ndarray) -> m.Vec3:
    a, b, c = values.tolist()
    return (a, b, c)


def _cov(sigma_m: float) -> m.Mat6:
    return tuple(float(v) for v in np.diag([sigma_m**2] * 3 + [1e-4] * 3).ravel())
