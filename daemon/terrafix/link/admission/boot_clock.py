"""Continuity check of the time since boot in an autopilot's messages. A step is rejected until only the new time has
been received for ``BOOT_CONFIRM_NS``: the autopilot has then rebooted, and its time continues from there."""

from terrafix.core.clock import NS_PER_MS

WRAP_MS = 2**32  # time_boot_ms has 32 bits: it wraps after 49.7 days [spec: MAVLink common.xml]
MAX_BACKWARD_STEP_MS = 1_000  # messages may arrive out of order [tuned]
MAX_FORWARD_STEP_MS = 5_000  # beyond the elapsed time: the previous message may have been delayed so long [tuned]
BOOT_CONFIRM_NS = 1_000_000_000  # time for which only the new time must be received [tuned]


def boot_step_ms(before_ms: int, after_ms: int) -> int:
    """-> ``after_ms - before_ms`` of two times since boot, modulo the wrap, in [-WRAP_MS / 2, WRAP_MS / 2)."""
    return (after_ms - before_ms + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2


class _ClockTrack:
    """One continuous sequence of times since boot, with their times of arrival."""

    def __init__(self, boot_ms: int, now_ns: int) -> None:
        self.start_ns = self._received_ns = now_ns
        self.newest_ms = boot_ms

    def accepts(self, boot_ms: int, now_ns: int) -> bool:
        """True if ``boot_ms``, received at ``now_ns``, continues the sequence, which it then extends."""
        step_ms = boot_step_ms(self.newest_ms, boot_ms)
        elapsed_ms = (now_ns - self._received_ns) // NS_PER_MS
        if not -MAX_BACKWARD_STEP_MS <= step_ms <= elapsed_ms + MAX_FORWARD_STEP_MS:
            return False
        if step_ms >= 0:
            self.newest_ms, self._received_ns = boot_ms, now_ns
        return True


class BootClock:
    """Checks each time since boot at its arrival. ``reboots``: number of confirmed steps back."""

    def __init__(self) -> None:
        self._clock: _ClockTrack | None = None
        self._candidate: _ClockTrack | None = None  # sequence after a step, not confirmed yet
        self.reboots = 0

    def rejection_reason(self, boot_ms: int, now_ns: int) -> str:
        """-> reason for the rejection; empty if the time is accepted."""
        if self._clock is None:
            self._clock = _ClockTrack(boot_ms, now_ns)
        if self._clock.accepts(boot_ms, now_ns):
            self._candidate = None
            return ""
        step_s = boot_step_ms(self._clock.newest_ms, boot_ms) / 1e3
        if self._candidate is None or not self._candidate.accepts(boot_ms, now_ns):
            self._candidate = _ClockTrack(boot_ms, now_ns)
        if now_ns - self._candidate.start_ns < BOOT_CONFIRM_NS:
            return f"time since boot steps by {step_s:.1f} s"
        self._clock, self._candidate = self._candidate, None
        self.reboots += step_s < 0
        return ""
