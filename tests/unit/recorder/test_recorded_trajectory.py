"""A smooth trajectory through recorded ground truth, and the simulated telemetry of an autopilot on it."""

import csv
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import EvaluationError, OutputError, SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.mavlink.tlog import read_tlog
from terrafix.vision.sources import open_source
from terrafix_lab.sim.flights.recorded import read_recorded, write_recorded
from terrafix_lab.sim.flights.smooth import smooth

DataSet = Callable[[str], Path]
PLACE = LocalFrame(47.0, 8.0)
G = 9.80665


def true_positions(t_s: np.ndarray) -> np.ndarray:
    """Positions (N, 2) [m] at times ``t_s`` (N,): a circle with a radius of 60 m at 8 m/s."""
    return 60.0 * np.column_stack([np.sin(t_s * 8.0 / 60.0), np.cos(t_s * 8.0 / 60.0)])


def test_smoothing_samples_of_a_parabola_reproduces_the_parabola() -> None:
    """The smoothest curve through samples of a parabola is the parabola, whose derivatives are known."""
    t_s = np.array([0.0, 1.0, 2.5, 3.0, 7.0, 8.0])
    curve = smooth(t_s, (3.0 - 2.0 * t_s + 0.5 * t_s**2)[:, None], 10.0).at(np.array([0.3, 2.0, 5.5, 8.0]))[:, :, 0]
    at = np.array([0.3, 2.0, 5.5, 8.0])
    assert curve[:, 0] == pytest.approx(3.0 - 2.0 * at + 0.5 * at**2, abs=1e-3)
    assert curve[:, 1] == pytest.approx(-2.0 + at, abs=1e-2)
    assert curve[:, 2] == pytest.approx(1.0, abs=0.05)


def test_rate_and_acceleration_are_the_derivatives_of_the_trajectory() -> None:
    rng = np.random.default_rng(1)
    t_s = np.cumsum(rng.uniform(0.3, 2.0, 60))
    curve = smooth(t_s, rng.normal(0.0, 5.0, (60, 2)).cumsum(axis=0), 4.0)
    fine = np.arange(t_s[0], t_s[-1], 0.005)
    value, rate, acceleration = curve.at(fine).transpose(1, 0, 2)
    assert np.abs(np.gradient(value, 0.005, axis=0) - rate)[1:-1].max() < 1e-2
    inside = np.abs(np.gradient(rate, 0.005, axis=0) - acceleration)[1:-1]
    assert np.quantile(inside, 0.99) < 0.05  # the third derivative may jump at a sample


def test_noise_of_the_ground_truth_does_not_become_acceleration() -> None:
    """Samples at 2 Hz with 2 m of noise: their second differences exceed 16 m/s^2."""
    t_s = np.arange(0.0, 60.0, 0.5)
    noisy = true_positions(t_s) + np.random.default_rng(2).normal(0.0, 2.0, (120, 2))
    assert np.abs(np.diff(noisy, 2, axis=0) / 0.25).max() > 16.0
    curve = smooth(t_s, noisy, 3.0).at(np.arange(0.0, 59.5, 0.02))
    assert np.linalg.norm(curve[:, 2], axis=1).max() < 3.05
    off = np.linalg.norm(curve[:, 0] - true_positions(np.arange(0.0, 59.5, 0.02)), axis=1)
    assert np.median(off) < 1.6  # nearer to the ground truth than the samples


