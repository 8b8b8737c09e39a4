"""ArduPilot SITL (software in the loop): finds and checks the binary, starts it in its own folder, and stops it.

The firmware speaks MAVLink on three serial ports, each a UDP connection to a port of this machine on which a part of
the harness listens. Options: `arduplane --help`, and "Using SITL" in ArduPilot's developer documentation.
"""

import contextlib
import os
import socket
import subprocess
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from terrafix.core.errors import OutputError, UsageError
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_tools import child_process

BINARY_VARIABLE = "TERRAFIX_ARDUPILOT_SITL"
HELP = "docs/sitl.md says how to get one"
STOP_S = 5.0  # it stops within a tick of its clock; a process that hangs is killed
CONSOLE = "firmware.log"
TAIL_CHARS = 160  # of the last console line, in an error message


MODELS = {Kind.PLANE: "plane", Kind.COPTER: "quad"}  # flight models built into the firmware


@dataclass(frozen=True)
class Ports:
    """UDP ports on 127.0.0.1."""

    ground: int  # SERIAL0: the ground station
    companion: int  # SERIAL2: the observer, which records the flight
    observer: int  # RC input port of the firmware; the fixed default would allow only one flight at a time
    rc_in: int  # the firmware listens here for a radio; its fixed default would let one flight at a time


@dataclass(frozen=True)
class Home:
    """Position and heading of the vehicle at the start."""

    lat_deg: float
    lon_deg: float
    amsl_m: float
    heading_deg: float


def find_binary(given: Path | None) -> Path:
    """Returns ``given``, else the path in the environment variable. Raises UsageError: none set, not found, not
    executable.
    """
    named = given or (Path(os.environ[BINARY_VARIABLE]) if os.environ.get(BINARY_VARIABLE) else None)
    if named is None:
        raise UsageError(f"no ArduPilot binary: give --binary, or set {BINARY_VARIABLE}; {HELP}")
    path = named.expanduser()
    if not path.is_file():
        raise UsageError(f"{path}: no such ArduPilot binary; {HELP}")
    if not os.access(path, os.X_OK):
        raise UsageError(f"{path}: may not be executed; chmod +x it if it is an ArduPilot SITL binary ({HELP})")
    return path.resolve()


def kind_of(binary: Path, given: Kind | None) -> Kind:
    """Returns ``given``, else the kind in the file name. Raises UsageError when the name is not conclusive."""
    named = [kind for kind in Kind if kind in binary.name.lower()]
    if given is None and len(named) != 1:
        raise UsageError(f"{binary}: the name contains neither plane nor copter; give --vehicle")
    return given or named[0]


def take_ports(first: int = 0) -> Ports:
    """Returns ``first`` and the three ports after it, or with 0 four free ones. Raises UsageError when one is taken.

    The ports are free at the time of the call; the caller must open them right after.
    """
    numbers = [0] * 4 if first == 0 else [first + i for i in range(4)]
    taken = []
    with contextlib.ExitStack() as stack:
        for number in numbers:
            probe = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            try:
                probe.bind(("127.0.0.1", number))
            except (OSError, OverflowError):
                raise UsageError(f"UDP port {number} is in use or not allowed; choose another --port, or 0") from None
            taken.append(int(probe.getsockname()[1]))
    return Ports(*taken)


class Firmware:
    """The running firmware. A context manager; its files (parameters, logs) stay in ``folder``."""

    def __init__(
        self, binary: Path, kind: Kind, folder: Path, home: Home, ports: Ports, parameters: list[Path]
    ) -> None:
        """``parameters``: files in load order, later ones override. Raises UsageError: not executable; OutputError:
        folder.
        """
        self._console = folder / CONSOLE
        command = [str(binary), "--model", MODELS[kind], "--speedup", "1", "--rc-in-port", str(ports.rc_in)]
        command += ["--home", f"{home.lat_deg:.8f},{home.lon_deg:.8f},{home.amsl_m:.2f},{home.heading_deg:.1f}"]
        command += ["--defaults", ",".join(str(path.resolve()) for path in parameters)]
        for serial, port in enumerate((ports.ground, ports.companion, ports.observer)):
            command += [f"--serial{serial}", f"udpclient:127.0.0.1:{port}"]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with self._console.open("wb") as console:
                self._process = subprocess.Popen(
                    command, cwd=folder, stdin=subprocess.DEVNULL, stdout=console, stderr=subprocess.STDOUT
                )
        except OSError as error:
            if error.filename == str(binary) or isinstance(error, PermissionError) or error.filename is None:
                raise UsageError(f"{binary}: cannot be run on this machine ({error.strerror}); {HELP}") from None
            raise OutputError(f"{folder}: cannot be written ({error.strerror}); choose another --out") from None

    def check(self) -> None:
        """Raises UsageError with the last console line when the firmware has ended by itself."""
        code = self._process.poll()
        if code is None:
            return
        lines = self._console.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last_line = lines[-1].strip()[:TAIL_CHARS] if lines else "nothing"
        raise UsageError(f"the firmware ended with code {code}, last output: {last_line}; see {self._console}")

    def stop(self) -> None:
        if self._process.poll() is None:
            child_process.end(self._process, STOP_S)

    def __enter__(self) -> "Firmware":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
