"""The supervisor with real processes: kills, hangs, bugs, mistakes, and the ordered stop."""

import contextlib
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

import pytest

from runtime_nodes import TABLE
from terrafix import messages as m
from terrafix.core.codec import decode_json
from terrafix.core.errors import ConfigError, MapError, OutputError
from terrafix.runtime import run_dir
from terrafix.runtime.fork_server import Forked
from terrafix.runtime.managed_process import RESTART_LIMIT, RESTART_WINDOW_NS, RestartWindow, describe
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.supervisor import run, sd_notify

pytestmark = pytest.mark.real_time

RIGS = Path(__file__).resolve().parents[2] / "rigs"
FOREVER = 100_000  # frames


@pytest.fixture(autouse=True)
def children_find_the_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    also = os.environ.get("PYTHONPATH")  # of a tree that is not installed
    monkeypatch.setenv("PYTHONPATH", f"{RIGS}{os.pathsep}{also}" if also else str(RIGS))


class Flight:
    """A supervised run of the test table in a thread of this process."""

    def __init__(self, folder: Path, frames: int, *, link: str = "", stop_after_source: bool = False) -> None:
        self.out_dir = folder / "out"
        self.log = folder / "log.jsonl"
        self.events: list[m.ProcessEvent] = []
        self.code: int | None = None
        self._stop = threading.Event()
        config = folder / "test.toml"
        config.write_text(f"[link]\nbaud = {9600 + frames}\n")
        self._thread = threading.Thread(target=self._run, args=(config, link, stop_after_source))
        self._thread.start()

    def _run(self, config: Path, link: str, stop_after_source: bool) -> None:
        self.code = run(
            source="",
            map_path=None,
            link=link,
            out_dir=self.out_dir,
            configs=[config],
            stop_after_source=stop_after_source,
            on_event=self.events.append,
            stop=self._stop,
            log_to=self.log,
            table=TABLE,
        )

    def heard(self) -> list[m.Message]:
        """What the recorder has written so far, less a line that is just being written."""
        path = self.out_dir / "heard.jsonl"
        return [decode_json(line) for line in path.read_bytes().split(b"\n")[:-1]] if path.exists() else []

    def pid(self, process: str) -> int:
        started = [e for e in self.events if e.process == process and e.event in ("started", "restarted")]
        return int(started[-1].detail.removeprefix("pid "))

    def verdicts_of(self, pid: int) -> list[m.MeasurementVerdict]:
        said = (e for e in self.heard() if isinstance(e, m.MeasurementVerdict))
        return [v for v in said if v.detail.startswith(f"pid {pid} ")]

    def names(self, process: str) -> list[str]:
        return [e.event for e in self.events if e.process == process]

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(30)

    def wait(self, within_s: float) -> None:
        self._thread.join(within_s)
        assert not self._thread.is_alive(), "the run did not end by itself"


@contextmanager
def flight(folder: Path, frames: int = FOREVER, **options: object) -> Iterator[Flight]:
    running = Flight(folder, frames, **options)  # type: ignore[arg-type]
    try:
        yield running
    finally:
        running.stop()


def eventually(look: Callable[[], object], within_s: float) -> None:
    until = time.monotonic() + within_s
    while not look():
        assert time.monotonic() < until, f"did not happen within {within_s} s"
        time.sleep(0.01)


def test_a_recorded_source_runs_to_its_end_and_nothing_is_lost(tmp_path: Path) -> None:
    with flight(tmp_path, frames=30, stop_after_source=True) as f:
        f.wait(within_s=20)
    assert f.code == 0
    heard = f.heard()
    assert [e.frame_id for e in heard if isinstance(e, m.Frame)] == list(range(30))
    verdicts = [e for e in heard if isinstance(e, m.MeasurementVerdict)]
    assert [v.frame_id for v in verdicts] == list(range(30))
    assert {v.verdict for v in verdicts} == {m.Verdict.ACCEPTED}, "all knew the origin and saw the right pixels"
    assert not [e for e in heard if isinstance(e, m.Dropped)]

    assert [e.process for e in f.events if e.event == "started"] == [p.name for p in TABLE]
    stopped = [e for e in f.events if e.event == "stopped"]
    assert [e.process for e in stopped] == [p.name for p in reversed(TABLE)]
    assert {e.detail for e in stopped} == {"exit code 0"}
    recorded = [(e.process, e.event) for e in heard if isinstance(e, m.ProcessEvent)]
    assert ("recorder", "started") in recorded, "what happened before the recorder listened is said to it again"
    assert ("link", "stopped") in recorded, "the recorder hears the last word of everybody"


