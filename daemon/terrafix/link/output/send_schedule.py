"""Sends on absolute deadlines, so that neither a late tick nor a slow one shifts the rate."""

NS_PER_S = 1_000_000_000
MIN_GAP_NS = 50_000_000  # the autopilot's filter drops samples that are closer (sensorIntervalMin_ms)


class SendSchedule:
    """``due`` is asked at every tick and is true once per period, at the tick nearest to the deadline."""

    def __init__(self, rate_hz: float, tick_hz: float) -> None:
        self._period_ns = round(NS_PER_S / rate_hz)
        self._early_ns = round(NS_PER_S / tick_hz / 2)
        self._deadline_ns: int | None = None
        self._last_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        if self._deadline_ns is None:
            self._deadline_ns = now_ns
        if now_ns < self._deadline_ns - self._early_ns:
            return False
        if self._last_ns is not None and now_ns - self._last_ns < MIN_GAP_NS:
            return False
        missed = max(0, now_ns - self._deadline_ns) // self._period_ns  # not made up for
        self._deadline_ns += (missed + 1) * self._period_ns
        self._last_ns = now_ns
        return True
