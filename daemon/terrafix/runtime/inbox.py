"""What a process has heard and not yet worked on: bounded, counted, and with only the newest of what may be skipped."""

from collections import Counter, deque
from collections.abc import Callable
from typing import cast

from terrafix.messages import Message, Origin, Prediction, SourceEnded

CAPACITY = 2000  # messages; about 10 s of everything that the busiest process hears
FACTS: tuple[type[Message], ...] = (Origin, SourceEnded)  # said once a flight: never thrown away


def fold_prediction(older: Message, newer: Message) -> Message:
    """The newer prediction, with the motion of both: ``step_m`` counts from the Prediction *before the older one*.

    The two steps come from different frame pairs, so that their covariances add."""
    a, b = cast(Prediction, older), cast(Prediction, newer)
    step_m = (a.step_m[0] + b.step_m[0], a.step_m[1] + b.step_m[1])
    cov = [x + y for x, y in zip(a.step_cov_m2, b.step_cov_m2, strict=True)]
    return Prediction(
        t_ns=b.t_ns,
        frame_id=b.frame_id,
        p_c_in_w_m=b.p_c_in_w_m,
        q_w_c=b.q_w_c,
        cov=b.cov,
        agl_m=b.agl_m,
        agl_sigma_m=b.agl_sigma_m,
        step_m=step_m,
        step_cov_m2=(cov[0], cov[1], cov[2], cov[3]),
        start_ns=b.start_ns,
    )


# How two messages of one type become one when only the newest counts; without an entry the older is just dropped.
FOLDS: dict[type[Message], Callable[[Message, Message], Message]] = {Prediction: fold_prediction}


class Inbox:
    """First in, first out. ``skipped`` counts what was lost to the bound or to a newer message, by type name."""

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
            if type(older) is kind:
                del self._queue[i]
                self.skipped[kind.__name__] += 1
                fold = FOLDS.get(kind)
                return fold(older, message) if fold else message
        return message

    def _drop_oldest(self) -> None:
        for i, message in enumerate(self._queue):
            if not isinstance(message, FACTS):
                del self._queue[i]
                self.skipped[type(message).__name__] += 1
                return
