"""Text to the pilot while the computer is too slow for the camera."""

from collections import deque

from terrafix.link.pilot_text.debounce import Debounce
from terrafix.link.pilot_text.statustext import INFO, WARNING, statustext
from terrafix.messages import OVERTAKEN, Frame, StatusText

WINDOW_NS = 10_000_000_000  # ns over which frames are counted [tuned]
# Share of frames left out from which the computer counts as too slow, and below which it does no more. [tuned]
SLOW_SHARE, FAST_SHARE = 0.5, 0.25
MIN_FRAMES = 10  # frames in the window, before which no share is judged [tuned]


class FrameLoad:
    """``on_frame`` for each Frame, in the order in which they come."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, bool]] = deque()  # time [ns], whether it was left out
        self._debounce = Debounce[bool]()
        self._debounce.reported = False

    def on_frame(self, frame: Frame) -> list[StatusText]:
        """-> the text about a change between "too slow" and "fast enough"; else nothing."""
        self._frames.append((frame.t_ns, frame.error == OVERTAKEN))
        while frame.t_ns - self._frames[0][0] > WINDOW_NS:
            self._frames.popleft()
        count, left_out = len(self._frames), sum(out for _, out in self._frames)
        if count < MIN_FRAMES:
            return []
        slow = left_out > (FAST_SHARE if self._debounce.reported else SLOW_SHARE) * count
        if not self._debounce.due(slow, frame.t_ns, clears=not slow):
            return []
        if not slow:
            return [statustext(frame.t_ns, INFO, "computer keeps up again")]
        return [statustext(frame.t_ns, WARNING, f"computer too slow: {left_out} of {count} frames out")]
