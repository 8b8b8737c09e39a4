"""Whether the time since boot that an autopilot states goes on: what steps is refused until nothing else is heard.

It may have rebooted; then its time goes on from there, and nobody speaks of the old one any more."""

NS_PER_MS = 1_000_000
WRAP_MS = 2**32  # time_boot_ms has 32 bits: after 49.7 days it begins anew
BACK_MS = 1_000  # messages overtake each other
AHEAD_MS = 5_000  # beyond the time that has passed: the one before may have waited so long on its way
CONFIRM_NS = 1_000_000_000  # the new time alone was heard for so long


def boot_step_ms(before_ms: int, after_ms: int) -> int:
    """From one time since boot to another, by the shorter way around."""
    return (after_ms - before_ms + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2


class _Clock:
    def __init__(self, boot_ms: int, now_ns: int) -> None:
        self.began_ns = self._heard_ns = now_ns
        self.newest_ms = boot_ms

    def goes_on(self, boot_ms: int, now_ns: int) -> bool:
        step_ms = boot_step_ms(self.newest_ms, boot_ms)
        passed_ms = (now_ns - self._heard_ns) // NS_PER_MS
        if not -BACK_MS <= step_ms <= passed_ms + AHEAD_MS:
            return False
        if step_ms >= 0:
            self.newest_ms, self._heard_ns = boot_ms, now_ns
        return True


class BootClock:
    """``refuses`` each time since boot, at its arrival. ``reboots``: how often it began anew."""

    def __init__(self) -> None:
        self._clock: _Clock | None = None
        self._new: _Clock | None = None  # not believed yet
        self.reboots = 0

    def refuses(self, boot_ms: int, now_ns: int) -> str:
        """-> why it is not taken; empty: it is."""
        if self._clock is None:
            self._clock = _Clock(boot_ms, now_ns)
        if self._clock.goes_on(boot_ms, now_ns):
            self._new = None
            return ""
        step_s = boot_step_ms(self._clock.newest_ms, boot_ms) / 1e3
        if self._new is None or not self._new.goes_on(boot_ms, now_ns):
            self._new = _Clock(boot_ms, now_ns)
        if now_ns - self._new.began_ns < CONFIRM_NS:
            return f"time since boot steps by {step_s:.1f} s"
        self._clock, self._new = self._new, None
        self.reboots += step_s < 0
        return ""
