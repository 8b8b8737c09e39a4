"""Faults of the processes, of their computer and of the line to the autopilot, which the fault matrix causes."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from terrafix.processes import PROCESSES
from terrafix_lab.chaos.console import ASKING_CLIENTS, EVENT_CLIENTS, Console
from terrafix_lab.chaos.switches import Switch
from terrafix_lab.faults.fault import Action, Fault, Need, Phase, Process

if TYPE_CHECKING:
    from terrafix_lab.chaos.rig import Rig

SUPERVISOR = "supervisor"
SHORT_S, LONG_S = 6.0, 10.0
STOPPED_SHARE = 0.8  # of the time, of a process that is slow
PERIOD_S = 0.1  # of its interruptions
COOL_MC, HOTTEST_MC = 40_000, 95_000  # of the simulated thermal zone
SPARE_BYTES = 4 << 20  # that a process may still allocate
SPARE_FILES = 0  # that it may still open
LEAKED_BYTES = 128 << 20  # after which the kernel ends a process that leaks
JUMP_S = 86_400.0 * 365  # of the wall clock: as after an empty battery of the clock
SLOW_FSYNC_S = 3.0
SECOND_SYSID = 42
DISK = frozenset({Need.DISK})


def killed(process: str) -> Fault:
    return Fault(f"{process}: kill -9", lasts_s=0.0, process=Process(lambda rig: rig.signal(process, signal.SIGKILL)))


def stopped(process: str, lasts_s: float) -> Fault:
    """A process that was stopped for longer than its limit has been replaced when the fault ends."""
    stop = Process(
        begin=lambda rig: rig.signal(process, signal.SIGSTOP), end=lambda rig: rig.signal(process, signal.SIGCONT)
    )
    return Fault(f"{process}: SIGSTOP", lasts_s=lasts_s, process=stop)


def slow(process: str) -> Fault:
    def during(rig: "Rig", elapsed_s: float) -> None:
        stops = elapsed_s % PERIOD_S < STOPPED_SHARE * PERIOD_S
        rig.signal(process, signal.SIGSTOP if stops else signal.SIGCONT)

    slowed = Process(during=during, end=lambda rig: rig.signal(process, signal.SIGCONT))
    return Fault(f"{process}: slow", lasts_s=LONG_S, process=slowed)


def limited(process: str, what: str, limit: int, used: Callable[[int], int]) -> Fault:
    """A resource limit of the process at what it uses now (``used(pid)``); the end lifts it."""

    def set_limit(rig: "Rig", *, lifted: bool) -> None:
        pid = rig.pid(process)
        if pid is not None:
            with suppress(OSError, ValueError):
                hard = resource.prlimit(pid, limit)[1]
                resource.prlimit(pid, limit, (hard if lifted else used(pid), hard))

    limits = Process(lambda rig: set_limit(rig, lifted=False), lambda rig: set_limit(rig, lifted=True))
    return Fault(f"{process}: {what}", lasts_s=SHORT_S, process=limits)


def _memory(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
    return pages * resource.getpagesize() + SPARE_BYTES


def _files(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd")) + SPARE_FILES


def leaking(process: str) -> Fault:
    """It takes 80 MB a second, until the kernel kills it in its control group."""

    def begin(rig: "Rig") -> None:
        pid = rig.pid(process)
        if pid is not None:
            rig.memory_group.limit(pid, LEAKED_BYTES)
            rig.switches.set(Switch.LEAK_PID, pid)

    def end(rig: "Rig") -> None:
        rig.switches.set(Switch.LEAK_PID, 0.0)
        rig.memory_group.lift()

    needs = frozenset({Need.SWITCHES, Need.MEMORY_GROUP})
    return Fault(f"{process}: leak", lasts_s=SHORT_S, process=Process(begin, end), needs=needs)


def _mute(rig: "Rig", *, muted: bool) -> None:
    rig.peer.muted = muted


def _noise(rig: "Rig", elapsed_s: float) -> None:
    rig.peer.inject(np.random.default_rng(round(1000 * elapsed_s)).bytes(200))


def _mount(out: Path, *options: str) -> None:
    subprocess.run(["mount", *options, str(out)], check=False, capture_output=True)


def _fill(rig: "Rig") -> None:
    with suppress(OSError), (rig.out / "filler").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 16))


def _unmount(out: Path) -> None:
    """The disk is gone: open files go on in a file system that nobody sees, new ones come on the disk below."""
    subprocess.run(["umount", "-l", str(out)], check=False, capture_output=True)


def _fill_shared(rig: "Rig") -> None:
    with suppress(OSError), (rig.shared_memory / "filler").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 12))


def _free_shared(rig: "Rig") -> None:
    (rig.shared_memory / "filler").unlink(missing_ok=True)


def _other_baud(rig: "Rig", *, other: bool) -> None:
    assert rig.line is not None
    rig.line.other_baud = other


def switched(name: str, switch: Switch, value: float, *needs: Need) -> Fault:
    switched_on = Process(lambda rig: rig.switches.set(switch, value), lambda rig: rig.switches.set(switch, 0.0))
    return Fault(name, lasts_s=SHORT_S, process=switched_on, needs=frozenset({Need.SWITCHES, *needs}))


def console(name: str, lasts_s: float, begin: Callable[[Console], None], end: Callable[[Console], None]) -> Fault:
    def act(rig: "Rig", action: Callable[[Console], None]) -> None:
        assert rig.console is not None
        action(rig.console)

    acts = Process(lambda rig: act(rig, begin), lambda rig: act(rig, end))
    return Fault(f"console: {name}", lasts_s=lasts_s, process=acts, needs=frozenset({Need.CONSOLE}))


def _alter(path: Path) -> None:
    """Overwrites a part of the file in place, as a failing disk would."""
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.seek(size // 3)
        file.write(np.random.default_rng(1).bytes(size // 3))


def _alter_model(rig: "Rig") -> None:
    """The process that uses it has to open it again."""
    _alter(rig.model_path)
    rig.signal("anchor", signal.SIGKILL)


def _saturate(rig: "Rig") -> None:
    loop = [sys.executable, "-c", "while True: pass"]
    rig.busy += [subprocess.Popen(loop) for _ in range(2 * (os.cpu_count() or 1))]


def _rest(rig: "Rig") -> None:
    for program in rig.busy:
        program.kill()
        program.wait()
    rig.busy.clear()


def _heat(rig: "Rig", elapsed_s: float) -> None:
    share = 1.0 - abs(2.0 * elapsed_s / LONG_S - 1.0)  # 0, 1, 0
    rig.set_temperature(round(COOL_MC + share * (HOTTEST_MC + 2000 - COOL_MC)))


def _second_autopilot(rig: "Rig", _elapsed_s: float) -> None:
    from terrafix_lab.sim.autopilot.wire import heartbeat  # loads the MAVLink library

    rig.peer.inject(heartbeat(SECOND_SYSID))


def _at_once(
    name: str,
    begin: Action,
    *,
    no_fix_in: frozenset[Phase] = frozenset({Phase.LANDING}),
    needs: frozenset[Need] = frozenset(),
) -> Fault:
    return Fault(name, lasts_s=0.0, process=Process(begin), needs=needs, no_fix_in=no_fix_in)


NAMES = (SUPERVISOR, *(process.name for process in PROCESSES))
KILLED_AND_LIMITED = (
    _at_once("all processes: kill -9", lambda rig: rig.kill_all()),
    *(killed(name) for name in NAMES),
    *(stopped(name, SHORT_S if name == SUPERVISOR else LONG_S) for name in NAMES),
    *(slow(name) for name in NAMES),
    *(limited(name, "no more memory", resource.RLIMIT_AS, _memory) for name in NAMES),
    *(leaking(name) for name in NAMES),
    *(limited(name, "no more files", resource.RLIMIT_NOFILE, _files) for name in NAMES),
)
AROUND_THEM = (
    Fault(
        "link: silent",
        lasts_s=SHORT_S,
        process=Process(lambda rig: _mute(rig, muted=True), lambda rig: _mute(rig, muted=False)),
    ),
    Fault("link: garbage", lasts_s=SHORT_S, process=Process(during=_noise)),
    _at_once("link: autopilot reboots", lambda rig: rig.peer.reboot()),
    Fault(
        "link: other baud rate",
        lasts_s=SHORT_S,
        process=Process(lambda rig: _other_baud(rig, other=True), lambda rig: _other_baud(rig, other=False)),
        needs=frozenset({Need.SERIAL}),
    ),
    Fault("link: second autopilot", lasts_s=SHORT_S, process=Process(during=_second_autopilot)),
    Fault(
        "disk: full",
        lasts_s=SHORT_S,
        process=Process(_fill, lambda rig: (rig.out / "filler").unlink(missing_ok=True)),
        needs=DISK,
    ),
    Fault(
        "disk: read-only",
        lasts_s=SHORT_S,
        process=Process(
            lambda rig: _mount(rig.out, "-o", "remount,ro"), lambda rig: _mount(rig.out, "-o", "remount,rw")
        ),
        needs=DISK,
    ),
    switched("disk: slow", Switch.FSYNC_S, SLOW_FSYNC_S),
    Fault("disk: gone", lasts_s=SHORT_S, process=Process(lambda rig: _unmount(rig.out)), needs=DISK),
    Fault(
        "shared memory: full",
        lasts_s=SHORT_S,
        process=Process(_fill_shared, _free_shared),
        needs=frozenset({Need.SHARED_MEMORY}),
    ),
    switched("wall clock: a year ahead", Switch.WALL_CLOCK_S, JUMP_S),
    switched("wall clock: a year back", Switch.WALL_CLOCK_S, -JUMP_S),
    _at_once("model: file altered, anchor killed", _alter_model, needs=frozenset({Need.MODEL})),
    switched("model: provider lost", Switch.NO_PROVIDER, 1.0, Need.MODEL),
    # before the first fix nothing has opened it yet
    _at_once("map: file removed", lambda rig: rig.map_path.unlink(), no_fix_in=frozenset({Phase.LANDING, Phase.START})),
    _at_once("map: file altered", lambda rig: _alter(rig.map_path)),
    console("kill -9", 0.0, lambda it: it.signal(signal.SIGKILL), lambda _: None),
    console("SIGSTOP", LONG_S, lambda it: it.signal(signal.SIGSTOP), lambda it: it.signal(signal.SIGCONT)),
    console(f"flooded by {EVENT_CLIENTS + ASKING_CLIENTS} clients", LONG_S, Console.flood, Console.end_flood),
    Fault("processor: saturated", lasts_s=LONG_S, process=Process(_saturate, _rest)),
    Fault(
        "heat: 40 to 97 to 40 C",
        lasts_s=LONG_S,
        process=Process(during=_heat, end=lambda rig: rig.set_temperature(COOL_MC)),
    ),
)
