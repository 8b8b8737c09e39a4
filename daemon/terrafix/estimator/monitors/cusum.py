"""Sequential likelihood-ratio tests with a stated mean time between false alarms."""

import math

MONITOR_FALSE_ALARM_HOURS = 1000.0  # h of flight between two false alarms of one monitor, on average [tuned]
COMPARISONS_PER_HOUR = 3600.0  # 1/h: at most one comparison a second [spec: MIN_TURN_SPACING_S]
MAX_STEP = 3.0  # nats per measurement, in either direction: a gross error is no evidence of a constant one [tuned]
MARGIN = 3.0  # nats: limit of the sum above the threshold, so that an alarm can end [tuned]


def threshold(steps_per_hour: float, hypotheses: int = 1, hours: float = MONITOR_FALSE_ALARM_HOURS) -> float:
    """Threshold h in nats. Page's CUSUM of log-likelihood ratios has a mean of at least e^h steps between false alarms
    (Lorden 1971). Of several hypotheses each gets its part of the rate."""
    return math.log(steps_per_hour * hours * hypotheses)


class Cusum:
    """Page's CUSUM (1954): the alarm begins when the sum reaches ``limit`` and ends when the sum is back at zero."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.sum = 0.0
        self.active = False

    def add(self, log_ratio: float) -> None:
        """``log_ratio``: log-likelihood of the fault less that of its absence [nats]."""
        step = max(-MAX_STEP, min(MAX_STEP, log_ratio))
        self.sum = max(0.0, min(self.limit + MARGIN, self.sum + step))
        if self.sum >= self.limit:
            self.active = True
        elif self.sum == 0.0:
            self.active = False