def test_outside_the_samples_the_rate_is_constant() -> None:
    t_s = np.arange(0.0, 5.0)
    after = smooth(t_s, (2.0 * t_s)[:, None], 5.0).at(np.array([-1.0, 6.0]))[:, :, 0]
    assert after[:, 0] == pytest.approx([-2.0, 12.0], abs=1e-3)
    assert after[:, 2] == pytest.approx(0.0, abs=1e-6)


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A flight folder: a circle of 12 s without ground height, heading along the course."""
    folder = tmp_path / "flight"
    (folder / "frames").mkdir(parents=True)
    t_s = np.arange(0.0, 12.1, 0.5)
    times, truth = [["file", "t_s", "yaw_deg"]], [["file", "lat_deg", "lon_deg", "agl_m", "yaw_deg"]]
    for i, (t, (e_m, n_m)) in enumerate(zip(t_s, true_positions(t_s), strict=True)):
        cv2.imwrite(str(folder / "frames" / f"{i}.png"), np.full((48, 64, 3), 90, np.uint8))
        lat_deg, lon_deg = PLACE.to_wgs84(float(e_m), float(n_m))
        yaw_deg = math.degrees(math.pi / 2 + t * 8.0 / 60.0) % 360.0
        times.append([f"{i}.png", f"{t:.3f}", f"{yaw_deg:.1f}"])
        truth.append([f"{i}.png", f"{lat_deg:.8f}", f"{lon_deg:.8f}", f"{80.0 + 0.5 * t:.3f}", f"{yaw_deg:.3f}"])
    for name, rows in (("frames.csv", times), ("truth.csv", truth)):
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    (folder / "flight.toml").write_text(
        'map = "../map.tif"\n[camera]\nwidth = 64\nheight = 48\nfx = 50.0\nfy = 50.0\ncx = 32.0\ncy = 24.0\n'
        "[start]\nlat_deg = 47.0\nlon_deg = 8.0\n[truth]\nsigma_m = 1.5\n"
    )
    return folder


def packets(path: Path) -> list[tuple[float, object]]:
    """(time [s], message) of a tlog, read with the parser of pymavlink."""
    data, out = path.read_bytes(), []
    parser = mavlink.MAVLink(None)
    at, first = 0, None
    while at < len(data):
        t_us = int.from_bytes(data[at : at + 8], "big")
        length = 12 + data[at + 9]
        first = t_us if first is None else first
        out.append(((t_us - first) / 1e6, parser.decode(bytearray(data[at + 8 : at + 8 + length]))))
        at += 8 + length
    return out


def test_the_written_flight_folder_opens_and_has_all_telemetry_messages(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    trajectory = write_recorded(recorded, out, seed=3)
    assert trajectory.level.rms < 0.05
    assert (out / "truth.csv").read_bytes() == (recorded / "truth.csv").read_bytes()
    source = open_source(str(out))
    shots = list(source.shots())
    source.close()
    assert len(shots) == 25 and not any(shot.frame.error for shot in shots)
    assert source.map_hint() == (tmp_path / "map.tif").resolve()
    assert source.origin().camera.fx == 50.0
    telemetry = packets(out / "telemetry.tlog")
    kinds = [message.get_type() for _, message in telemetry]  # type: ignore[attr-defined]
    for kind, least in (("ATTITUDE", 590), ("RAW_IMU", 590), ("GLOBAL_POSITION_INT", 115), ("HEARTBEAT", 12)):
        assert kinds.count(kind) >= least, kind
    assert {"SCALED_PRESSURE", "GPS_RAW_INT", "SYSTEM_TIME"} <= set(kinds)


def test_the_simulated_imu_is_that_of_a_circle(recorded: Path, tmp_path: Path) -> None:
    """A right turn with 8 m/s and 60 m radius: 1.07 m/s^2 to the right, 0.133 rad/s of yaw, and gravity."""
    write_recorded(recorded, tmp_path / "out", seed=3)
    imu = [m for t, m in packets(tmp_path / "out" / "telemetry.tlog") if m.get_type() == "RAW_IMU" and 2 < t < 10]  # type: ignore[attr-defined]
    mean = np.array([[m.xacc, m.yacc, m.zacc, m.xgyro, m.ygyro, m.zgyro] for m in imu]).mean(axis=0)  # type: ignore[attr-defined]
    assert mean[:3] * G / 1e3 == pytest.approx([0.0, 64.0 / 60.0, -G], abs=0.2)
    assert mean[3:] / 1e3 == pytest.approx([0.0, 0.0, 8.0 / 60.0], abs=0.012)


def test_the_simulated_attitude_and_height_follow_the_ground_truth(recorded: Path, tmp_path: Path) -> None:
    write_recorded(recorded, tmp_path / "out", seed=3)
    states = read_tlog(tmp_path / "out" / "telemetry.tlog")
    heights = [(s.t_ns / 1e9, s.agl_m) for s in states if s.agl_m is not None]
    assert max(abs(agl_m - 80.0 - 0.5 * t) for t, agl_m in heights) < 6.0
    turns = [math.remainder(s.yaw_rad - math.pi / 2 - s.t_ns / 1e9 * 8 / 60, math.tau) for s in states if s.yaw_rad]
    assert np.degrees(np.abs(turns)).max() < 12.0
    assert np.degrees(np.std(turns)) < 3.0


def test_the_same_seed_writes_the_same_telemetry_log(recorded: Path, tmp_path: Path) -> None:
    logs = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        write_recorded(recorded, tmp_path / name, seed=seed)
        logs.append((tmp_path / name / "telemetry.tlog").read_bytes())
    assert logs[0] == logs[1] != logs[2]


def test_unusable_flights_and_outputs_are_rejected_with_one_line(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="choose another --out"):
        write_recorded(recorded, recorded, seed=1)
    lines = (recorded / "truth.csv").read_text().splitlines()
    (recorded / "truth.csv").write_text("\n".join(lines[:4]) + "\n")
    with pytest.raises(SourceError, match="3 rows are complete"):
        write_recorded(recorded, tmp_path / "out", seed=1)
    (recorded / "truth.csv").write_text("file,lat_deg,lon_deg\n0.png,47,8\n")
    with pytest.raises(EvaluationError, match="agl_m, yaw_deg missing"):
        write_recorded(recorded, tmp_path / "out", seed=1)
    (recorded / "truth.csv").unlink()
    with pytest.raises(EvaluationError, match="give a flight that has one"):
        write_recorded(recorded, tmp_path / "out", seed=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "off_m"), [("village-1", 3.0), ("town-a", 1.0)])
def test_trajectories_of_real_flights_are_near_their_ground_truth(name: str, off_m: float, data_set: DataSet) -> None:
    trajectory, _ = read_recorded(data_set(f"flights/{name}"))
    assert trajectory.level.rms < off_m
    path = trajectory.path(float(trajectory.level.t_s[-1]))
    acceleration = np.gradient(path[:, 3:5], 0.02, axis=0)
    assert np.linalg.norm(acceleration, axis=1).max() < 6.5
