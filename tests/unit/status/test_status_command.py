"""`terrafix status` beside running processes."""

import io
import json
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import zmq
from typer.testing import CliRunner

from flight_records import gps_input
from terrafix.core.errors import LinkError, UsageError
from terrafix.messages import InputOrder, Message, Origin, ProcessEvent
from terrafix.processes import PROCESSES, SUPERVISOR
from terrafix.runtime import run_dir
from terrafix.runtime.bus import Publisher
from terrafix.runtime.observer import COUNTED, Observer
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import OwnedRunDir, RunDir
from terrafix_tools.cli import app
from terrafix_tools.run_choice import chosen_run
from terrafix_tools.status import watch
from terrafix_tools.status.line import RunLine
from terrafix_tools.status.processes import process_states
from terrafix_tools.status.state import KINDS

pytestmark = pytest.mark.real_time
S = 1_000_000_000  # ns


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunDir]:
    monkeypatch.setattr(run_dir, "SHM", tmp_path)
    owned = OwnedRunDir(spec=b"{}")
    yield owned.run_dir
    owned.remove()


class Publishing:
    """Publishes ``messages`` of each process again and again."""

    def __init__(self, run: RunDir, messages: dict[str, Message]) -> None:
        self._run, self._messages = run, messages
        self._stop = threading.Event()
        self.counted = 0
        self._thread = threading.Thread(target=self._live)
        self._thread.start()

    def _live(self) -> None:
        with zmq.Context() as context:
            publishers = {name: Publisher(context, self._run.address(name)) for name in self._messages}
            while not self._stop.wait(0.02):
                for name, message in self._messages.items():
                    publishers[name].publish(message)
            self.counted = sum(p.subscriptions(kind) for p in publishers.values() for kind in COUNTED)
            for publisher in publishers.values():
                publisher.close()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


def test_the_command_prints_what_the_processes_publish_and_is_not_counted_as_the_recorder(
    run: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch, "look", partial(watch.look, seconds=1.0))
    died = ProcessEvent(t_ns=0, process="vision", event="died", detail="killed by signal 9")
    flying = Publishing(run, {"link": gps_input(S), SUPERVISOR: died})
    Progress.create(run.progress("vision")).close()
    try:
        done = CliRunner().invoke(app, ["status", "--json"])
    finally:
        flying.stop()
    assert done.exit_code == 0, done.output
    found = json.loads(done.output)
    assert found["position"]["fix"] == "3D"
    assert found["processes"] == [
        {
            "name": "vision",
            "state": "starting",
            "idle_s": None,
            "load": None,
            "restarts": 0,
            "last_event": "died: killed by signal 9",
        }
    ]
    assert flying.counted == 0


def test_states_of_processes_by_their_progress_and_by_the_supervisor(run: RunDir) -> None:
    slowest = {p.name: p.stuck_after_s for p in PROCESSES}
    for name, stamp_s in (("vision", 100.0), ("anchor", 100.0), ("link", None), ("estimator", 100.0)):
        progress = Progress.create(run.progress(name))
        if stamp_s is not None:
            progress.stamp(round(stamp_s * S))
        progress.close()
    run.gave_up("estimator").touch()
    now_s = 100.0 + slowest["vision"] + 1.0
    states = {state.name: (state.state, state.idle_s) for state in process_states(run, round(now_s * S))}
    assert states == {
        "vision": ("stuck", slowest["vision"] + 1.0),
        "anchor": ("running", slowest["vision"] + 1.0),
        "link": ("starting", None),
        "estimator": ("given up", slowest["vision"] + 1.0),
    }


def test_an_observer_does_not_subscribe_to_what_processes_count() -> None:
    assert set(COUNTED) == {InputOrder, Origin}
    assert not set(KINDS) & set(COUNTED)
    with pytest.raises(AssertionError):
        Observer(RunDir(Path("/nowhere")), (Origin,), PROCESSES)


def test_without_a_running_terrafix_one_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir, "SHM", tmp_path)
    with pytest.raises(LinkError, match="does not run on this computer"):
        chosen_run("")
    with pytest.raises(UsageError, match="no such folder"):
        chosen_run(str(tmp_path / "none"))


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_run_prints_a_line_a_second_in_a_terminal_and_none_elsewhere(run: RunDir) -> None:
    flying = Publishing(run, {"link": gps_input(S)})
    Progress.create(run.progress("vision")).close()
    terminal, file = Terminal(), io.StringIO()
    try:
        with RunLine(terminal) as shown, RunLine(file) as hidden:
            shown.start(run)
            hidden.start(run)
            until_s = time.monotonic() + 10.0
            while "3D fix" not in terminal.getvalue() and time.monotonic() < until_s:
                time.sleep(0.05)
    finally:
        flying.stop()
    assert "3D fix to" in terminal.getvalue().splitlines()[-1] and "no autopilot" in terminal.getvalue()
    assert file.getvalue() == ""
