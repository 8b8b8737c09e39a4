"""Whether the computer is too slow for the camera: a fault by its cause, from the first frame that came late."""

from collections import deque

from terrafix.link.pilot_text.statustext import TOO_SLOW
from terrafix.messages import OVERTAKEN, CalibrationFault, Frame, NavEstimate

FRAMES = 10  # newest frames that are counted [spec: 5 s at the default frame rate of 2 Hz]
# Late ones of these on a computer that is too slow: one that keeps the promise (5 %) has four once in a thousand.
TOO_SLOW_FRAMES = 4  # [spec: AC-7 and the binomial distribution]
MAX_COMPUTING_NS = 400_000_000  # from image to position [spec: AC-7, the floor]


class FrameLoad:
    """``on_frame`` for each Frame, in the order in which they come, and ``on_estimate`` for each estimate."""

    def __init__(self) -> None:
        self._newest: deque[Frame] = deque(maxlen=FRAMES)
        self._placed: set[int] = set()  # frames of these with a position
        self._late: set[int] = set()  # ... those left out, or whose position came late
        self._transport_ns = MAX_COMPUTING_NS  # least time from the stamp of a frame to its message: the camera's
        self._slow = False

    def on_estimate(self, estimate: NavEstimate) -> None:
        """Late is a position that comes after the next frame, and later than what is promised."""
        stamps_ns = {frame.frame_id: frame.t_ns for frame in self._newest}
        if estimate.frame_id not in stamps_ns or estimate.frame_id in self._placed:
            return
        self._placed.add(estimate.frame_id)
        took_ns = estimate.emitted_at_ns - stamps_ns[estimate.frame_id] - self._transport_ns
        period_ns = (self._newest[-1].t_ns - self._newest[0].t_ns) // max(len(self._newest) - 1, 1)
        if took_ns > max(MAX_COMPUTING_NS, period_ns):
            self._late.add(estimate.frame_id)

    def on_frame(self, frame: Frame, now_ns: int) -> list[CalibrationFault]:
        """-> the fault that begins with the first frame that was late, or ends; nothing while it lasts."""
        self._newest.append(frame)
        self._transport_ns = min(self._transport_ns, now_ns - frame.t_ns)
        if frame.error == OVERTAKEN:
            self._late.add(frame.frame_id)
        counted = {newest.frame_id for newest in self._newest}
        self._placed, self._late = self._placed & counted, self._late & counted
        late_ns = [newest.t_ns for newest in self._newest if newest.frame_id in self._late]
        slow = len(late_ns) >= TOO_SLOW_FRAMES
        if slow == self._slow:
            return []
        self._slow = slow
        t_ns, detail = late_ns[0] if slow else frame.t_ns, f"{len(late_ns)} of {FRAMES} frames late"
        return [CalibrationFault(t_ns=t_ns, quantity=TOO_SLOW, factor=None, detail=detail, active=slow)]
