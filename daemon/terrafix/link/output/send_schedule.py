"""Transmission schedule with absolute deadlines, so that late or slow ticks do not change the mean rate."""

from terrafix.core.clock import NS_PER_S

# ns; the autopilot's EKF drops samples that are closer together. [spec: ArduPilot EKF3 sensorIntervalMin_ms]
MIN_SEND_INTERVAL_NS = 50_000_000


class SendSchedule:
    """``due`` is called at every tick; it is true once per period, at the tick that is nearest to the deadline."""

    def __init__(self, rate_hz: float, tick_hz: float) -> None:
        self._period_ns = round(NS_PER_S / rate_hz)
        self._early_ns = round(NS_PER_S / tick_hz / 2)
        self._deadline_ns: int | None = None
        self._last_sent_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        if self._deadline_ns is None:
            self._deadline_ns = now_ns
        if now_ns < self._deadline_ns - self._early_ns:
            return False
        if self._last_sent_ns is not None and now_ns - self._last_sent_ns < MIN_SEND_INTERVAL_NS:
            return False
        # Deadlines that passed without a tick are skipped.
        missed = max(0, now_ns - self._deadline_ns) // self._period_ns
        self._deadline_ns += (missed + 1) * self._period_ns
        self._last_sent_ns = now_ns
        return True
