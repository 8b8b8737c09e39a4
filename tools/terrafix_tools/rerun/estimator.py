"""The estimator process of a record: its node, and the checkpoint that a restarted instance begins with."""

from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import CheckpointWriter, load_checkpoint
from terrafix.messages import Message, Origin
from terrafix.processes import PROCESSES

NAME = "estimator"
(PROCESS,) = (process for process in PROCESSES if process.name == NAME)


class ReplayedEstimator:
    """A context manager: the checkpoint is a file in a temporary folder."""

    def __init__(self) -> None:
        self._began_ns: int | None = None  # of the instance
        self._epoch_ns: int | None = None  # time at which the flight began
        self.restarts = 0

    def __enter__(self) -> Self:
        self._folder = TemporaryDirectory(prefix="terrafix-replay-")
        self._checkpoint = Path(self._folder.name) / "estimator.checkpoint"
        self._start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.cleanup()

    def on(self, message: Message, began_ns: int) -> list[Message]:
        """-> the messages that the instance which began at ``began_ns`` publishes after ``message``."""
        if self._began_ns not in (None, began_ns):
            self.restarts += 1
            self._start()
        self._began_ns = began_ns
        self._writer.on_message(message)
        published = list(self._node.on(message))
        for output in published:
            self._writer.on_message(output)
        if isinstance(message, Origin):
            self._epoch_ns = message.t_ns
        return published

    def _start(self) -> None:
        self._node = EstimatorNode(self._epoch_ns, load_checkpoint(self._checkpoint))
        self._writer = CheckpointWriter(self._checkpoint)
