"""A flight on ArduPilot's own firmware: take-off on simulated GNSS, GNSS lost, the mission flown on GPS_INPUT, landing.

Everything is real but the air and the ground: the firmware with its filter and its pilots, MAVSDK as ground station,
the supervisor and its six processes. They share one machine and its clock, so it runs in real time."""

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from terrafix.core.errors import UsageError
from terrafix_tools.sim.autopilot.parameters import Kind
from terrafix_tools.sim.camera.stream import FrameStream
from terrafix_tools.sim.out_folder import make_room
from terrafix_tools.sim.sitl.camera import SimulatedCamera
from terrafix_tools.sim.sitl.firmware import Firmware, find_binary, kind_of, take_ports
from terrafix_tools.sim.sitl.ground_side import connected
from terrafix_tools.sim.sitl.observer import Observer
from terrafix_tools.sim.sitl.report import figures, verdicts, write_report, write_texts, write_truth
from terrafix_tools.sim.sitl.scene import generate_scene
from terrafix_tools.sim.sitl.setup import SPEED_MPS, WORLD_M, laps_for, mission_for, write_parameters
from terrafix_tools.sim.sitl.stages import Daemon, NotFlown, Stages
from terrafix_tools.sim.world import place as world

PARAMETERS = Path(__file__).resolve().parents[4] / "config" / "vehicles" / "second-gps.param"
REPORT = "ardupilot.json"  # a folder with this file in it is ours to empty
SLOWER = 2.0  # the flight may take so many times what its rounds at cruise speed do,
LANDING_S = 240.0  # and this for climb and landing


def fly(
    out: Path,
    *,
    binary: Path | None = None,
    vehicle: Kind | None = None,
    seed: int = 1,
    length_m: float = 5000.0,
    port: int = 0,
    parameters: list[Path] | None = None,
    kills: int = 0,
    gnss_start: bool = False,
) -> int:
    """Everything into ``out``: map, firmware/, record/, statustext.log, truth.csv, ardupilot.json.

    ``parameters``: what the vehicle has of Terrafix; default: config/vehicles/second-gps.param. ``kills``: how often
    Terrafix is killed in flight, and started again. ``gnss_start``: its configuration does not say where it begins.
    -> exit code: 0 when every verdict holds, else 1. Raises UsageError, OutputError, LinkError."""
    program = find_binary(binary)
    kind = kind_of(program, vehicle)
    files = [_readable(path) for path in parameters or [PARAMETERS]]
    ports = take_ports(port)
    place = world.generate(seed, width_m=WORLD_M[0], height_m=WORLD_M[1])
    mission = mission_for(place, kind, length_m)
    make_room(out, REPORT, {"vehicle": str(kind), "seed": seed})
    console = Console()
    with console.status("a place, its map in summer and its camera in autumn"):
        scene = generate_scene(out, place, mission)
        write_parameters(out / "vehicle.param", kind)
    problem = ""
    with (
        _terminated_like_interrupted(),
        Observer(ports.observer) as observer,
        FrameStream() as stream,
        Firmware(program, kind, out / "firmware", scene.home, ports, [out / "vehicle.param", *files]) as firmware,
        connected(ports.ground) as station,
        SimulatedCamera(stream, scene.ground, scene.frame, observer.truth_at, seed),
        Daemon(out, scene, stream.url, f"udpin:127.0.0.1:{ports.companion}", says_start=not gnss_start) as daemon,
        _undisturbed(),
    ):
        stages = Stages(firmware, station, observer, daemon, scene, console)
        try:
            stages.get_ready()
            stages.take_off()
            stages.lose_gnss()
            for _ in range(kills):
                stages.kill_terrafix()
            laps, lap_m = laps_for(length_m)
            stages.land(SLOWER * laps * lap_m / SPEED_MPS[kind] + LANDING_S)
        except NotFlown as failed:
            problem = str(failed)
    found = figures(observer.notes, stages.times, scene.home)
    about = {"vehicle": str(kind), "binary": str(program), "firmware": observer.notes.version, "seed": seed}
    about |= {"parameters": [str(path) for path in files], "length_m": length_m, "problem": problem}
    write_report(out / REPORT, about, found, length_m)
    write_texts(out / "statustext.log", observer.notes)
    write_truth(out / "truth.csv", observer.notes)
    if problem:
        console.print(f"not flown: {problem}", highlight=False)
    held = verdicts(found, length_m)
    for what, good in held.items():
        console.print(f"{'pass' if good else 'FAIL'}  {what}", highlight=False)
    console.print(f"report   {out / REPORT}", highlight=False, soft_wrap=True)
    return 0 if all(held.values()) else 1


@contextlib.contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM ends the flight as Ctrl-C does: the firmware and the processes must not stay behind."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, interrupt), signal.SIGINT: signal.getsignal(signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """From the end of what is inside, until the signals are given back: a second Ctrl-C would break off what ends the
    others, and they would stay behind."""
    try:
        yield
    finally:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)


def _readable(path: Path) -> Path:
    if not path.is_file():
        raise UsageError(f"{path}: no such parameter file; check --parameters")
    return path
