"""The stages of a flight with a firmware, a ground station and an observer that do what the test says."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rich.console import Console

pytest.importorskip("mavsdk", reason="mavsdk is not installed (pip install 'terrafix[sim]')")

from terrafix.core.errors import LinkError
from terrafix_tools.sim.sitl import stages as sitl_stages
from terrafix_tools.sim.sitl.firmware import Home
from terrafix_tools.sim.sitl.observer import Notes, Said, Truth
from terrafix_tools.sim.sitl.stages import NotFlown, Stages

HOME = Home(48.0, 14.0, 320.0, 90.0)


class Station:
    """A ground station; ``refusals`` times it does not arm, and it knows the parameters that are in ``known``."""

    def __init__(self, refusals: int = 0, known: tuple[str, ...] = ("SIM_GPS_DISABLE",)) -> None:
        self.refusals, self.known, self.done = refusals, known, []

    def upload(self, mission: Any) -> None:
        self.done.append("upload")

    def arm(self) -> None:
        if self.refusals > 0:
            self.refusals -= 1
            raise LinkError("the autopilot did not arm: COMMAND_DENIED")
        self.done.append("arm")

    def start_mission(self) -> None:
        self.done.append("start")

    def set_parameter(self, name: str, value: int) -> None:
        if name not in self.known:
            raise LinkError(f"the autopilot did not set {name}")
        self.done.append((name, value))


class Daemon:
    def __init__(self) -> None:
        self.started = 0

    def start(self) -> None:
        self.started += 1

    def kill(self) -> None:
        self.started -= 1

    def check(self) -> None:
        """It runs."""


@pytest.fixture(autouse=True)
def no_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("BOOT_S", "READY_S", "STREAMS_S", "TAKE_OVER_S", "LOSS_S"):
        monkeypatch.setattr(sitl_stages, name, 0.05)
    monkeypatch.setattr(sitl_stages, "ARM_S", 0.2)
    monkeypatch.setattr(sitl_stages, "ARM_AGAIN_S", 0.01)
    monkeypatch.setattr(sitl_stages, "LOOK_S", 0.01)


def made(notes: Notes, station: Station | None = None) -> tuple[Stages, Station, Daemon]:
    station, daemon = station or Station(), Daemon()
    firmware: Any = SimpleNamespace(check=lambda: None)
    scene: Any = SimpleNamespace(home=HOME, mission=None)
    observer: Any = SimpleNamespace(notes=notes)
    any_station: Any = station
    any_daemon: Any = daemon
    return Stages(firmware, any_station, observer, any_daemon, scene, Console(quiet=True)), station, daemon


def flying(height_m: float = 100.0, fix_since_s: float = 15.0) -> Notes:
    """In the air, with a fix of Terrafix for so long."""
    now_ns = time.monotonic_ns()
    notes = Notes()
    notes.truth = [Truth(now_ns, 48.0, 14.0, HOME.amsl_m + height_m, (0.0, 20.0, 0.0), 0.0, 0.0, 0.0)]
    for tenth in range(200, 0, -1):
        notes.fix_types[1].append((now_ns - tenth * 100_000_000, 3 if tenth / 10 <= fix_since_s else 1))
    return notes


def test_terrafix_starts_when_the_autopilot_has_a_position() -> None:
    notes = Notes(said=[Said(0, 6, "EKF3 IMU0 initialised")])
    stages, station, daemon = made(notes)
    with pytest.raises(NotFlown, match=r"a position by GNSS did not come .* last text: EKF3 IMU0 initialised"):
        stages.get_ready()
    assert daemon.started == 0 and station.done == []
    notes.ekf_flags.append((0, mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_ATTITUDE))
    with pytest.raises(NotFlown, match="the first GPS_INPUT did not come"):
        stages.get_ready()
    notes.fix_types[1].append((0, 1))
    stages.get_ready()
    assert station.done[-1] == "upload"


def test_arming_is_tried_again_and_comes_before_the_mission() -> None:
    stages, station, _ = made(Notes(), Station(refusals=3))
    stages.take_off()
    assert station.done == ["arm", "start"] and stages.times.armed_ns is not None


def test_checks_that_never_pass_end_the_flight_with_the_reason() -> None:
    notes = Notes(said=[Said(0, 2, "PreArm: Gyros inconsistent")])
    stages, _, _ = made(notes, Station(refusals=10**6))
    with pytest.raises(NotFlown, match="COMMAND_DENIED; last text: PreArm: Gyros inconsistent"):
        stages.take_off()


@pytest.mark.parametrize(("height_m", "fix_since_s"), [(60.0, 15.0), (100.0, 5.0)])
def test_the_gnss_is_kept_while_terrafix_is_not_ready(height_m: float, fix_since_s: float) -> None:
    stages, station, _ = made(flying(height_m, fix_since_s))
    with pytest.raises(NotFlown, match="80 m above home and a 3D fix of Terrafix"):
        stages.lose_gnss()
    assert station.done == []


@pytest.mark.parametrize("known", ["SIM_GPS_DISABLE", "SIM_GPS1_ENABLE"])
def test_the_receiver_is_switched_off_by_the_name_that_the_firmware_has(known: str) -> None:
    notes = flying()
    notes.fix_types[0].extend([(6, 1), (7, 6), (8, 1), (9, 1)])  # two reports before anybody looked
    stages, station, _ = made(notes, Station(known=(known,)))
    stages.lose_gnss()
    assert station.done == [(known, 1 if known == "SIM_GPS_DISABLE" else 0)] and stages.times.lost_ns == 8


def test_a_receiver_that_stays_on_ends_the_flight() -> None:
    notes = flying()
    notes.fix_types[0].append((7, 6))
    stages, _, _ = made(notes, Station(known=()))
    with pytest.raises(NotFlown, match="the loss of the GNSS did not come"):
        stages.lose_gnss()


def test_kills_follow_each_other_and_each_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl_stages, "KILL_AFTER_S", 0.01)
    monkeypatch.setattr(sitl_stages, "DOWN_S", 0.01)
    monkeypatch.setattr(sitl_stages, "BACK_S", 0.05)
    notes = flying()
    stages, _, daemon = made(notes)
    start = daemon.start

    def back() -> None:
        start()
        notes.fix_types[1].append((time.monotonic_ns() + 30_000_000, 3))

    daemon.start = back  # type: ignore[method-assign]
    stages.kill_terrafix()
    stages.kill_terrafix()
    first, second = stages.times.kills
    assert first.back_ns is not None and second.back_ns is not None
    assert first.killed_ns < first.restarted_ns < first.back_ns <= second.back_ns
    daemon.start = start  # type: ignore[method-assign]
    time.sleep(0.05)
    with pytest.raises(NotFlown, match="a 3D fix after the restart did not come"):
        stages.kill_terrafix()
    assert [kill.back_ns is None for kill in stages.times.kills] == [False, False, True]


def test_it_has_landed_when_it_disarmed() -> None:
    notes = Notes(armed=[(1, True)])
    stages, _, _ = made(notes)
    with pytest.raises(NotFlown, match="the landing did not come"):
        stages.land(0.05)
    notes.armed.append((2, False))
    stages.land(0.05)
    assert stages.times.landed_ns is not None


def test_the_camera_description_is_one(tmp_path: Path) -> None:
    from terrafix.core.config import load
    from terrafix.vision.sources.description import camera_of, read_description
    from terrafix_tools.sim.flights.folder import CAMERA

    scene: Any = SimpleNamespace(home=HOME, map_path=tmp_path / "map.gpkg")
    sitl_stages.Daemon(tmp_path, scene, "http://127.0.0.1:1/", "udpin:127.0.0.1:2")
    read = read_description(tmp_path / "camera.toml")
    assert camera_of(tmp_path / "camera.toml", read) == CAMERA
    assert read.start is not None and (read.start.lat_deg, read.start.ground_amsl_m) == (48.0, 320.0)
    assert load([tmp_path / "terrafix.toml"]).link.gps_id == 1
