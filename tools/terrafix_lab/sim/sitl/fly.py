"""Flight on ArduPilot SITL: take-off on simulated GNSS, GNSS loss, mission flown on GPS_INPUT, landing.

Only the physics is simulated: the firmware runs with its filter and controllers, MAVSDK is the ground station, and the
supervisor runs its six processes. They share one machine and its clock, so the flight runs in real time.
"""

import contextlib
import signal
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

from rich.console import Console

from terrafix.core.errors import UsageError
from terrafix.core.installed_files import installed_files
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_lab.sim.out_folder import prepare_folder
from terrafix_lab.sim.sitl.camera import SimulatedCamera
from terrafix_lab.sim.sitl.firmware import Firmware, find_binary, kind_of, take_ports
from terrafix_lab.sim.sitl.firmware_log import firmware_figures, text_lines
from terrafix_lab.sim.sitl.ground_side import connected
from terrafix_lab.sim.sitl.observer import FlightLog, Observer
from terrafix_lab.sim.sitl.report import Figures, figures, verdicts, write_report, write_texts, write_truth
from terrafix_lab.sim.sitl.scene import generate_scene
from terrafix_lab.sim.sitl.setup import SPEED_MPS, WORLD_M, laps_for, mission_for, write_parameters
from terrafix_lab.sim.sitl.stages import Daemon, FlightAborted, Stages
from terrafix_lab.sim.world import place as world

PARAMETERS = "config/vehicles/second-gps.param"  # of the installed files
REPORT = "ardupilot.json"  # a folder that contains this file may be emptied
TIME_FACTOR = 2.0  # Time limit of the flight, as a multiple of the time at cruise speed,
CLIMB_AND_LANDING_S = 240.0  # plus this for climb and landing
MAX_DURATION_S = 120.0


class What(StrEnum):
    """What happens to Terrafix in a flight."""

    KILL = "kill"  # all of it is killed and restarted
    CAMERA = "camera"  # no image for some seconds
    SPOOF = "spoof"  # the receiver is shifted, with link.gnss = "act"; Terrafix is killed after the switch


@dataclass(frozen=True)
class Disturbance:
    what: What
    duration_s: float = 0.0  # of CAMERA

    @classmethod
    def parsed(cls, text: str) -> "Disturbance":
        """From "kill", "spoof", or "camera:SECONDS". Raises UsageError."""
        what, _, seconds = text.partition(":")
        with contextlib.suppress(ValueError):
            found = cls(What(what), float(seconds or 0.0))
            if (found.what is What.CAMERA) == (0.0 < found.duration_s < MAX_DURATION_S):
                return found
        raise UsageError(f"--disturb {text}: give kill, spoof, or camera:SECONDS (up to {MAX_DURATION_S:.0f})")


