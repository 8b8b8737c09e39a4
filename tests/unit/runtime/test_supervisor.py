"""The supervisor with real processes: kills, hangs, bugs, user errors, and the ordered stop."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from runtime_nodes import TABLE, children_of
from terrafix import messages as m
from terrafix.core.config import Config, SmootherSection
from terrafix.core.errors import ConfigError, MapError, OutputError
from terrafix.processes import PROCESSES
from terrafix.runtime import run_dir, systemd
from terrafix.runtime.fork_server import ForkedProcess
from terrafix.runtime.managed_process import RESTART_LIMIT, RESTART_WINDOW_NS, RestartWindow, State, describe
from terrafix.runtime.supervisor import RunCallbacks, RunOptions, Supervisor, _configured, run

pytestmark = pytest.mark.real_time

RIGS = Path(__file__).resolve().parents[2] / "rigs"
FOREVER = 100_000  # frames


@pytest.fixture(autouse=True)
def children_find_the_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    existing = os.environ.get("PYTHONPATH")  # set when the source tree is not installed
    monkeypatch.setenv("PYTHONPATH", f"{RIGS}{os.pathsep}{existing}" if existing else str(RIGS))


class SupervisedRun:
    """A supervised run of the test table in a thread of this process."""

    def __init__(
        self, folder: Path, frames: int, *, link: str = "", stop_after_source: bool = False, more_config: str = ""
    ) -> None:
        self.out_dir = folder / "out"
        self.log = folder / "log.jsonl"
        self.events: list[m.ProcessEvent] = []
        self.code: int | None = None
        self._stop = threading.Event()
        config = folder / "test.toml"
        config.write_text(f"[link]\nbaud = {9600 + frames}\n{more_config}")
        self._thread = threading.Thread(target=self._run, args=(config, link, stop_after_source))
        self._thread.start()

    def _run(self, config: Path, link: str, stop_after_source: bool) -> None:
        self.code = run(
            RunOptions(
                link=link,
                out_dir=self.out_dir,
                configs=[config],
                stop_after_source=stop_after_source,
                log_to=self.log,
            ),
            RunCallbacks(on_event=self.events.append),
            stop=self._stop,
            table=TABLE,
        )

    def recorded(self) -> list[m.Message]:
        """The messages that the recorder has written so far, without a partial last line."""
        path = self.out_dir / "received.jsonl"
        return (
            [msgspec.json.decode(line, type=m.AnyMessage) for line in path.read_bytes().split(b"\n")[:-1]]
            if path.exists()
            else []
        )

    def pid(self, process: str) -> int:
        started = [e for e in self.events if e.process == process and e.event in ("started", "restarted")]
        return int(started[-1].detail.removeprefix("pid "))

    def verdicts_of(self, pid: int) -> list[m.MeasurementVerdict]:
        verdicts = (e for e in self.recorded() if isinstance(e, m.MeasurementVerdict))
        return [v for v in verdicts if v.detail.startswith(f"pid {pid} ")]

    def names(self, process: str) -> list[str]:
        return [e.event for e in self.events if e.process == process]

    def all_started(self) -> None:
        eventually(lambda: len([e for e in self.events if e.event == "started"]) == len(TABLE), within_s=10)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(30)

    def wait(self, within_s: float) -> None:
        self._thread.join(within_s)
        assert not self._thread.is_alive(), "the run did not end by itself"


@contextmanager
def flight(folder: Path, frames: int = FOREVER, **options: object) -> Iterator[SupervisedRun]:
    running = SupervisedRun(folder, frames, **options)  # type: ignore[arg-type]
    try:
        yield running
    finally:
        running.stop()


def eventually(look: Callable[[], object], within_s: float) -> None:
    until = time.monotonic() + within_s
    while not look():
        assert time.monotonic() < until, f"did not happen within {within_s} s"
        time.sleep(0.01)


def test_a_recorded_source_runs_to_its_end_without_loss_of_messages(tmp_path: Path) -> None:
    with flight(tmp_path, frames=30, stop_after_source=True) as f:
        f.wait(within_s=20)
    assert f.code == 0
    recorded = f.recorded()
    assert [e.frame_id for e in recorded if isinstance(e, m.Frame)] == list(range(30))
    verdicts = [e for e in recorded if isinstance(e, m.MeasurementVerdict)]
    assert [v.frame_id for v in verdicts] == list(range(30))
    assert {v.verdict for v in verdicts} == {m.Verdict.ACCEPTED}, "all have the origin and the correct pixels"
    assert not [e for e in recorded if isinstance(e, m.Dropped)]

    lines = [json.loads(line) for line in f.log.read_text().splitlines()]
    steps = [(line["process"], line["level"], line["step"]) for line in lines if line["event"] == "search step"]
    assert steps == [("estimator", "warning", "widen")], "published messages of interest are logged once"

    assert [e.process for e in f.events if e.event == "started"] == [p.name for p in TABLE]
    stopped = [e for e in f.events if e.event == "stopped"]
    assert [e.process for e in stopped] == [p.name for p in reversed(TABLE)]
    assert {e.detail for e in stopped} == {"exit code 0"}
    events = [(e.process, e.event) for e in recorded if isinstance(e, m.ProcessEvent)]
    assert ("recorder", "started") in events, "events before the subscription of the recorder are retained"
    assert ("link", "stopped") in events, "the recorder receives the last messages of all processes"


def test_killed_and_crashed_processes_restart_within_two_seconds_and_receive_the_origin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TROUBLE", "bug")  # in the estimator, once
    with flight(tmp_path) as f:
        eventually(lambda: "restarted" in f.names("estimator"), 15)
        eventually(lambda: f.verdicts_of(f.pid("estimator")), 2)
        assert "ZeroDivisionError: a bug for the test" in f.log.read_text()
        for name in ("estimator", "link", "recorder"):
            pid, killed = f.pid(name), time.monotonic()
            os.kill(pid, signal.SIGKILL)
            eventually(lambda n=name, p=pid: f.pid(n) != p, 2.0)
            if name == "estimator":
                eventually(lambda: f.verdicts_of(f.pid("estimator")), 2.0 - (time.monotonic() - killed))
                first = f.verdicts_of(f.pid("estimator"))[0]
                assert first.verdict is m.Verdict.ACCEPTED, f"retained Origin before the first frame: {first.detail}"
        before, pid, lines = f.pid("estimator"), f.pid("vision"), len(f.recorded())
        eventually(lambda: len(f.recorded()) > lines, 5)  # the recorder is running again, and its file is checked
        os.kill(pid, signal.SIGKILL)
        eventually(lambda: f.pid("vision") != pid, 2.0)
        count = len(f.verdicts_of(before))
        eventually(lambda: len(f.verdicts_of(before)) > count + 5, 5)
        assert f.verdicts_of(before)[-1].verdict is m.Verdict.ACCEPTED, "the frame ring outlives its writer"
    assert f.code == 0
    origins = [e for e in f.recorded() if isinstance(e, m.Origin)]
    assert len(origins) >= 2 and len({o.t_ns for o in origins}) == 1, "a restarted source keeps its time axis"
    for name in ("link", "recorder", "vision"):
        assert f.names(name) == ["started", "died", "restarted", "stopped"]
    assert f.names("estimator") == ["started", "died", "restarted", "died", "restarted", "stopped"]
    assert {e.detail for e in f.events if e.event == "died"} == {"exit code 1", "killed by SIGKILL"}


def test_a_stuck_process_prints_a_traceback_and_is_restarted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROUBLE", "stuck")
    with flight(tmp_path) as f:
        eventually(lambda: "restarted" in f.names("estimator"), 15)
        eventually(lambda: f.verdicts_of(f.pid("estimator")), 3)
    assert f.names("estimator") == ["started", "stuck", "restarted", "stopped"]
    assert "_maybe_trouble" in f.log.read_text()
    assert f.names("link") == ["started", "stopped"]


def test_a_user_error_gives_one_line_and_its_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with flight(tmp_path, link="broken") as f:
        f.wait(within_s=10)
    assert f.code == 7
    assert capsys.readouterr().err == "terrafix: broken: no such device; check --link\n"
    assert all(line.startswith("{") for line in f.log.read_text().splitlines()), "no traceback"


@pytest.mark.slow
@pytest.mark.parametrize(("ill", "code"), [("estimator", 0), ("link", 1)])
def test_only_the_failure_of_the_link_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ill: str, code: int
) -> None:
    monkeypatch.setenv("TROUBLE", f"{ill} always")
    with flight(tmp_path) as f:
        eventually(lambda: "gave_up" in f.names(ill), 30)
        if ill == "link":
            f.wait(within_s=20)
        else:
            count = len(f.recorded())
            eventually(lambda: sum(isinstance(e, m.Frame) for e in f.recorded()[count:]) > 5, 10)
    assert f.code == code
    assert f.names(ill) == ["started", *["died", "restarted"] * RESTART_LIMIT, "died", "gave_up"]


RUNNER = """
import os, sys
from pathlib import Path
from runtime_nodes import TABLE
from terrafix.runtime.supervisor import RunOptions, run
source = os.environ.get("SOURCE", "")
sys.exit(run(RunOptions(source=source, out_dir=Path(sys.argv[1])), table=TABLE))
"""


@contextmanager
def supervisor_process(out_dir: Path, **environment: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", RUNNER, str(out_dir)]
    environment = {**os.environ, **environment}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            yield process
        finally:
            process.kill()


def started(process: "subprocess.Popen[str]") -> dict[str, int]:
    """-> ``children_of`` a supervisor, when it has all processes of the table."""
    eventually(lambda: {p.name for p in TABLE} <= set(children_of(process.pid)), 15)
    return children_of(process.pid)


def is_gone(pid: int) -> bool:
    """Whether the process has ended; it may still be a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.slow