def test_killed_and_broken_children_are_back_within_two_seconds_and_know_the_origin(
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
                assert first.verdict is m.Verdict.ACCEPTED, f"Origin came again before the first frame: {first.detail}"
        before, pid, lines = f.pid("estimator"), f.pid("vision"), len(f.heard())
        eventually(lambda: len(f.heard()) > lines, 5)  # the recorder is back: it is our witness
        os.kill(pid, signal.SIGKILL)
        eventually(lambda: f.pid("vision") != pid, 2.0)
        count = len(f.verdicts_of(before))
        eventually(lambda: len(f.verdicts_of(before)) > count + 5, 5)
        assert f.verdicts_of(before)[-1].verdict is m.Verdict.ACCEPTED, "the frame ring outlives its writer"
    assert f.code == 0
    origins = [e for e in f.heard() if isinstance(e, m.Origin)]
    assert len(origins) >= 2 and len({o.t_ns for o in origins}) == 1, "a restarted source goes on on the same time"
    for name in ("link", "recorder", "vision"):
        assert f.names(name) == ["started", "died", "restarted", "stopped"]
    assert f.names("estimator") == ["started", "died", "restarted", "died", "restarted", "stopped"]
    assert {e.detail for e in f.events if e.event == "died"} == {"exit code 1", "killed by SIGKILL"}


def test_a_stuck_child_is_noticed_says_where_and_is_restarted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROUBLE", "stuck")
    with flight(tmp_path) as f:
        eventually(lambda: "restarted" in f.names("estimator"), 15)
        eventually(lambda: f.verdicts_of(f.pid("estimator")), 3)
    assert f.names("estimator") == ["started", "stuck", "restarted", "stopped"]
    assert "_maybe_trouble" in f.log.read_text()
    assert f.names("link") == ["started", "stopped"]


def test_a_mistake_of_the_user_is_one_line_and_its_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with flight(tmp_path, link="broken") as f:
        f.wait(within_s=10)
    assert f.code == 7
    assert capsys.readouterr().err == "terrafix: broken: no such device; check --link\n"
    assert all(line.startswith("{") for line in f.log.read_text().splitlines()), "no traceback"


@pytest.mark.slow
@pytest.mark.parametrize(("ill", "code"), [("estimator", 0), ("link", 1)])
def test_only_a_link_that_gives_up_ends_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ill: str, code: int
) -> None:
    monkeypatch.setenv("TROUBLE", f"{ill} always")
    with flight(tmp_path) as f:
        eventually(lambda: "gave_up" in f.names(ill), 30)
        if ill == "link":
            f.wait(within_s=20)
        else:
            count = len(f.heard())
            eventually(lambda: sum(isinstance(e, m.Frame) for e in f.heard()[count:]) > 5, 10)
    assert f.code == code
    assert f.names(ill) == ["started", *["died", "restarted"] * RESTART_LIMIT, "died", "gave_up"]


RUNNER = """
import sys
from pathlib import Path
from runtime_nodes import TABLE
from terrafix.runtime.supervisor import run
sys.exit(run(source="", map_path=None, link="", out_dir=Path(sys.argv[1]), configs=[], table=TABLE))
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


def children_of(pid: int) -> dict[str, int]:
    """Name, as `ps` shows it -> pid; the fork_server has that of the interpreter."""
    found = {}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        with contextlib.suppress(FileNotFoundError):  # ended meanwhile
            found[Path(f"/proc/{child}/comm").read_text().strip()] = int(child)
    return found


def is_gone(pid: int) -> bool:
    """Gone, or a zombie that only waits to be reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_systemd_hears_ready_watchdog_and_stopping_and_sigterm_stops_in_order(tmp_path: Path) -> None:
    others = {run.path for run in run_dir.living()}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(15)
        with supervisor_process(tmp_path / "out", NOTIFY_SOCKET=str(tmp_path / "notify")) as process:
            assert systemd.recv(1000) == b"READY=1"
            assert systemd.recv(1000).startswith(b"WATCHDOG=1\nSTATUS=flying")
            for pid in children_of(process.pid).values():
                assert b"NOTIFY_SOCKET" not in Path(f"/proc/{pid}/environ").read_bytes()
            (folder,) = (run for run in run_dir.living() if run.path not in others)
            progress = Progress(folder.progress("link"))
            systemd.settimeout(0.05)
            heard_s = began_s = time.monotonic()
            stopped: set[int] = set()
            while time.monotonic() - heard_s < 1.2:  # WATCHDOG comes every 0.5 s, a traceback holds it up by 0.2 s
                assert time.monotonic() - began_s < 10.0, "fed while no link makes progress"
                link = children_of(process.pid).get("link")
                # Alive and not making progress, and the next one, too; one that is not ready yet is given longer.
                if link is not None and link not in stopped and progress.stamp_ns:
                    os.kill(link, signal.SIGSTOP)
                    stopped.add(link)
                with contextlib.suppress(TimeoutError):
                    systemd.recv(1000)
                    heard_s = time.monotonic()
            progress.close()
            systemd.settimeout(15)
            assert systemd.recv(1000).startswith(b"WATCHDOG=1"), "fed again after the stuck links were restarted"
            process.send_signal(signal.SIGTERM)
            assert process.wait(15) == 0
            rest = []
            systemd.settimeout(0.1)
            with pytest.raises(TimeoutError):
                while True:
                    rest.append(systemd.recv(1000))
            assert rest[-1] == b"STOPPING=1"