def fly(
    out: Path,
    *,
    binary: Path | None = None,
    vehicle: Kind | None = None,
    seed: int = 1,
    length_m: float = 5000.0,
    port: int = 0,
    parameters: list[Path] | None = None,
    disturbances: Sequence[Disturbance] = (),
    gnss_start: bool = False,
) -> int:
    """Writes map, firmware/, record/, statustext.log, truth.csv and ardupilot.json into ``out``.

    ``parameters``: parameter files for Terrafix; default: config/vehicles/second-gps.param. ``disturbances``: in
    this order; a spoof comes before the GNSS loss, the others after it. ``gnss_start``: no start in Terrafix'
    configuration, it takes the autopilot's GNSS.
    Returns the exit code: 0 when every verdict holds, else 1. Raises UsageError, OutputError, LinkError.
    """
    program = find_binary(binary)
    kind = kind_of(program, vehicle)
    files = [_readable(path) for path in parameters or [installed_files() / PARAMETERS]]
    ports = take_ports(port)
    place = world.generate(seed, width_m=WORLD_M[0], height_m=WORLD_M[1])
    mission = mission_for(place, kind, length_m)
    prepare_folder(out, REPORT, {"vehicle": str(kind), "seed": seed})
    console = Console()
    with console.status("generating a place, its summer map and the camera's autumn view"):
        scene = generate_scene(out, place, mission)
        write_parameters(out / "vehicle.param", kind)
    with (
        _sigterm_as_interrupt(),
        Observer(ports.observer) as observer,
        FrameStream() as stream,
        Firmware(program, kind, out / "firmware", scene.home, ports, [out / "vehicle.param", *files]) as firmware,
        connected(ports.ground) as station,
        SimulatedCamera(stream, scene.ground, scene.frame, observer.truth_at, seed) as camera,
        Daemon(
            out,
            scene,
            stream.url,
            f"udpin:127.0.0.1:{ports.companion}",
            start_configured=not gnss_start,
            gnss="act" if any(d.what is What.SPOOF for d in disturbances) else "advise",
        ) as daemon,
        _signals_ignored_at_exit(),
    ):
        stages = Stages(firmware, station, observer, daemon, camera, scene, console)
        laps, lap_m = laps_for(length_m)
        limit_s = TIME_FACTOR * laps * lap_m / SPEED_MPS[kind] + CLIMB_AND_LANDING_S
        problem = _run_stages(stages, disturbances, limit_s)
    found = figures(observer.log, stages.times, scene.home)
    about: dict[str, object] = {
        "vehicle": str(kind),
        "binary": str(program),
        "firmware": observer.log.version,
        "seed": seed,
    }
    about |= {"parameters": [str(path) for path in files], "length_m": length_m, "problem": problem}
    return _write_results(out, observer.log, found, about, length_m, console)


def _run_stages(stages: Stages, disturbances: Sequence[Disturbance], landing_limit_s: float) -> str:
    """Runs all stages of the flight. Returns the reason when it was aborted, else ""."""
    try:
        stages.prepare()
        stages.take_off()
        for disturbance in disturbances:
            if disturbance.what is What.SPOOF:
                stages.spoof_and_kill()
        stages.lose_gnss()
        for disturbance in disturbances:
            if disturbance.what is What.KILL:
                stages.kill_terrafix()
            elif disturbance.what is What.CAMERA:
                stages.cover_camera(disturbance.duration_s)
        stages.land(landing_limit_s)
    except FlightAborted as failed:
        return str(failed)
    return ""


def _write_results(
    out: Path, log: FlightLog, found: Figures, about: dict[str, object], length_m: float, console: Console
) -> int:
    """Writes the report files and prints the verdicts. Returns the exit code. Raises OutputError."""
    own = firmware_figures(out / "firmware")
    about |= {"firmware_log": None if own is None else asdict(own)}
    write_report(out / REPORT, about, found, length_m)
    write_texts(out / "statustext.log", log)
    write_truth(out / "truth.csv", log)
    if about["problem"]:
        console.print(f"aborted: {about['problem']}", highlight=False)
    results = verdicts(found, length_m)
    for what, good in results.items():
        console.print(f"{'pass' if good else 'FAIL'}  {what}", highlight=False)
    for line in text_lines(own) if own is not None else ["the firmware has written no log"]:
        console.print(line, highlight=False, soft_wrap=True)
    console.print(f"report   {out / REPORT}", highlight=False, soft_wrap=True)
    return 0 if all(results.values()) else 1


@contextlib.contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """Handles SIGTERM like Ctrl-C, so that the firmware and the processes are stopped."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, interrupt), signal.SIGINT: signal.getsignal(signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _signals_ignored_at_exit() -> Iterator[None]:
    """Ignores SIGINT and SIGTERM from the end of its body until the handlers are restored: a second Ctrl-C would
    interrupt the shutdown and leave processes behind.
    """
    try:
        yield
    finally:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)


def _readable(path: Path) -> Path:
    if not path.is_file():
        raise UsageError(f"{path}: no such parameter file; check --parameters")
    return path
