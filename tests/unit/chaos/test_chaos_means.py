"""Means of the fault matrix: a serial line, switches in the standard library, and a recorded flight as its scene."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from terrafix.core.errors import OutputError, SourceError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.chaos import rig
from terrafix_lab.chaos.camera import camera_toml
from terrafix_lab.chaos.memory_group import V1, V2, MemoryGroup
from terrafix_lab.chaos.recorded_scene import recorded_scene
from terrafix_lab.chaos.run import fly_cell, missing_here
from terrafix_lab.chaos.scene import ChaosScene
from terrafix_lab.chaos.serial_line import SerialLine
from terrafix_lab.chaos.switches import Switch, Switches
from terrafix_lab.chaos.verdict import sigmas
from terrafix_lab.faults.fault import Fault, Need, Phase
from terrafix_lab.faults.table import FAULTS
from terrafix_lab.sim.autopilot.report import ReceivedFix


def fault(name: str) -> Fault:
    return FAULTS[name]


@pytest.mark.real_time
def test_a_serial_line_carries_bytes_both_ways_and_at_another_baud_rate_as_many_wrong_ones() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(5.0)
        with SerialLine(autopilot.getsockname()[1]) as line:
            device = os.open(line.device, os.O_RDWR | os.O_NOCTTY)
            try:
                os.write(device, b"\xfd up \n\r\x03")
                data, sender = autopilot.recvfrom(100)
                assert data == b"\xfd up \n\r\x03", "the line is raw"
                autopilot.sendto(b"down", sender)
                assert select.select([device], [], [], 5.0)[0] and os.read(device, 100) == b"down"
                line.other_baud = True
                os.write(device, b"0123456789")
                garbled = autopilot.recv(100)
                assert len(garbled) == 10 and garbled != b"0123456789"
            finally:
                os.close(device)


PROGRAM = """
import json, os, sys, time
before = time.time_ns()
import onnxruntime
session = onnxruntime.InferenceSession.__new__(onnxruntime.InferenceSession)
try:
    session.run_with_iobinding(None)
except RuntimeError as error:
    failure = str(error)
except Exception as error:
    failure = type(error).__name__
began = time.monotonic()
with open(sys.argv[1], "wb") as file:
    os.fsync(file.fileno())