def test_systemd_receives_ready_watchdog_and_stopping_and_sigterm_stops_in_order(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as received:
        received.bind(str(tmp_path / "notify"))
        received.settimeout(15)
        with supervisor_process(tmp_path / "out", NOTIFY_SOCKET=str(tmp_path / "notify")) as process:
            assert received.recv(1000) == b"READY=1"
            for _ in range(3):
                assert received.recv(1000).startswith(b"WATCHDOG=1\nSTATUS=flying")
            for pid in children_of(process.pid).values():
                assert b"NOTIFY_SOCKET" not in Path(f"/proc/{pid}/environ").read_bytes()
            process.send_signal(signal.SIGTERM)
            assert process.wait(15) == 0
            rest = []
            received.settimeout(0.1)
            with pytest.raises(TimeoutError):
                while True:
                    rest.append(received.recv(1000))
            assert rest[-1] == b"STOPPING=1"


def test_the_watchdog_is_triggered_only_while_the_link_makes_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[str] = []
    monkeypatch.setattr(systemd, "notify", sent.append)
    stamps = {"link": 9_500_000_000, "vision": 0}

    def child(name: str) -> Any:
        process = SimpleNamespace(name=name, stuck_after_s=1.0)
        progress = SimpleNamespace(stamp_ns=stamps[name])
        return SimpleNamespace(process=process, progress=progress, state=State.RUNNING, settled=True)

    def triggered(now_ns: int) -> list[str]:
        sent.clear()
        unused: Any = None
        supervisor = Supervisor([child("link"), child("vision")], unused, unused, lambda: False, False, None)
        supervisor._notify(now_ns + 10**15)  # due, whatever the clock of this computer
        return [text for text in sent if text.startswith("WATCHDOG=1")]

    stamps["link"] += 10**15
    assert triggered(10_000_000_000) == ["WATCHDOG=1\nSTATUS=flying"], "the link stamped half a second ago"
    assert triggered(10_600_000_000) == [], "1.1 s ago"


def test_processes_of_a_killed_supervisor_fly_on_and_the_next_one_adopts_restarts_and_stops_them(
    tmp_path: Path,
) -> None:
    names = {p.name for p in TABLE}
    pids: dict[str, int] = {}
    record = tmp_path / "out" / "received.jsonl"

    def adopted() -> list[str]:
        events = (msgspec.json.decode(line, type=m.AnyMessage) for line in record.read_bytes().split(b"\n")[:-1])
        return [e.process for e in events if isinstance(e, m.ProcessEvent) and e.event == "adopted"]

    others = {run.path for run in run_dir.live_runs()}
    try:
        with supervisor_process(tmp_path / "out") as process:
            pids = {name: pid for name, pid in started(process).items() if name in names}
            (folder,) = (run for run in run_dir.live_runs() if run.path not in others)
            eventually(folder.was_alive_recently, 15)
            process.kill()
        assert not any(is_gone(pid) for pid in pids.values())
        with supervisor_process(tmp_path / "out") as process:
            eventually(lambda: sorted(adopted()) == sorted(names), 15)
            os.kill(pids["estimator"], signal.SIGKILL)
            eventually(lambda: "estimator" in children_of(process.pid), 5)
            assert not any(is_gone(pids[name]) for name in names - {"estimator"})
            assert names & set(children_of(process.pid)) == {"estimator"}, "the others have not been started again"
            process.send_signal(signal.SIGTERM)
            assert process.wait(15) == 0
        assert all(is_gone(pid) for pid in pids.values())
        assert not folder.path.exists()
    finally:
        for pid in pids.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def test_processes_of_a_recorded_source_end_with_a_killed_supervisor_and_its_folder_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = {run.path for run in run_dir.live_runs()}
    with supervisor_process(tmp_path / "out", SOURCE=str(tmp_path)) as process:
        children = started(process)
        (folder,) = {run.path for run in run_dir.live_runs()} - others
        eventually(run_dir.RunDir(folder).was_alive_recently, 15)
        process.kill()
        eventually(lambda: all(is_gone(pid) for pid in children.values()), 2)
    run_dir.OwnedRunDir().remove()
    assert folder.exists(), "the folder is kept for a supervisor that resumes the run"
    monkeypatch.setattr(run_dir, "SAME_FLIGHT_NS", 0)
    running = run_dir.OwnedRunDir()
    assert not folder.exists(), "the next supervisor removes a stale folder"
    run_dir.OwnedRunDir().remove()
    assert running.run_dir.path.exists(), "the folder of a running supervisor is kept"
    running.remove()
    assert not running.run_dir.path.exists()


def test_simultaneous_signals_do_not_deadlock(tmp_path: Path) -> None:
    with supervisor_process(tmp_path / "out") as process:
        started(process)
        until_s = time.monotonic() + 0.5
        while time.monotonic() < until_s and process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGTERM)
        process.wait(15)


