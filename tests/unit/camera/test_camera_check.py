"""`terrafix camera check`: a record says by how much mount, heading and stamps differ from their description."""

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from flight_records import write_record
from simulated_flight import CAMERA, ORIGIN, EstimatorRun, Flight
from terrafix.core.camera import Mount
from terrafix.core.pose import log_so3
from terrafix.messages import CalibrationFault, Frame, Message
from terrafix_tools.camera.checking import camera_check
from terrafix_tools.camera_times import CameraTimes

FLIGHT = Flight(60, seed=7, fix_every=3)  # its camera leans by 3.8 degrees, which its description does not say


def numbers(line: str) -> list[float]:
    return [float(number) for number in re.findall(r"[-+]?[0-9.]+(?:e-?[0-9]+)?", line.split(":", 1)[1])]


def test_a_record_tells_the_tilt_of_the_mount_that_its_description_lacks(tmp_path: Path) -> None:
    run = EstimatorRun().fly(FLIGHT, 0, 60)
    frames = [Frame(t_ns=i * 500_000_000, frame_id=i, file="", width=960, height=540) for i in range(60)]
    write_record(tmp_path / "flight.mcap", [ORIGIN, *frames, *run.published])
    lines = list(camera_check(tmp_path / "flight.mcap"))
    tilt = np.degrees(log_so3(Mount.of(CAMERA).r_b_c().T @ FLIGHT.r_w_b[0].T @ FLIGHT.r_w_c[0]))
    assert np.hypot(*tilt[:2]) > 3.0
    for axis, true in zip("xy", tilt[:2], strict=True):
        line = next(line for line in lines if f"about the camera's {axis}" in line)
        learnt, sigma = numbers(line)[:2]
        assert learnt == pytest.approx(true, abs=0.5) and sigma < 1.6
        assert ("differs from the description" in line) is (abs(learnt) > 3.0 * sigma)
    assert any(line.startswith("time: 60 frames, 2 a second, jitter of the interval 0.0 ms") for line in lines)


def test_rate_jitter_latency_and_offset_of_the_stamps_are_shown() -> None:
    times, rng = CameraTimes(), np.random.default_rng(2)
    stamps_s = np.delete(np.arange(200) * 0.1 + rng.normal(0.0, 0.003, 200), 50)
    for i, t_s in enumerate(stamps_s.tolist()):
        frame = Frame(t_ns=round(t_s * 1e9), frame_id=i, file="", width=1, height=1, stamp_sigma_s=0.2)
        times.take(round((t_s + 0.08) * 1e9), frame)
    late: Message = CalibrationFault(
        t_ns=0, quantity="camera time", factor=0.15, detail="it is subtracted", active=False
    )
    times.take(0, late)
    rate, delays, offset = times.words()
    jitter_ms = float(re.findall(r"interval ([0-9.]+) ms", rate)[0])
    assert jitter_ms == pytest.approx(3.0 * 2**0.5, rel=0.3)
    assert rate.startswith("199 frames, 10 a second") and "1 longer intervals, the longest 0.19 s" in rate
    assert delays.startswith("from the stamp to the image 80 ms (median), 80 ms (95 %)")
    assert "200 ms (1-sigma); estimated to be +150 ms late" in offset


def test_too_few_frames_tell_nothing() -> None:
    times = CameraTimes()
    times.take(0, msgspec.structs.replace(Frame(t_ns=0, frame_id=0, file="", width=1, height=1)))
    assert times.words() == []
