"""The smoother process of a record: its node, fed with what the replayed estimator publishes."""

from collections.abc import Iterable
from typing import Any

from terrafix.messages import InputOrder, Message, Origin
from terrafix.processes import PROCESSES
from terrafix.smoother.node import SmootherNode

NAME = "smoother"
(PROCESS,) = (process for process in PROCESSES if process.name == NAME)


class ReplayedSmoother:
    """All of its inputs but the Origin come from the estimator, so that their order is the one of publication, and its
    InputOrder says only when an instance ended."""

    def __init__(self, config: dict[str, Any]) -> None:
        """``config``: of the record; one of a version without a smoother has none."""
        self._enabled = bool(config.get(NAME, {}).get("enabled", False))
        self._node = SmootherNode(enabled=self._enabled)
        self._origin: Origin | None = None
        self._began_ns: int | None = None  # of the instance
        self.restarts = 0

    def on(self, message: Message) -> Iterable[Message]:
        """-> the messages that the smoother publishes after ``message``, recorded or replayed."""
        if isinstance(message, InputOrder) and message.process == NAME:
            self._on_instance(message.began_ns)
        elif isinstance(message, Origin):
            self._origin = message
        return list(self._node.on(message)) if isinstance(message, PROCESS.subscribes) else ()

    def _on_instance(self, began_ns: int) -> None:
        if self._began_ns not in (None, began_ns):
            self.restarts += 1
            self._node = SmootherNode(enabled=self._enabled)
            if self._origin is not None:  # the bus sends it again
                list(self._node.on(self._origin))
        self._began_ns = began_ns