def test_a_killed_fork_server_ends_no_process_and_is_restarted_at_the_next_request(tmp_path: Path) -> None:
    names = {p.name for p in TABLE}
    with supervisor_process(tmp_path / "out") as process:
        before = started(process)
        (fork_server,) = (pid for name, pid in before.items() if name not in names)
        os.kill(fork_server, signal.SIGKILL)
        os.kill(before["estimator"], signal.SIGKILL)
        eventually(lambda: children_of(process.pid).get("estimator", before["estimator"]) != before["estimator"], 5)
        after = children_of(process.pid)
        assert {name: after[name] for name in names - {"estimator"}} == {n: before[n] for n in names - {"estimator"}}
        process.send_signal(signal.SIGTERM)
        assert process.wait(15) == 0
    assert all(is_gone(pid) for pid in {*before.values(), *after.values()})


def test_waiting_for_a_forked_process_times_out_and_termination_gives_its_exit_code() -> None:
    asleep = ForkedProcess(os.posix_spawn("/bin/sleep", ["sleep", "30"], os.environ))
    assert asleep.poll() is None
    with pytest.raises(TimeoutError):
        asleep.wait(0.05)
    asleep.terminate()
    assert asleep.wait(5.0) == -signal.SIGTERM
    asleep.kill()  # the pid may be reused by now
    assert asleep.poll() == -signal.SIGTERM


