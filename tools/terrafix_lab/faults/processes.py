"""Faults of the processes, of their computer and of the line to the autopilot, which the fault matrix causes."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from terrafix.processes import PROCESSES
from terrafix_lab.chaos.console import ASKING_CLIENTS, EVENT_CLIENTS, Console
from terrafix_lab.chaos.switches import Switch
from terrafix_lab.faults.fault import Action, Fault, Need, Phase, Process, nothing

if TYPE_CHECKING:
    from terrafix_lab.chaos.rig import Rig

SUPERVISOR = "supervisor"
SHORT_S, LONG_S = 6.0, 10.0
STOPPED_SHARE = 0.8  # of the time, of a process that is slow
SLOW_SHARE = 0.75  # of the time, that a computer lacks which is four times too slow
PERIOD_S = 0.1  # of its interruptions
COOL_MC, HOTTEST_MC = 40_000, 95_000  # of the simulated thermal zone
SPARE_BYTES = 4 << 20  # that a process may still allocate
SPARE_FILES = 0  # that it may still open
LEAKED_BYTES = 128 << 20  # after which the kernel ends a process that leaks
JUMP_S = 86_400.0 * 365  # of the wall clock: as after an empty battery of the clock
SLOW_FSYNC_S = 3.0
SECOND_SYSID = 42


def act(name: str, lasts_s: float, begin: Action = nothing, end: Action = nothing, *needs: Need) -> Fault:
    return Fault(name, lasts_s=lasts_s, process=Process(begin, end), needs=frozenset(needs))


def killed(process: str) -> Fault:
    return act(f"{process}: kill -9", 0.0, lambda rig: rig.signal(process, signal.SIGKILL))


def stopped(process: str, lasts_s: float) -> Fault:
    """A process that was stopped for longer than its limit has been replaced when the fault ends."""
    stop, go = (partial(_signal, process, number) for number in (signal.SIGSTOP, signal.SIGCONT))
    return act(f"{process}: SIGSTOP", lasts_s, stop, go)


def _signal(process: str, number: signal.Signals, rig: "Rig") -> None:
    rig.signal(process, number)


def slow(process: str) -> Fault:
    def during(rig: "Rig", elapsed_s: float) -> None:
        stops = elapsed_s % PERIOD_S < STOPPED_SHARE * PERIOD_S
        rig.signal(process, signal.SIGSTOP if stops else signal.SIGCONT)

    slowed = Process(during=during, end=lambda rig: rig.signal(process, signal.SIGCONT))
    return Fault(f"{process}: slow", lasts_s=LONG_S, process=slowed)


def slow_all(rig: "Rig", elapsed_s: float) -> None:
    """Each process of Terrafix runs a quarter of the time, as on a computer that is four times too slow."""
    stops = elapsed_s % PERIOD_S < SLOW_SHARE * PERIOD_S
    _signal_all(rig, signal.SIGSTOP if stops else signal.SIGCONT)


def go_on_all(rig: "Rig") -> None:
    _signal_all(rig, signal.SIGCONT)


def _signal_all(rig: "Rig", number: signal.Signals) -> None:
    for process in PROCESSES:
        rig.signal(process.name, number)


def limited(process: str, what: str, limit: int, used: Callable[[int], int]) -> Fault:
    """A resource limit of the process at what it uses now (``used(pid)``); the end lifts it."""

    def set_limit(rig: "Rig", *, lifted: bool) -> None:
        pid = rig.pid(process)
        if pid is not None:
            with suppress(OSError, ValueError):
                hard = resource.prlimit(pid, limit)[1]
                resource.prlimit(pid, limit, (hard if lifted else used(pid), hard))

    return act(f"{process}: {what}", SHORT_S, partial(set_limit, lifted=False), partial(set_limit, lifted=True))


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

    return act(f"{process}: leak", SHORT_S, begin, end, Need.SWITCHES, Need.MEMORY_GROUP)


def show_another_place(rig: "Rig") -> None:
    assert rig.scene.elsewhere is not None
    rig.camera.image_at = rig.scene.elsewhere


def show_own_place(rig: "Rig") -> None:
    rig.camera.image_at = rig.scene.jpeg


def set_doubled(rig: "Rig", *, after_s: float | None) -> None:
    rig.peer.again_after_s = after_s


def _mute(rig: "Rig", *, muted: bool) -> None:
    rig.peer.muted = muted


def _noise(rig: "Rig", elapsed_s: float) -> None:
    rig.peer.inject(np.random.default_rng(round(1000 * elapsed_s)).bytes(200))


def _remount(rig: "Rig", how: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{how}", str(rig.out)], check=False, capture_output=True)


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
    on, off = lambda rig: rig.switches.set(switch, value), lambda rig: rig.switches.set(switch, 0.0)
    return act(name, SHORT_S, on, off, Need.SWITCHES, *needs)


def console(name: str, lasts_s: float, begin: Callable[[Console], None], end: Callable[[Console], None]) -> Fault:
    def of(action: Callable[[Console], None], rig: "Rig") -> None:
        assert rig.console is not None
        action(rig.console)

    return act(f"console: {name}", lasts_s, partial(of, begin), partial(of, end), Need.CONSOLE)


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


def busy(processes: int) -> Process:
    """So many other programs that use the processor."""

    def saturate(rig: "Rig") -> None:
        rig.busy += [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]

    return Process(saturate, _rest)


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


NAMES = (SUPERVISOR, *(process.name for process in PROCESSES))
KILLED_AND_LIMITED = (
    act("all processes: kill -9", 0.0, lambda rig: rig.kill_all()),
    *(killed(name) for name in NAMES),
    *(stopped(name, SHORT_S if name == SUPERVISOR else LONG_S) for name in NAMES),
    *(slow(name) for name in NAMES),
    *(limited(name, "no more memory", resource.RLIMIT_AS, _memory) for name in NAMES),
    *(leaking(name) for name in NAMES),
    *(limited(name, "no more files", resource.RLIMIT_NOFILE, _files) for name in NAMES),
)
AROUND_THEM = (
    act("link: silent", SHORT_S, partial(_mute, muted=True), partial(_mute, muted=False)),
    Fault("link: garbage", lasts_s=SHORT_S, process=Process(during=_noise)),
    act("link: autopilot reboots", 0.0, lambda rig: rig.peer.reboot()),
    act(
        "link: other baud rate",
        SHORT_S,
        partial(_other_baud, other=True),
        partial(_other_baud, other=False),
        Need.SERIAL,
    ),
    Fault("link: second autopilot", lasts_s=SHORT_S, process=Process(during=_second_autopilot)),
    act("disk: full", SHORT_S, _fill, lambda rig: (rig.out / "filler").unlink(missing_ok=True), Need.DISK),
    act("disk: read-only", SHORT_S, partial(_remount, how="ro"), partial(_remount, how="rw"), Need.DISK),
    switched("disk: slow", Switch.FSYNC_S, SLOW_FSYNC_S),
    act("disk: gone", SHORT_S, lambda rig: _unmount(rig.out), nothing, Need.DISK),
    act("shared memory: full", SHORT_S, _fill_shared, _free_shared, Need.SHARED_MEMORY),
    switched("wall clock: a year ahead", Switch.WALL_CLOCK_S, JUMP_S),
    switched("wall clock: a year back", Switch.WALL_CLOCK_S, -JUMP_S),
    act("model: file altered, anchor killed", 0.0, _alter_model, nothing, Need.MODEL),
    switched("model: provider lost", Switch.NO_PROVIDER, 1.0, Need.MODEL),
    replace(  # before the first fix nothing has opened it yet
        act("map: file removed", 0.0, lambda rig: rig.map_path.unlink()),
        no_fix_in=frozenset({Phase.LANDING, Phase.START}),
    ),
    act("map: file altered", 0.0, lambda rig: _alter(rig.map_path)),
    console("kill -9", 0.0, lambda it: it.signal(signal.SIGKILL), lambda _: None),
    console("SIGSTOP", LONG_S, lambda it: it.signal(signal.SIGSTOP), lambda it: it.signal(signal.SIGCONT)),
    console(f"flooded by {EVENT_CLIENTS + ASKING_CLIENTS} clients", LONG_S, Console.flood, Console.end_flood),
    Fault("processor: saturated", lasts_s=LONG_S, process=busy(2 * (os.cpu_count() or 1))),
    Fault(
        "heat: 40 to 97 to 40 C",
        lasts_s=LONG_S,
        process=Process(during=_heat, end=lambda rig: rig.set_temperature(COOL_MC)),
    ),
)
