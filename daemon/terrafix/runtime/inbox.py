"""Bounded queue of received messages. Losses are counted; of some message types only the newest is kept."""

from collections import Counter, deque
from collections.abc import Callable
from typing import cast

import msgspec

from terrafix.messages import Message, Odometry, Origin, Prediction, SourceEnded, SourceFacts

CAPACITY = 2000  # messages; about 10 s of all messages that the busiest process receives
NEVER_DROPPED: tuple[type[Message], ...] = (Origin, SourceFacts, SourceEnded)  # published once a flight


def merge_predictions(older: Message, newer: Message) -> Message:
    """The newer Prediction with the camera motion of both: ``step_m`` then starts at the Prediction *before the older*.

    The covariances of the two steps add, because the steps come from different pairs of frames."""
    a, b = cast(Prediction, older), cast(Prediction, newer)
    step_m = (a.step_m[0] + b.step_m[0], a.step_m[1] + b.step_m[1])
    cov = [x + y for x, y in zip(a.step_cov_m2, b.step_cov_m2, strict=True)]
    return msgspec.structs.replace(b, step_m=step_m, step_cov_m2=(cov[0], cov[1], cov[2], cov[3]))


def is_needed(message: Message) -> bool:
    """Whether a message is kept although a newer one of its type is in the queue: a keyframe, to which the odometry of
    later frames refers."""
    return isinstance(message, Odometry) and message.becomes_keyframe


# How two messages of a type of which only the newest is kept are merged. Without an entry the older one is dropped.
MERGES: dict[type[Message], Callable[[Message, Message], Message]] = {Prediction: merge_predictions}


class Inbox:
    """First in, first out. ``skipped`` counts messages that were dropped at ``capacity`` or replaced by a newer message
    of a type in ``newest`` (unless ``is_needed``), by type name."""

    def __init__(self, newest: tuple[type[Message], ...] = (), capacity: int = CAPACITY) -> None:
        self._queue: deque[Message] = deque()
        self._newest = newest
        self._capacity = capacity
        self.skipped: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, message: Message) -> None:
        if isinstance(message, self._newest):
            message = self._replace(message)
        self._queue.append(message)
        if len(self._queue) > self._capacity:
            self._drop_oldest()

    def take(self) -> Message | None:
        return self._queue.popleft() if self._queue else None

    def _replace(self, message: Message) -> Message:
        kind = type(message)
        for i, older in enumerate(self._queue):
            if type(older) is kind and not is_needed(older):
                del self._queue[i]
                self.skipped[kind.__name__] += 1
                merge = MERGES.get(kind)
                return merge(older, message) if merge else message
        return message

    def _drop_oldest(self) -> None:
        for i, message in enumerate(self._queue):
            if not isinstance(message, NEVER_DROPPED):
                del self._queue[i]
                self.skipped[type(message).__name__] += 1
                return