def test_restart_pauses_increase_until_the_process_is_given_up() -> None:
    window = RestartWindow()
    pauses = [window.record_death(i * 10**9) for i in range(RESTART_LIMIT + 1)]
    assert pauses[0] == 0, "the first restart is immediate"
    assert pauses[-1] is None
    assert sorted(p for p in pauses if p is not None) == [p for p in pauses if p is not None]
    assert window.record_death(2 * RESTART_WINDOW_NS) == 0, "deaths before the window do not count"


def test_configuration_map_and_output_folder_are_checked_before_any_start(tmp_path: Path) -> None:
    def attempt(**changes: object) -> None:
        run(RunOptions(**({"out_dir": tmp_path / "out"} | changes)), table=TABLE)  # type: ignore[arg-type]

    (tmp_path / "file").write_text("II*\0")
    with pytest.raises(OutputError, match=r"file/out: cannot be written .* another folder with --out"):
        attempt(out_dir=tmp_path / "file" / "out")
    with pytest.raises(MapError, match=r"none\.gpkg: map cannot be read \(No such file or directory\)"):
        attempt(map_path=tmp_path / "none.gpkg")
    with pytest.raises(MapError, match="not a map package; make one with 'terrafix map build"):
        attempt(map_path=tmp_path / "file")
    with pytest.raises(ConfigError, match="no such configuration file"):
        attempt(configs=[tmp_path / "none.toml"])