print(json.dumps({"unix_s": before / 1e9, "failure": failure, "fsync_s": time.monotonic() - began}))
"""


@pytest.mark.real_time
def test_switches_move_the_wall_clock_delay_an_fsync_and_let_models_fail_in_another_program(tmp_path: Path) -> None:
    switches = Switches(tmp_path / "switches")

    def seen() -> dict[str, float | str]:
        command = [sys.executable, "-c", PROGRAM, str(tmp_path / "file")]
        return json.loads(subprocess.check_output(command, env=switches.environment(), timeout=30.0))  # type: ignore[no-any-return]

    before = seen()
    assert before["failure"] != "the device is lost" and float(before["fsync_s"]) < 0.2
    for switch, value in ((Switch.WALL_CLOCK_S, -86_400.0), (Switch.FSYNC_S, 0.3), (Switch.NO_PROVIDER, 1.0)):
        switches.set(switch, value)
    during = seen()
    assert float(during["unix_s"]) - float(before["unix_s"]) == pytest.approx(-86_400.0, abs=60.0)
    assert during["failure"] == "the device is lost" and float(during["fsync_s"]) >= 0.3
    for switch in Switch:
        switches.set(switch, 0.0)
    assert not list((tmp_path / "switches").iterdir())


@pytest.mark.real_time
@pytest.mark.skipif(os.geteuid() != 0, reason="a control group of memory needs root")
def test_a_process_that_leaks_is_killed_by_the_kernel_at_the_limit_of_its_control_group(tmp_path: Path) -> None:
    switches = Switches(tmp_path / "switches")
    group = MemoryGroup()
    command = [sys.executable, "-c", "import time; time.sleep(20.0)"]
    with subprocess.Popen(command, env=switches.environment()) as leaking:
        try:
            group.limit(leaking.pid, 32 << 20)
            assert leaking.poll() is None, "it is killed for what it takes, not for what it had"
            switches.set(Switch.LEAK_PID, leaking.pid)
            assert leaking.wait(15.0) == -signal.SIGKILL
        except OutputError as error:
            pytest.skip(f"no control group of memory here: {error}")
        finally:
            leaking.kill()
            group.lift()
    assert not list((V1 if V1.is_dir() else V2).glob(f"terrafix-chaos-{os.getpid()}"))


@pytest.mark.parametrize(("name", "limit_file"), [("memory", "memory.limit_in_bytes"), ("cgroup", "memory.max")])
def test_the_control_group_of_memory_is_that_of_the_kernels_version(tmp_path: Path, name: str, limit_file: str) -> None:
    root = tmp_path / name
    root.mkdir()
    group = MemoryGroup(root)
    group.limit(123, 4096)
    (folder,) = root.iterdir()
    assert (folder / limit_file).read_text() == "4096" and (folder / "cgroup.procs").read_text() == "123"
    group.lift()
    assert (root / "cgroup.procs").read_text() == "123", "the process goes back to the root"
    with pytest.raises(OutputError, match="run as root"):
        MemoryGroup(tmp_path / "none" / "memory").limit(123, 4096)


def test_a_leak_names_its_process_and_ends_with_its_limit(tmp_path: Path) -> None:
    rig = StubRig(tmp_path / "switches")
    leak = fault("anchor: leak")
    assert leak.process is not None
    leak.process.begin(rig)  # type: ignore[arg-type]
    assert (tmp_path / "switches" / Switch.LEAK_PID).read_text() == "77"
    assert rig.memory_group.calls == [(77, 128 << 20)]
    leak.process.end(rig)  # type: ignore[arg-type]
    assert not list((tmp_path / "switches").iterdir()) and rig.memory_group.calls[1:] == ["lifted"]


def test_a_fault_that_cannot_be_caused_here_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert missing_here(fault("shared memory: full"), tmp_path) == "mounting needs root"
    assert missing_here(fault("disk: gone"), tmp_path) == "mounting needs root"
    assert missing_here(fault("model: provider lost"), tmp_path / "none.onnx") == "no weights of XFeat, see --model"
    assert missing_here(fault("link: other baud rate"), tmp_path) == ""
    empty = ChaosScene(tmp_path, [], lambda _t_s: None, {}, 0.0)  # type: ignore[arg-type,return-value]
    outcome = fly_cell(empty, fault("disk: full"), Phase.CRUISE, tmp_path / "cell", seed=1)
    assert outcome.verdict == "not measurable here: mounting needs root" and not (tmp_path / "cell").exists()


class StubRig:
    """The part of a rig that the switched faults use."""

    def __init__(self, folder: Path) -> None:
        self.switches = Switches(folder)
        self.memory_group = StubMemoryGroup()

    def pid(self, _process: str) -> int:
        return 77


class StubMemoryGroup:
    def __init__(self) -> None:
        self.calls: list[object] = []

    def limit(self, pid: int, limit_bytes: int) -> None:
        self.calls.append((pid, limit_bytes))

    def lift(self) -> None:
        self.calls.append("lifted")


def test_a_switched_fault_begins_and_ends(tmp_path: Path) -> None:
    jump = fault("wall clock: a year back")
    stub = StubRig(tmp_path)
    assert Need.SWITCHES in jump.needs
    assert jump.process is not None
    jump.process.begin(stub)
    assert float((tmp_path / Switch.WALL_CLOCK_S).read_text()) == -365 * 86_400.0
    jump.process.end(stub)
    assert not list(tmp_path.iterdir())


def test_the_temperature_of_the_zone_is_never_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(rig, "write_atomic", lambda file, data: written.append(f"{file.name} {data.decode().strip()}"))
    one = rig.Rig.__new__(rig.Rig)
    one.folder = tmp_path
    one.set_temperature(95_500)
    assert written == ["temp 95500"]


def test_an_error_is_judged_with_the_uncertainty_of_the_truth() -> None:
    fix = ReceivedFix(1.0, 20.0, 3.0)
    assert sigmas(fix) == pytest.approx(20.0 / 3.0)
    assert sigmas(fix, truth_sigma_m=4.0) == pytest.approx(4.0)


LAT, LON, PERIOD_S, COUNT = 48.0, 11.0, 0.5, 160


def flight_folder(folder: Path, *, hole: bool = False) -> Path:
    """Flies 10 m/s east for 40 s and then north, 80 m up; roll and pitch are not recorded."""
    (folder / "frames").mkdir(parents=True)
    data = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    frame = LocalFrame(LAT, LON)
    frames, truth = ["file,t_s,yaw_deg,pitch_deg,roll_deg,agl_m"], ["file,lat_deg,lon_deg,agl_m,yaw_deg"]
    for i in range(COUNT):
        t_s, name = i * PERIOD_S + (3.0 if hole and i > 80 else 0.0), f"{i:04}.jpg"
        (folder / "frames" / name).write_bytes(data)
        lat, lon = frame.to_wgs84(10.0 * min(t_s, 40.0), 10.0 * max(t_s - 40.0, 0.0))
        yaw_deg = 90.0 if t_s <= 40.0 else 0.0
        frames.append(f"{name},{t_s},{yaw_deg + 2.0},,,81.0")
        truth.append(f"{name},{lat!r},{lon!r},80.0,{yaw_deg}")
    (folder / "frames.csv").write_text("\n".join(frames) + "\n")
    (folder / "truth.csv").write_text("\n".join(truth) + "\n")
    (folder / "map.gpkg").write_bytes(b"")
    (folder / "flight.toml").write_text(
        'map = "map.gpkg"\n[camera]\nwidth = 64\nheight = 48\nfx = 50.0\nfy = 50.0\ncx = 32.0\ncy = 24.0\n'
        f"[start]\nlat_deg = {LAT}\nlon_deg = {LON}\nground_amsl_m = 400.0\n[truth]\nsigma_m = 7.0\n"
    )
    return folder


def test_a_recorded_flight_is_a_scene_with_its_course_camera_and_rate(tmp_path: Path) -> None:
    scene = recorded_scene(flight_folder(tmp_path / "flight"), None, tmp_path)
    state = scene.course(20.0)
    assert state.ve_mps == pytest.approx(10.0, abs=0.01) and state.vn_mps == pytest.approx(0.0, abs=0.01)
    assert state.agl_m == 80.0 and state.amsl_m == 480.0 and np.degrees(state.yaw_rad) == pytest.approx(90.0)
    assert scene.frame_hz == pytest.approx(2.0) and scene.truth_sigma_m == 7.0 and scene.camera.width == 64
    assert scene.map_path == tmp_path / "flight" / "map.gpkg"
    assert set(scene.at_s) == set(Phase) - {Phase.LANDING}
    assert scene.at_s[Phase.TURN] == pytest.approx(40.0, abs=0.6) and abs(scene.at_s[Phase.CRUISE] - 40.0) > 5.0
    assert "attitude_sigma_deg = 5.0" in camera_toml(scene.camera, scene.attitude_sigma_deg), "none was recorded"


def test_a_flight_without_an_even_rate_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="have no even rate"):
        recorded_scene(flight_folder(tmp_path / "flight", hole=True), None, tmp_path)


def test_a_fix_is_not_expected_where_the_fault_leaves_no_way_to_one() -> None:
    assert fault("map: file removed").no_fix_in == {Phase.START, Phase.LANDING}
    assert {one.name for one in FAULTS.values() if one.no_fix_in != {Phase.LANDING}} == {"map: file removed"}
