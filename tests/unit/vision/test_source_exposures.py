"""Frames at the exposures that the autopilot reports: in a log beside the flight, and live."""

import queue
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from autopilot_logs import (
    FORMATS,
    Row,
    attitude_messages,
    attitude_rows,
    attitude_topic,
    write_dataflash,
    write_tlog,
    write_ulog,
)
from autopilot_logs import flight as attitudes
from source_folders import flight as write_folder
from source_folders import source_of
from terrafix.core.frames import MemoryFrameStore
from terrafix.link.autopilot.packet_decoder import PacketDecoder
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.messages import STAMP_SIGMA_S, Exposure, Frame
from terrafix.vision.edge import SourceEdge
from terrafix.vision.sources import Shot
from terrafix.vision.sources.exposed import ReportedExposures
from terrafix.vision.sources.facts import facts_of
from terrafix.vision.sources.flight_folder import FlightFolder

LOG = attitudes(7, duration_s=40.0)
RNG = np.random.default_rng(5)
EXPOSED_S = LOG.t_s[0] + 6.0 + np.cumsum(RNG.uniform(0.4, 0.9, 20))  # on the log's clock
CAM = {"CAM": ("QBHIHLLeee", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt")}


def folder(path: Path, stamps_s: np.ndarray) -> Path:
    rows = [f"{i:04}.jpg,{t_s:.3f}" for i, t_s in enumerate(stamps_s)]
    return write_folder(path, frames=len(rows), csv="\n".join(["file,t_s", *rows]) + "\n")


def dataflash(path: Path) -> None:
    rows: list[Row] = attitude_rows(LOG)
    rows += [("CAM", {"TimeUS": round(t * 1e6), "I": 0, "Img": i}) for i, t in enumerate(EXPOSED_S)]
    write_dataflash(path / "telemetry.bin", sorted(rows, key=lambda row: float(row[1]["TimeUS"])), FORMATS | CAM)


def ulog(path: Path) -> None:
    rows = [(float(t), i) for i, t in enumerate(EXPOSED_S)]
    write_ulog(path / "telemetry.ulg", [attitude_topic(LOG), ("camera_capture", 0, "uint32_t seq;", rows)])


@pytest.mark.parametrize("write", [dataflash, ulog])
def test_rows_of_exposures_align_an_own_log_and_time_its_frames(write, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    shown_s, zero_s = np.delete(EXPOSED_S, [3, 9]), EXPOSED_S[0] - 1.0  # two images are lost
    flight = folder(tmp_path / "flight", shown_s - zero_s + RNG.normal(0.0, 0.02, len(shown_s)))
    write(flight)
    source = FlightFolder(flight)
    times_s = np.array([shot.frame.t_ns for shot in source.shots()]) * 1e-9
    assert times_s == pytest.approx(shown_s - zero_s, abs=0.02)
    assert np.diff(times_s) == pytest.approx(np.diff(shown_s), abs=1e-5)  # without the jitter of the stamps
    facts = [fact.text for fact in facts_of(source)]
    assert any("of 18 of 18 frames" in text for text in facts)
    assert any("zero is by the rows" in text for text in facts)


def test_camera_feedback_in_a_telemetry_log_times_the_frames(tmp_path: Path) -> None:
    boot_s, zero_s = LOG.t_s[0], LOG.t_s[0]
    feedback = [
        (t + delay, mavlink.MAVLink_camera_feedback_message(round((t - boot_s) * 1e6), 1, 0, i, *(0,) * 9, 0))
        for i, (t, delay) in enumerate(zip(EXPOSED_S, RNG.uniform(0.01, 0.3, 20), strict=True))
    ]
    flight = folder(tmp_path / "flight", EXPOSED_S - zero_s + 0.15)
    write_tlog(flight / "telemetry.tlog", sorted([*attitude_messages(LOG, boot_s), *feedback], key=lambda one: one[0]))
    source = FlightFolder(flight)
    times_s = np.array([shot.frame.t_ns for shot in source.shots()]) * 1e-9
    assert times_s == pytest.approx(EXPOSED_S - zero_s, abs=0.05)
    assert any(fact.topic == "exposure" and "ms before their stamps" in fact.text for fact in facts_of(source))


def test_rows_of_another_camera_are_refused_with_a_line(tmp_path: Path) -> None:
    stamps_s = np.arange(20) * 0.5
    flight = folder(tmp_path / "flight", stamps_s)
    dataflash(flight)
    source = FlightFolder(flight)
    assert [shot.frame.t_ns for shot in source.shots()] == [round(t * 1e9) for t in stamps_s]
    assert any(fact.text.startswith("CAM of telemetry.bin is not used: no latency") for fact in facts_of(source))


def stamped(t_s: float, i: int, sigma_s: float = 0.2) -> Frame:
    t_ns = round(t_s * 1e9)
    return Frame(t_ns=t_ns, frame_id=i, file="", width=1, height=1, buffered=True, stamp_sigma_s=sigma_s)


def test_a_live_camera_gets_the_times_of_reports_that_come_before_or_after_its_images() -> None:
    exposed, times_s = ReportedExposures(), []
    for i, t_s in enumerate(EXPOSED_S.tolist()):
        if i % 4:  # each fourth report is late by more than the image
            exposed.add(Exposure(t_ns=round(t_s * 1e9), kind="CAMERA_FEEDBACK", number=i))
        got = exposed.exposed(stamped(t_s + 0.25 + float(RNG.normal(0.0, 0.01)), i))
        times_s.append(got.t_ns * 1e-9)
        if not i % 4:
            exposed.add(Exposure(t_ns=round(t_s * 1e9), kind="CAMERA_FEEDBACK", number=i))
    assert (got.buffered, got.stamp_sigma_s) == (False, STAMP_SIGMA_S)
    assert times_s[:3] == pytest.approx(EXPOSED_S[:3] + 0.25, abs=0.05)
    assert times_s[10:] == pytest.approx(EXPOSED_S[10:], abs=0.03)
    reported = [k for k in range(10, 20) if k % 4]
    assert np.array(times_s)[reported] == pytest.approx(EXPOSED_S[reported], abs=1e-6)


def test_reports_of_the_autopilot_are_on_the_clock_of_its_telemetry() -> None:
    decoder, now_ns = PacketDecoder(TimeSync()), 9_000_000_000
    message = mavlink.MAVLink_camera_trigger_message(5_000_000, 7)
    exposure = Exposure(t_ns=now_ns, kind="CAMERA_TRIGGER", number=7)
    assert list(decoder.on_message(message, now_ns, None)) == [exposure]
    failed = mavlink.MAVLink_camera_image_captured_message(5000, 0, 0, 0, 0, 0, 0, [1.0, 0, 0, 0], 3, 0, b"")
    assert not list(decoder.on_message(failed, now_ns, None))


def test_a_latency_longer_than_a_frame_does_not_turn_the_order_of_frames() -> None:
    exposed, times_s = ReportedExposures(), []
    for i, t_s in enumerate(EXPOSED_S.tolist()):
        exposed.add(Exposure(t_ns=round(t_s * 1e9), kind="CAMERA_TRIGGER", number=i))
        times_s.append(exposed.exposed(stamped(t_s + 1.2, i, 0.5)).t_ns * 1e-9)
    assert np.diff(times_s).min() > 0.3


def test_the_edge_of_vision_publishes_frames_at_the_exposures_that_it_hears_of() -> None:
    fed, got = queue.Queue[Frame | None](), list[int]()
    camera = source_of(lambda: (Shot(frame, (), None) for frame in iter(fed.get, None)))
    camera.close.side_effect = lambda: fed.put(None)
    edge = SourceEdge(camera, MemoryFrameStore(), None, False)
    try:
        for i, t_s in enumerate(EXPOSED_S[:8].tolist()):
            edge.on_message(Exposure(t_ns=round(t_s * 1e9), kind="CAMERA_FEEDBACK", number=i))
            fed.put(stamped(t_s + 0.1, i))
            until_s = time.monotonic() + 10.0
            while len(got) <= i and time.monotonic() < until_s:
                got += [message.t_ns for message in edge.poll(0) if isinstance(message, Frame)]
    finally:
        edge.close()
    assert got[-1] == round(EXPOSED_S[7] * 1e9)