def test_exit_codes_are_described_as_text() -> None:
    assert describe(-9) == "killed by SIGKILL"
    assert describe(-64) == "killed by SIGRTMAX"
    assert describe(3) == "exit code 3"


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="a budget below one core cannot be shown on one core")
def test_all_processes_keep_to_the_cores_of_the_budget(tmp_path: Path) -> None:
    first = min(os.sched_getaffinity(0))
    with flight(tmp_path, more_config="[runtime]\ncores = 1\n") as f:
        f.all_started()
        eventually(lambda: all(os.sched_getaffinity(f.pid(process.name)) == {first} for process in TABLE), within_s=10)


def priorities(f: SupervisedRun, own: int) -> dict[str, int]:
    return {p.name: os.getpriority(os.PRIO_PROCESS, f.pid(p.name)) - own for p in TABLE}


def test_a_process_has_the_priority_of_the_table(tmp_path: Path) -> None:
    own = os.getpriority(os.PRIO_PROCESS, 0)
    with flight(tmp_path) as f:
        f.all_started()
        eventually(lambda: priorities(f, own) == {"recorder": 0, "link": 0, "estimator": 3, "vision": 0}, within_s=10)


def test_a_smoother_that_is_switched_off_is_no_process() -> None:
    names = [process.name for process in _configured(PROCESSES, Config())]
    without = _configured(PROCESSES, Config(smoother=SmootherSection(enabled=False)))
    assert names == [process.name for process in PROCESSES]
    assert [process.name for process in without] == [name for name in names if name != "smoother"]


def test_estimates_and_the_link_come_before_map_matches_and_these_before_the_smoother() -> None:
    nice = {process.name: process.nice for process in PROCESSES}
    assert nice["link"] == nice["estimator"] == nice["vision"] == 0 < nice["anchor"] < nice["smoother"]
