"""Small flight records of an invented fleet, by the recorder's own writer: input of the tests of the fleet.

Flights of several vehicles, maps, cameras and versions, over a year. The map fails over a lake of each place, and more
often in winter."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from origins import origin_of
from terrafix import messages as m
from terrafix.core.config import Config, Map, SourceSection
from terrafix.core.geodesy import LocalFrame, quat_from_rot, rot_w_b
from terrafix.recorder.provenance import RECORD_FORMAT
from terrafix.recorder.writer import FlightWriter
from terrafix_lab.sim.true_messages import estimate as true_estimate

NS = 1_000_000_000
FIRST_DAY_NS = 1_767_261_600 * NS  # 2026-01-01 10:00 UTC
DAY_NS = 86_400 * NS
PERIOD_NS = NS // 2  # between frames
SPEED_MPS = 15.0
LAKE_M, LAKE_RADIUS_M = (250.0, 150.0), 120.0  # centre, from the start
PLACES = (("valley-2025", 47.42, 11.05), ("coast-2024", 54.31, 10.14), ("plain-2023", 48.84, 16.56))
CAMERAS = (("wide", 640, 420.0), ("narrow", 1280, 1500.0))
VERSIONS = ("1.0.0", "1.1.0", "1.2.0")


@dataclass(frozen=True)
class Invented:
    """What distinguishes the ``number``-th flight of a fleet."""

    number: int
    frames: int

    @property
    def day(self) -> int:
        return self.number * 7 % 365

    @property
    def origin(self) -> m.Origin:
        _, lat_deg, lon_deg = PLACES[self.number % len(PLACES)]
        _, width, fx = CAMERAS[self.number // 3 % len(CAMERAS)]
        camera = m.Camera(width=width, height=width * 3 // 4, fx=fx, fy=fx, cx=width / 2, cy=width * 3 / 8)
        at_place = origin_of(camera, lat_deg=lat_deg, lon_deg=lon_deg)
        return msgspec.structs.replace(at_place, t_ns=1_000_000 * (self.number + 1))

    @property
    def header(self) -> dict[str, str]:
        place, camera = PLACES[self.number % len(PLACES)][0], CAMERAS[self.number // 3 % len(CAMERAS)][0]
        version = VERSIONS[min(len(VERSIONS) - 1, self.day * len(VERSIONS) // 365)]
        config = Config(
            map=Map(path=f"maps/{place}.gpkg"), source=SourceSection(camera=f"config/cameras/{camera}.toml")
        )
        versions = {"terrafix": version, "git": f"v{version}", "python": "3.11"}
        encode = msgspec.json.encode
        return {"format": RECORD_FORMAT, "config": encode(config).decode(), "versions": encode(versions).decode()}

    @property
    def summary(self) -> dict[str, Any]:
        place = PLACES[self.number % len(PLACES)][0]
        return {"map": {"path": f"maps/{place}.gpkg", "source": f"{place}.tif", "checksum": f"sum of {place}",
                        "gsd_m": 0.3, "date": f"{place[-4:]}-07-01", "has_dem": True}}  # fmt: skip

    def messages(self) -> list[tuple[m.Message, int]]:
        """-> (message, time of reception)"""
        rng = np.random.default_rng(self.number)
        origin = self.origin
        frame = LocalFrame(origin.lat_deg, origin.lon_deg)
        agl_m = float(rng.choice([60.0, 90.0, 120.0, 180.0]))
        heading = float(rng.uniform(0.0, math.pi / 2))
        unix_ns = FIRST_DAY_NS + self.day * DAY_NS - origin.t_ns
        link = m.LinkStatus(t_ns=origin.t_ns, connected=True, autopilot="ardupilot", sysid=1 + self.number % 4,
                            sent=1, received=1, bad=0, time_offset_ms=0.0)  # fmt: skip
        clock = m.WallClock(t_ns=origin.t_ns, unix_ns=unix_ns + origin.t_ns, source="autopilot")
        made: list[tuple[m.Message, int]] = [(origin, origin.t_ns), (link, origin.t_ns), (clock, origin.t_ns)]
        last_fix = 0
        for i in range(self.frames):
            t_ns = origin.t_ns + (i + 1) * PERIOD_NS
            along_m = SPEED_MPS * i * PERIOD_NS / NS
            e_m, n_m = along_m * math.cos(heading), along_m * math.sin(heading)
            over_lake = math.hypot(e_m - LAKE_M[0], n_m - LAKE_M[1]) < LAKE_RADIUS_M
            failing = 0.85 if over_lake else 0.25 if self.day < 60 or self.day > 334 else 0.06
            verdict = m.Verdict.ACCEPTED
            if rng.random() < failing:
                verdict = m.Verdict.FEW_INLIERS if over_lake else m.Verdict.AMBIGUOUS
            else:
                last_fix = i
            image = m.Frame(t_ns=t_ns, frame_id=i, file="", width=origin.camera.width, height=origin.camera.height)
            matched = m.MeasurementVerdict(t_ns=t_ns, frame_id=i, measurement="map", verdict=verdict)
            lat_deg, lon_deg = frame.to_wgs84(e_m + float(rng.normal(0, 1)), n_m + float(rng.normal(0, 1)))
            late_ns = t_ns + int(rng.integers(60, 200)) * 1_000_000
            made += [(image, t_ns + 5_000_000), (matched, late_ns)]
            if i:
                age_s = (i - last_fix) * PERIOD_NS / NS
                estimate = _estimate(i, t_ns, lat_deg, lon_deg, agl_m, heading, age_s)
                made.append((estimate, late_ns))
        return made


def _estimate(
    i: int, t_ns: int, lat_deg: float, lon_deg: float, agl_m: float, heading: float, age_s: float
) -> m.NavEstimate:
    return true_estimate(
        t_ns,
        lat_deg,
        lon_deg,
        sigmas=(2.0 + agl_m / 100 + 0.4 * age_s, 3.0, 0.1),
        frame_id=i,
        alt_amsl_m=500.0 + agl_m,
        agl_m=agl_m,
        velocity_enu_mps=(SPEED_MPS * math.cos(heading), SPEED_MPS * math.sin(heading), 0.0),
        q_w_b=quat_from_rot(rot_w_b(math.pi / 2 - heading, 0.0, 0.0)),
        source_label=m.SourceLabel.SATELLITE_ANCHORED if age_s < 1.5 else m.SourceLabel.VISUAL_PROPAGATED,
        last_anchor_age_ms=round(1000 * age_s),
    )


def write_records(folder: Path, count: int, frames: int) -> list[Path]:
    """Writes ``count`` records, each in a run folder of its own, and returns these folders; every fifth is that of a
    replay: with a summary, without clock and times of reception."""
    runs = []
    for number in range(count):
        flight = Invented(number, frames)
        replayed = number % 5 == 4
        run = folder / f"vehicle-{number % 4}" / f"run-{number:04d}"
        run.mkdir(parents=True)
        if replayed:
            (run / "summary.json").write_text(json.dumps(flight.summary), encoding="utf-8")
        writer = FlightWriter(run / ("flight.mcap" if replayed else "flight-000.mcap"), flight.header)
        for message, received_ns in flight.messages():
            if not replayed:
                writer.write(message, received_ns)
            elif not isinstance(message, m.WallClock):
                writer.write(message, message.t_ns)
        writer.close()
        runs.append(run)
    return runs
