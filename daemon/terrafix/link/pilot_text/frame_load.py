"""Text to the pilot while the computer is too slow for the camera."""

from collections import deque

from terrafix.link.pilot_text.debounce import Debounce
from terrafix.link.pilot_text.statustext import INFO, WARNING, statustext
from terrafix.messages import OVERTAKEN, Frame, StatusText

FRAMES = 20  # newest frames that are counted [spec: 10 s at the default frame rate of 2 Hz]


class FrameLoad:
    """``on_frame`` for each Frame, in the order in which they come."""

    def __init__(self) -> None:
        self._left_out: deque[bool] = deque(maxlen=FRAMES)
        self._debounce = Debounce[bool]()
        self._debounce.reported = False

    def on_frame(self, frame: Frame) -> list[StatusText]:
        """The computer is too slow while it leaves out more frames than it computes. -> the text about a change; else
        nothing."""
        self._left_out.append(frame.error == OVERTAKEN)
        left_out = sum(self._left_out)
        slow = left_out > FRAMES - left_out
        if not self._debounce.due(slow, frame.t_ns, clears=not slow):
            return []
        if not slow:
            return [statustext(frame.t_ns, INFO, "computer keeps up again")]
        return [statustext(frame.t_ns, WARNING, f"computer too slow: {left_out} of {FRAMES} frames out")]
