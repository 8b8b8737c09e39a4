"""Whether the computer is too slow for the camera: a fault by its cause, from the first frame that was left out."""

from collections import deque

from terrafix.link.pilot_text.debounce import Debounce
from terrafix.link.pilot_text.statustext import TOO_SLOW
from terrafix.messages import OVERTAKEN, CalibrationFault, Frame

FRAMES = 10  # newest frames that are counted [spec: 5 s at the default frame rate of 2 Hz]


class FrameLoad:
    """``on_frame`` for each Frame, in the order in which they come."""

    def __init__(self) -> None:
        self._newest: deque[Frame] = deque(maxlen=FRAMES)
        self._debounce = Debounce[bool]()
        self._debounce.reported = False

    def on_frame(self, frame: Frame) -> list[CalibrationFault]:
        """The computer is too slow while it leaves out more frames than it computes. -> the fault that begins with the
        first frame that it left out, or ends; nothing while it lasts."""
        self._newest.append(frame)
        left_out_ns = [newest.t_ns for newest in self._newest if newest.error == OVERTAKEN]
        slow = len(left_out_ns) > FRAMES - len(left_out_ns)
        if not self._debounce.due(slow, frame.t_ns, clears=not slow):
            return []
        t_ns, detail = left_out_ns[0] if slow else frame.t_ns, f"{len(left_out_ns)} of {FRAMES} frames out"
        return [CalibrationFault(t_ns=t_ns, quantity=TOO_SLOW, factor=None, detail=detail, active=slow)]
