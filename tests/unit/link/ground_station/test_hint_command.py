"""`terrafix hint`: from the command line over the bus to the processes of the run, and their reply."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from terrafix.core.errors import LinkError, UsageError
from terrafix.messages import HintVerdict, PositionHint, Verdict
from terrafix.processes import OPERATOR
from terrafix.runtime import run_dir
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.run_dir import OwnedRunDir, RunDir, live_runs
from terrafix_tools.hint import send
from terrafix_tools.hint.send import SUBSCRIBERS, hint

pytestmark = pytest.mark.real_time


class HintListeners:
    """Stands for the processes that hear a hint; the anchor among them answers with ``verdict``."""

    def __init__(self, run: RunDir, verdict: Verdict | None) -> None:
        self._run, self._verdict = run, verdict
        self.hints: list[PositionHint] = []
        self._stop, self._ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()
        self._ready.wait(5.0)

    def _live(self) -> None:
        with zmq.Context() as context:
            says = Publisher(context, self._run.address("anchor"))
            hears = [Subscriber(context, [self._run.address(OPERATOR)], (PositionHint,)) for _ in SUBSCRIBERS]
            self._ready.set()
            while not self._stop.is_set():
                says.serve()
                for i, subscriber in enumerate(hears):
                    subscriber.socket.poll(5)
                    for message in subscriber.receive():
                        if i == 0 and isinstance(message, PositionHint):
                            self.hints.append(message)
                            self._answer(says, message)
            for socket in (says, *hears):
                socket.close()

    def _answer(self, says: Publisher, hint: PositionHint) -> None:
        for of in (hint.t_ns - 1, hint.t_ns):  # the first one answers somebody else
            if self._verdict is not None:
                text = "hint not used, 12 km from the estimate" if of == hint.t_ns else "of another"
                says.publish(
                    HintVerdict(t_ns=of, hint_t_ns=of, verdict=self._verdict, distance_m=1.0, sigma_m=1.0, text=text)
                )

    def land(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunDir]:
    monkeypatch.setattr(run_dir, "SHM", tmp_path)
    owned = OwnedRunDir()
    yield owned.run_dir
    owned.remove()


@pytest.mark.parametrize("verdict", [Verdict.ACCEPTED, Verdict.INNOVATION])
def test_a_hint_arrives_and_its_own_answer_comes_back(run: RunDir, verdict: Verdict) -> None:
    flying = HintListeners(run, verdict)
    try:
        assert hint(48.1, -11.5, 3000.0, fix=(7, 5.5)) == "hint not used, 12 km from the estimate"
    finally:
        flying.land()
    (received,) = flying.hints
    assert (received.lat_deg, received.lon_deg, received.radius_m, received.source) == (
        48.1,
        -11.5,
        3000.0,
        "command line",
    )
    assert (received.frame_id, received.sigma_m) == (7, 5.5)


def test_without_a_frame_the_reply_states_that_the_hint_applies_to_the_next_one(
    run: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(send, "ANSWER_S", 0.1)
    flying = HintListeners(run, None)
    try:
        assert "it applies to the next one" in hint(48.1, 11.5, 3000.0, str(run.path))
    finally:
        flying.land()


def test_processes_that_do_not_subscribe_yet_are_named(run: RunDir, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(send, "SUBSCRIBE_TIMEOUT_S", 0.1)
    with pytest.raises(LinkError, match="is Terrafix still starting"):
        hint(48.1, 11.5, 3000.0)


def test_without_a_run_the_command_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir, "SHM", tmp_path)
    (tmp_path / "terrafix-dead").mkdir()
    (tmp_path / "terrafix-dead" / "lock").touch()
    with pytest.raises(LinkError, match="Terrafix does not run on this computer"):
        hint(48.1, 11.5, 3000.0)
    with pytest.raises(UsageError, match="no such folder"):
        hint(48.1, 11.5, 3000.0, str(tmp_path / "nothing"))


def test_with_several_runs_one_must_be_chosen(run: RunDir) -> None:
    other = OwnedRunDir()
    try:
        assert {r.path for r in live_runs()} == {run.path, other.run_dir.path}
        with pytest.raises(UsageError, match="several runs on this computer; choose one: --run "):
            hint(48.1, 11.5, 3000.0)
    finally:
        other.remove()
    assert [r.path for r in live_runs()] == [run.path]


@pytest.mark.parametrize(
    ("lat", "lon", "radius", "text"),
    [(91.0, 0.0, 5000.0, "is no place"), (0.0, 181.0, 5000.0, "is no place"), (48.0, 11.0, 10.0, "--radius 10")],
)
def test_impossible_arguments_are_named(lat: float, lon: float, radius: float, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        hint(lat, lon, radius)
