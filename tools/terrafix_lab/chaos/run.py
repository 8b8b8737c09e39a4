"""Flies the cells of the fault matrix, one after the other."""

import fcntl
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import msgspec

from terrafix.core.errors import OutputError, SourceError
from terrafix.messages import GpsInput
from terrafix.recorder.reader import read_flight
from terrafix_lab.chaos import verdict as judge
from terrafix_lab.chaos.rig import NONE, Rig
from terrafix_lab.chaos.scene import LEAD_S, ChaosScene
from terrafix_lab.chaos.verdict import Outcome
from terrafix_lab.faults.edits import EVER, Span, unchanged, unchanged_origin
from terrafix_lab.faults.fault import ROOT, Fault, Need, Phase, Process
from terrafix_lab.faults.pictures import black
from terrafix_lab.track import Track, measured
from terrafix_tools.flight_verdict import FlightVerdict, verdict_of
from terrafix_tools.score import longest_gap_s

DISK_MB = 24  # of a disk of its own
WHOLE_S = 20.0  # that a fault of a whole flight lasts
DARK_LEAD_S = 4.0  # black images before the fault
STEP_S = 0.01
STEADY_S = 3.0  # with fixes after the fault; then the cell is over
RECOVERY_LIMIT_S = 30.0  # wall time; a computer that others use as well needs more than the vehicle's
FIRST_FIX_LIMIT_S = 20.0  # beyond the planned time of the fault, on a busy computer
NOT_HERE = "not measurable here"


def fly_cell(scene: ChaosScene, fault: Fault, phase: Phase, folder: Path, *, seed: int, model: Path = NONE) -> Outcome:
    """Flies one cell in ``folder``, a new one that is removed if all was well. Raises SourceError, OutputError."""
    missing = missing_here(fault, model)
    if missing:
        return Outcome(fault=fault.name, phase=phase, verdict=f"{NOT_HERE}: {missing}")
    lead_s = 0.5 if phase is Phase.START else LEAD_S
    rig = Rig(
        scene,
        folder,
        scene.begin_s(phase, WHOLE_S if fault.lasts_s is None else fault.lasts_s) - lead_s,
        seed=seed,
        needs=fault.needs,
        model=model,
        origin=fault.origin or unchanged_origin,
    )
    try:
        if Need.DISK in fault.needs:
            _mount_disk(rig.out)
        with rig:
            outcome, track = _fly(rig, fault, phase, lead_s)
        outcome = _with_record(rig, fault, phase, outcome, track)
    finally:
        if Need.DISK in fault.needs:
            subprocess.run(["umount", "-l", str(rig.out)], check=False, capture_output=True)
    if outcome.verdict == "ok":
        shutil.rmtree(folder, ignore_errors=True)
    return outcome


def missing_here(fault: Fault, model: Path) -> str:
    """What this computer lacks for the fault; empty: nothing."""
    if fault.needs & ROOT and os.geteuid() != 0:
        return "mounting needs root"
    if Need.MODEL in fault.needs and not model.is_file():
        return "no weights of XFeat, see --model"
    return ""


def _mount_disk(out: Path) -> None:
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise OutputError(f"{out}: no disk could be mounted there ({done.stderr.strip()})")


def _fly(rig: Rig, fault: Fault, phase: Phase, lead_s: float) -> tuple[Outcome, Track]:
    rig.take_off()
    assert rig.began_s is not None
    fault_s = rig.began_s + lead_s
    if phase is Phase.DARK:
        _wait(rig, fault_s - DARK_LEAD_S)
        rig.camera.edit = black(EVER)
    _wait(rig, fault_s)
    if phase is not Phase.START:
        _wait_for_first_fix(rig)
    before = rig.peer.fixes()
    fault_s = time.monotonic()
    process = fault.process or Process()
    lasts_s = WHOLE_S if fault.lasts_s is None else fault.lasts_s
    span = Span(fault_s, fault_s + lasts_s, fault.name)
    if fault.source is not None:
        rig.camera.past_s = fault.past_s
        rig.camera.edit = fault.of_camera(span)
    rig.peer.edit_telemetry(fault.of_telemetry(span))
    process.begin(rig)
    _wait(rig, fault_s + lasts_s, lambda: process.during(rig, time.monotonic() - fault_s))
    rig.camera.past_s = 0.0
    rig.camera.edit = unchanged
    rig.peer.edit_telemetry(unchanged)
    process.end(rig)
    ended_s = time.monotonic()
    _wait_for_fix(rig, ended_s, lambda: not fault.cause or _track(rig, span, fault).is_right_again)
    end_s = time.monotonic()
    fixes = rig.peer.fixes()
    times = [fix.received_s for fix in fixes]
    had_fix = phase is Phase.START or bool(before)
    track = _track(rig, span, fault)
    outcome = Outcome(
        fault=fault.name,
        phase=phase,
        verdict="" if had_fix else judge.NO_FIX,
        fixes=len(fixes),
        wrong=len(judge.wrong_fixes(fixes, rig.scene.truth_sigma_m)),
        worst_sigmas=max((judge.sigmas(fix, rig.scene.truth_sigma_m) for fix in fixes), default=None),
        worst_error_m=max((fix.error_m for fix in fixes), default=None),
        silence_s=longest_gap_s(rig.peer.received_s, fault_s, end_s),
        without_fix_s=judge.without_fix_s(times, fault_s, end_s),
        back_s=judge.back_s(times, ended_s, end_s),
        criteria=measured([track]),
        texts=[f"{t_s - fault_s:.1f} s: {text}" for t_s, text in track.texts],
        fix_lost=judge.times_lost(times, fault_s, end_s),
        load=os.getloadavg()[0] / (os.cpu_count() or 1),
    )
    return outcome, track


