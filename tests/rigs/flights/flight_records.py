"""Record and truth of a short synthetic flight, for the tests of recorder, evaluation and report."""

import math
from pathlib import Path

import numpy as np

from origins import origin_of
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.geodesy import LocalFrame, quat_from_rot, rot_w_b
from terrafix.recorder.images import thumbnail_jpeg
from terrafix.recorder.provenance import header
from terrafix.recorder.writer import FlightWriter
from terrafix_lab.sim.true_messages import estimate as true_estimate

ORIGIN = LocalFrame(48.0, 11.0)
PERIOD_NS = 500_000_000
SIGMA_M = 4.0


def origin() -> m.Origin:
    return origin_of(m.Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0))


def frame(i: int, file: str = "") -> m.Frame:
    return m.Frame(t_ns=i * PERIOD_NS, frame_id=i, file=file or f"{i:04d}.jpg", width=64, height=48)


def estimate(i: int, e_m: float, n_m: float, *, sigma_m: float = SIGMA_M, age_ms: int = 0) -> m.NavEstimate:
    lat_deg, lon_deg = ORIGIN.to_wgs84(e_m, n_m)
    return true_estimate(
        i * PERIOD_NS,
        lat_deg,
        lon_deg,
        sigmas=(sigma_m, 3.0, 0.1),
        frame_id=i,
        alt_amsl_m=600.0,
        agl_m=100.0,
        velocity_enu_mps=(10.0, 0.0, 0.0),
        velocity_sigma_mps=1.0,
        q_w_b=quat_from_rot(rot_w_b(math.radians(90.0), 0.0, 0.0)),
        source_label=m.SourceLabel.SATELLITE_ANCHORED if age_ms == 0 else m.SourceLabel.VISUAL_PROPAGATED,
        last_anchor_age_ms=age_ms,
        emitted_at_ns=i * PERIOD_NS + 120_000_000,
    )


def gps_input(t_ns: int, fix_type: int = 3) -> m.GpsInput:
    return m.GpsInput(
        t_ns=t_ns,
        fix_type=fix_type,
        time_week=2400,
        time_week_ms=0,
        lat_deg=48.0,
        lon_deg=11.0,
        alt_amsl_m=600.0,
        hdop=1.0,
        vdop=1.0,
        vn_mps=0.0,
        ve_mps=0.0,
        vd_mps=0.0,
        speed_accuracy_mps=1.0,
        horiz_accuracy_m=5.0,
        vert_accuracy_m=5.0,
        satellites_visible=10,
        estimate_age_ms=100.0,
        no_fix_reason="" if fix_type == 3 else "no estimate yet",
    )


def live_messages(frames: int = 20) -> list[m.Message]:
    """A flight to the east at 10 m/s: the first frame has no position, every fifth map match is rejected, and the link
    is killed once."""
    messages: list[m.Message] = [origin()]
    for i in range(frames):
        t_ns = i * PERIOD_NS
        messages.append(frame(i))
        matched = m.Verdict.ACCEPTED if i % 5 else m.Verdict.AMBIGUOUS
        messages.append(m.MeasurementVerdict(t_ns=t_ns, frame_id=i, measurement="map", verdict=matched))
        if i:
            messages.append(estimate(i, 5.0 * i + 1.0, 2.0, age_ms=0 if i % 5 else 500))
        messages += [gps_input(t_ns + k * 100_000_000, 1 if i == 0 else 3) for k in range(5) if not (i == 10 and k)]
        band = m.ThermalBand.HOT if i > 15 else m.ThermalBand.NORMAL
        health = m.Health(t_ns=t_ns, band=band, temperature_c=60.0 + i, throttled=False, disk_free_mb=1, cause="")
        messages.append(health)
    messages.append(m.ProcessEvent(t_ns=10 * PERIOD_NS, process="link", event="died", detail="signal 9 <kill>"))
    messages.append(m.Dropped(t_ns=11 * PERIOD_NS, process="vision", message="Frame", count=3))
    return messages


def write_record(path: Path, messages: list[m.Message]) -> None:
    writer = FlightWriter(path, header(Config()))
    for message in messages:
        writer.write(message, message.t_ns)
        if isinstance(message, m.Frame):
            thumbnail = np.full((48, 64, 3), message.frame_id * 5 % 255, np.uint8)
            writer.write_thumbnail(message.t_ns, message.frame_id, thumbnail_jpeg(thumbnail, 32))
    writer.close()


def write_truth(path: Path, frames: int = 20) -> None:
    """Writes truth.csv of ``live_messages``."""
    lines = ["file,lat_deg,lon_deg,agl_m,yaw_deg"]
    for i in range(frames):
        lat_deg, lon_deg = ORIGIN.to_wgs84(5.0 * i, 0.0)
        lines.append(f"{i:04d}.jpg,{lat_deg:.9f},{lon_deg:.9f},100,90")
    path.write_text("\n".join(lines) + "\n")
