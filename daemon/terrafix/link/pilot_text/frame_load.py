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
        if not self._debounce.due(slow := 2 * len(left_out_ns) > FRAMES, frame.t_ns, clears=not slow):
            return []
        hz = (len(self._newest) - 1) * 1e9 / max(frame.t_ns - self._newest[0].t_ns, 1)
        detail = f"{hz * (1.0 - len(left_out_ns) / len(self._newest)):.1f} of {hz:.1f} Hz"
        t_ns = left_out_ns[0] if slow else frame.t_ns
        return [CalibrationFault(t_ns=t_ns, quantity=TOO_SLOW, factor=None, detail=detail, active=slow)]