def _track(rig: Rig, span: Span, fault: Fault) -> Track:
    """So far. ``span``: of the fault."""
    texts = [(t_s, text) for t_s, text in rig.peer.texts() if t_s >= span.from_s]
    return replace(judge.track_of(rig.peer.fixes(), span, rig.camera.pushed_s, fault.cause), texts=texts)


def _wait_for_first_fix(rig: Rig) -> None:
    """At most FIRST_FIX_LIMIT_S; the fault is then as much later in the flight."""
    until_s = time.monotonic() + FIRST_FIX_LIMIT_S
    while not rig.peer.fixes() and time.monotonic() < until_s:
        _wait(rig, time.monotonic() + 0.2)


def _wait_for_fix(rig: Rig, ended_s: float, is_right: Callable[[], bool]) -> None:
    """Until there were fixes for STEADY_S and ``is_right``, at most RECOVERY_LIMIT_S."""
    until_s = ended_s + RECOVERY_LIMIT_S
    while time.monotonic() < until_s:
        _wait(rig, time.monotonic() + 0.2)
        now_s = time.monotonic()
        times = [fix.received_s for fix in rig.peer.fixes() if fix.received_s > ended_s]
        back_s = judge.back_s(times, ended_s, now_s)
        if back_s is not None and now_s - (ended_s + back_s) > STEADY_S and is_right():
            return


def _wait(rig: Rig, until_s: float, act: Callable[[], None] = lambda: None) -> None:
    while time.monotonic() < until_s:
        act()
        rig.check()
        time.sleep(STEP_S)


def _with_record(rig: Rig, fault: Fault, phase: Phase, outcome: Outcome, track: Track) -> Outcome:
    """Completes an outcome after the stop."""
    recorded_s: list[float] = []
    report: FlightVerdict | None = None
    fault_s = 0.0 if track.fault is None else track.fault.from_s
    with suppress(SourceError) if _hits_record(fault) else nullcontext():  # it may lie on a disk that is gone
        recorded_s = [m.t_ns / 1e9 for _, _, m in read_flight(rig.out) if isinstance(m, GpsInput)]
        report = verdict_of(rig.out, fault_s)
    if report is not None:
        spans = [Span(a + fault_s, b + fault_s, text) for a, b, text in report.untrusted]
        named = [Span(a + fault_s, b + fault_s, text) for a, b, text in report.refused]
        track = replace(track, untrusted=spans, refused=named)
        outcome = msgspec.structs.replace(
            outcome,
            report=report.text(),
            untrusted=[f"{a:.1f} to {b:.1f} s: {text}" for a, b, text in [*report.untrusted, *report.refused]],
            criteria=measured([track]),
        )
    outcome = msgspec.structs.replace(
        outcome,
        not_recorded_s=judge.not_recorded_s(rig.peer.received_s, recorded_s),
        stop_s=rig.stop_s,
    )
    lasting = outcome.verdict or judge.text_of(
        outcome,
        fix_expected=fault.origin is None and phase not in fault.no_fix_in,
        record_expected=not _hits_record(fault),
    )
    return msgspec.structs.replace(outcome, verdict=lasting)


def _hits_record(fault: Fault) -> bool:
    return fault.name.startswith(("recorder", "supervisor", "all processes", "disk"))


class Results:
    """The outcomes of a matrix in a file, so that it can be continued and several commands can fly parts of it."""

    def __init__(self, path: Path) -> None:
        """Raises SourceError for a file that is damaged."""
        self._path = path
        self.outcomes = self._read()

    def has(self, fault: Fault, phase: Phase) -> bool:
        """Whether the cell need not be flown: one in which the flight itself failed must be."""
        return any((o.fault, o.phase) == (fault.name, phase) and o.verdict != judge.NO_FIX for o in self.outcomes)

    def add(self, outcome: Outcome) -> None:
        """Adds it to those of the file, which another command may have written meanwhile. Raises SourceError,
        OutputError."""
        key = (outcome.fault, outcome.phase)
        try:
            with self._path.with_suffix(".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)  # held for milliseconds by another command
                self.outcomes = [*(o for o in self._read() if (o.fault, o.phase) != key), outcome]
                self._path.write_bytes(msgspec.json.format(msgspec.json.encode(self.outcomes), indent=1))
        except OSError as error:
            raise OutputError(f"{self._path}: cannot be written ({error.strerror})") from None

    def _read(self) -> list[Outcome]:
        try:
            data = self._path.read_bytes() if self._path.exists() else b"[]"
            return msgspec.json.decode(data, type=list[Outcome])
        except (OSError, msgspec.DecodeError) as error:
            raise SourceError(f"{self._path}: no results of chaos ({error}); give another --out") from None


def fly_matrix(
    scene: ChaosScene, cells: Iterable[tuple[Fault, Phase]], out: Path, results: Results, *, seed: int, model: Path
) -> Iterable[Outcome]:
    """Flies the cells that are not among the results, and yields their outcomes."""
    for fault, phase in cells:
        folder = out / f"{fault.name} {phase}".replace(":", "").replace(" ", "-")
        shutil.rmtree(folder, ignore_errors=True)
        try:
            outcome = fly_cell(scene, fault, phase, folder, seed=seed, model=model)
        except SourceError as error:
            outcome = Outcome(fault=fault.name, phase=phase, verdict=str(error).rpartition(": ")[2])
        results.add(outcome)
        yield outcome