def test_children_die_with_a_killed_supervisor_and_its_leftovers_are_swept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = {run.path for run in run_dir.living()}
    with supervisor_process(tmp_path / "out") as process:
        eventually(lambda: {p.name for p in TABLE} <= set(children_of(process.pid)), 15)
        children = children_of(process.pid)
        (folder,) = {run.path for run in run_dir.living()} - others
        eventually(run_dir.RunDir(folder).flew_just_now, 15)
        process.kill()
        eventually(lambda: all(is_gone(pid) for pid in children.values()), 2)
    run_dir.OwnedRunDir().remove()
    assert folder.exists(), "the one that goes on from there is still to come"
    monkeypatch.setattr(run_dir, "SAME_FLIGHT_NS", 0)
    living = run_dir.OwnedRunDir()
    assert not folder.exists(), "the next start removes what the killed one left"
    run_dir.OwnedRunDir().remove()
    assert living.run_dir.path.exists(), "the folder of a living supervisor stays"
    living.remove()
    assert not living.run_dir.path.exists()


def test_signals_that_come_together_do_not_wait_for_each_other(tmp_path: Path) -> None:
    with supervisor_process(tmp_path / "out") as process:
        eventually(lambda: {p.name for p in TABLE} <= set(children_of(process.pid)), 15)
        until_s = time.monotonic() + 0.5
        while time.monotonic() < until_s and process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGTERM)
        process.wait(15)


def test_a_nursery_that_dies_takes_nobody_with_it_and_another_is_there_when_it_is_wanted(tmp_path: Path) -> None:
    names = {p.name for p in TABLE}
    with supervisor_process(tmp_path / "out") as process:
        eventually(lambda: names <= set(children_of(process.pid)), 15)
        before = children_of(process.pid)
        (fork_server,) = (pid for name, pid in before.items() if name not in names)
        os.kill(fork_server, signal.SIGKILL)
        os.kill(before["estimator"], signal.SIGKILL)
        eventually(lambda: children_of(process.pid).get("estimator", before["estimator"]) != before["estimator"], 5)
        after = children_of(process.pid)
        assert {name: after[name] for name in names - {"estimator"}} == {n: before[n] for n in names - {"estimator"}}
        process.send_signal(signal.SIGTERM)
        assert process.wait(15) == 0
    assert all(is_gone(pid) for pid in {*before.values(), *after.values()})


def test_who_was_forked_is_waited_for_no_longer_than_wanted_and_ended() -> None:
    asleep = Forked(os.posix_spawn("/bin/sleep", ["sleep", "30"], os.environ))
    assert asleep.poll() is None
    with pytest.raises(TimeoutError):
        asleep.wait(0.05)
    asleep.terminate()
    assert asleep.wait(5.0) == -signal.SIGTERM
    asleep.kill()  # its number may be another's by now
    assert asleep.poll() == -signal.SIGTERM


def test_restart_window_pauses_longer_and_gives_up() -> None:
    window = RestartWindow()
    pauses = [window.died(i * 10**9) for i in range(RESTART_LIMIT + 1)]
    assert pauses[0] == 0, "the first restart is immediate"
    assert pauses[-1] is None
    assert sorted(p for p in pauses if p is not None) == [p for p in pauses if p is not None]
    assert window.died(2 * RESTART_WINDOW_NS) == 0, "old deaths are forgotten"


def test_what_can_be_checked_is_checked_before_anything_starts(tmp_path: Path) -> None:
    def attempt(**changes: object) -> None:
        arguments = {"source": "", "map_path": None, "link": "", "out_dir": tmp_path / "out", "configs": []}
        run(**(arguments | changes), table=TABLE)  # type: ignore[arg-type]

    (tmp_path / "file").write_text("II*\0")
    with pytest.raises(OutputError, match=r"file/out: cannot be written .* another folder with --out"):
        attempt(out_dir=tmp_path / "file" / "out")
    with pytest.raises(MapError, match=r"none\.gpkg: map cannot be read \(No such file or directory\)"):
        attempt(map_path=tmp_path / "none.gpkg")
    with pytest.raises(MapError, match="not a map package; make one with 'terrafix map build"):
        attempt(map_path=tmp_path / "file")
    with pytest.raises(ConfigError, match="no such configuration file"):
        attempt(configs=[tmp_path / "none.toml"])


def test_exit_codes_in_words() -> None:
    assert describe(-9) == "killed by SIGKILL"
    assert describe(-64) == "killed by SIGRTMAX"
    assert describe(3) == "exit code 3"


def test_sd_notify_without_systemd_does_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    sd_notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    sd_notify("READY=1")
