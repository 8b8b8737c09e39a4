"""The stages of a SITL flight with stubs of firmware, ground station and observer."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rich.console import Console

pytest.importorskip("mavsdk", reason="mavsdk is not installed (pip install 'terrafix[sim]')")

from terrafix.core.errors import LinkError, UsageError
from terrafix_lab.sim.sitl import stages as sitl_stages
from terrafix_lab.sim.sitl.firmware import Home
from terrafix_lab.sim.sitl.fly import Disturbance
from terrafix_lab.sim.sitl.observer import FlightLog, StatusTextRecord, Truth
from terrafix_lab.sim.sitl.stages import FlightAborted, Stages

HOME = Home(48.0, 14.0, 320.0, 90.0)


class StubStation:
    """Ground station stub; rejects arming ``refusals`` times, and has the parameters in ``known``."""

    def __init__(self, refusals: int = 0, known: tuple[str, ...] = ("SIM_GPS_DISABLE",)) -> None:
        self.refusals, self.known = refusals, known
        self.done: list[Any] = []
        self.values = {"GPS_AUTO_SWITCH": 4, "GPS_PRIMARY": 0}

    def upload(self, mission: Any) -> None:
        self.done.append("upload")

    def arm(self) -> None:
        if self.refusals > 0:
            self.refusals -= 1
            raise LinkError("the autopilot did not arm: COMMAND_DENIED")
        self.done.append("arm")

    def start_mission(self) -> None:
        self.done.append("start")

    def set_parameter(self, name: str, value: float) -> None:
        if name not in self.known:
            raise LinkError(f"the autopilot did not set {name}")
        self.done.append((name, value))

    def parameter(self, name: str) -> int:
        return self.values[name]


class StubCamera:
    paused = False

    def pause(self) -> None:
        self.paused = True

    def resume(self) -> None:
        self.paused = False


class Daemon:
    def __init__(self) -> None:
        self.started = 0

    def start(self) -> None:
        self.started += 1

    def kill(self) -> None:
        self.started -= 1

    def check(self) -> None:
        """Still running."""


@pytest.fixture(autouse=True)
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("BOOT_S", "READY_S", "STREAMS_S", "TAKE_OVER_S", "LOSS_S"):
        monkeypatch.setattr(sitl_stages, name, 0.05)
    monkeypatch.setattr(sitl_stages, "ARM_S", 0.2)
    monkeypatch.setattr(sitl_stages, "ARM_AGAIN_S", 0.01)
    monkeypatch.setattr(sitl_stages, "POLL_S", 0.01)


def made(log: FlightLog, station: StubStation | None = None) -> tuple[Stages, StubStation, Daemon]:
    station, daemon = station or StubStation(), Daemon()
    firmware: Any = SimpleNamespace(check=lambda: None)
    scene: Any = SimpleNamespace(home=HOME, mission=None)
    observer: Any = SimpleNamespace(log=log)
    any_station: Any = station
    any_daemon: Any = daemon
    camera: Any = StubCamera()
    return Stages(firmware, any_station, observer, any_daemon, camera, scene, Console(quiet=True)), station, daemon


def flying(height_m: float = 100.0, fix_since_s: float = 15.0) -> FlightLog:
    """In the air, with a fix of Terrafix for ``fix_since_s``."""
    now_ns = time.monotonic_ns()
    log = FlightLog()
    log.truth = [Truth(now_ns, 48.0, 14.0, HOME.amsl_m + height_m, (0.0, 20.0, 0.0), 0.0, 0.0, 0.0)]
    for tenth in range(200, 0, -1):
        log.fix_types[1].append((now_ns - tenth * 100_000_000, 3 if tenth / 10 <= fix_since_s else 1))
    return log


def test_terrafix_starts_after_the_autopilot_has_a_position() -> None:
    log = FlightLog(texts=[StatusTextRecord(0, 6, "EKF3 IMU0 initialised")])
    stages, station, daemon = made(log)
    with pytest.raises(FlightAborted, match=r"no position by GNSS within .* last text: EKF3 IMU0 initialised"):
        stages.prepare()
    assert daemon.started == 0 and station.done == []
    log.ekf_flags.append((0, mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_ATTITUDE))
    with pytest.raises(FlightAborted, match="no GPS_INPUT within"):
        stages.prepare()
    log.fix_types[1].append((0, 1))
    stages.prepare()
    assert station.done[-1] == "upload"


def test_arming_is_retried_and_precedes_the_mission() -> None:
    stages, station, _ = made(FlightLog(), StubStation(refusals=3))
    stages.take_off()
    assert station.done == ["arm", "start"] and stages.times.armed_ns is not None


def test_failing_pre_arm_checks_abort_the_flight_with_the_reason() -> None:
    log = FlightLog(texts=[StatusTextRecord(0, 2, "PreArm: Gyros inconsistent")])
    stages, _, _ = made(log, StubStation(refusals=10**6))
    with pytest.raises(FlightAborted, match="COMMAND_DENIED; last text: PreArm: Gyros inconsistent"):
        stages.take_off()


@pytest.mark.parametrize(("height_m", "fix_since_s"), [(60.0, 15.0), (100.0, 5.0)])
def test_the_gnss_stays_on_until_terrafix_is_ready(height_m: float, fix_since_s: float) -> None:
    stages, station, _ = made(flying(height_m, fix_since_s))
    with pytest.raises(FlightAborted, match="80 m above home and 3D fix of Terrafix"):
        stages.lose_gnss()
    assert station.done == []


@pytest.mark.parametrize("known", ["SIM_GPS_DISABLE", "SIM_GPS1_ENABLE"])
def test_the_receiver_is_disabled_by_the_parameter_of_the_firmware(known: str) -> None:
    log = flying()
    log.fix_types[0].extend([(6, 1), (7, 6), (8, 1), (9, 1)])  # two reports before the next poll
    stages, station, _ = made(log, StubStation(known=(known,)))
    stages.lose_gnss()
    assert station.done == [(known, 1 if known == "SIM_GPS_DISABLE" else 0)] and stages.times.lost_ns == 8


def test_a_receiver_that_stays_on_aborts_the_flight() -> None:
    log = flying()
    log.fix_types[0].append((7, 6))
    stages, _, _ = made(log, StubStation(known=()))
    with pytest.raises(FlightAborted, match="no loss of the GNSS within"):
        stages.lose_gnss()


def test_each_kill_waits_for_the_recovery_from_the_previous(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl_stages, "CALM_S", 0.01)
    monkeypatch.setattr(sitl_stages, "DOWN_S", 0.01)
    monkeypatch.setattr(sitl_stages, "BACK_S", 0.05)
    log = flying()
    stages, _, daemon = made(log)
    start = daemon.start

    def back() -> None:
        start()
        now_ns = time.monotonic_ns()
        log.fix_types[1].append((now_ns + 30_000_000, 3))
        log.ekf_flags += [(now_ns + 20_000_000, mavlink.EKF_POS_HORIZ_ABS), (now_ns + 35_000_000, mavlink.EKF_ATTITUDE)]
        log.ekf_flags.append((now_ns + 50_000_000, mavlink.EKF_POS_HORIZ_ABS))

    daemon.start = back  # type: ignore[method-assign]
    stages.kill_terrafix()
    stages.kill_terrafix()
    first, second = stages.times.interruptions
    assert first.recovered_ns is not None and second.recovered_ns is not None
    assert first.used_ns is not None and first.used_ns - first.recovered_ns == 20_000_000
    assert first.began_ns < first.ended_ns < first.recovered_ns <= second.recovered_ns
    daemon.start = start  # type: ignore[method-assign]
    time.sleep(0.05)
    with pytest.raises(FlightAborted, match="no 3D fix after the restart within"):
        stages.kill_terrafix()
    assert [gap.recovered_ns is None for gap in stages.times.interruptions] == [False, False, True]


def test_the_camera_is_off_for_the_stated_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl_stages, "CALM_S", 0.01)
    monkeypatch.setattr(sitl_stages, "BACK_S", 0.05)
    stages, _, _ = made(flying())
    with pytest.raises(FlightAborted, match="no 3D fix after the camera's return within"):
        stages.cover_camera(0.2)
    (gap,) = stages.times.interruptions
    assert 0.2e9 <= gap.ended_ns - gap.began_ns < 1e9 and gap.recovered_ns is None


@pytest.mark.parametrize("restored", [True, False])
def test_a_spoof_ends_with_the_position_source_from_before_it(restored: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SPOOFED_S", "DOWN_S", "SWITCH_S"):
        monkeypatch.setattr(sitl_stages, name, 0.05)
    station = StubStation(known=("SIM_GPS_GLITCH_X",))  # the name up to 4.6
    stages, _, daemon = made(flying(), station)

    def shifted(name: str, value: float) -> None:
        StubStation.set_parameter(station, name, value)
        station.values["GPS_PRIMARY"] = 1

    station.set_parameter = shifted  # type: ignore[method-assign]
    daemon.start = lambda: station.values.update(GPS_PRIMARY=0 if restored else 1)  # type: ignore[method-assign]
    if restored:
        stages.spoof_and_kill()
        assert station.done == [("SIM_GPS_GLITCH_X", 0.001), ("SIM_GPS_GLITCH_X", 0.0)]
    else:
        with pytest.raises(FlightAborted, match="no restored position source"):
            stages.spoof_and_kill()


@pytest.mark.parametrize("text", ["kill", "spoof", "camera:20"])
def test_a_disturbance_is_given_by_its_name_and_a_duration_of_the_camera(text: str) -> None:
    found = Disturbance.parsed(text)
    expected = ("camera", 20.0) if ":" in text else (text, 0.0)
    assert (found.what.value, found.duration_s) == expected


@pytest.mark.parametrize("text", ["", "fall", "camera", "camera:0", "camera:121", "camera:x", "camera:nan", "kill:5"])
def test_another_disturbance_is_rejected_with_what_may_be_given(text: str) -> None:
    with pytest.raises(UsageError, match=r"give kill, spoof, or camera:SECONDS \(up to 120\)"):
        Disturbance.parsed(text)


def test_the_vehicle_has_landed_when_it_disarms() -> None:
    log = FlightLog(armed=[(1, True)])
    stages, _, _ = made(log)
    with pytest.raises(FlightAborted, match="no landing within"):
        stages.land(0.05)
    log.armed.append((2, False))
    stages.land(0.05)
    assert stages.times.landed_ns is not None


def test_the_camera_description_is_valid(tmp_path: Path) -> None:
    from terrafix.core.config import load
    from terrafix.vision.sources.description import camera_of, read_description
    from terrafix_lab.sim.flights.folder import CAMERA

    scene: Any = SimpleNamespace(home=HOME, map_path=tmp_path / "map.gpkg")
    sitl_stages.Daemon(tmp_path, scene, "http://127.0.0.1:1/", "udpin:127.0.0.1:2")
    read = read_description(tmp_path / "camera.toml")
    assert camera_of(tmp_path / "camera.toml", read) == CAMERA
    assert read.start is not None and (read.start.lat_deg, read.start.ground_amsl_m) == (48.0, 320.0)
    assert load([tmp_path / "terrafix.toml"]).link.gps_id == 1
