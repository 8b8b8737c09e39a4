"""Sequential likelihood-ratio tests with a stated mean time between false alarms."""

import math

FALSE_ALARM_HOURS = 1000.0  # flight hours between two false alarms of one monitor, on average
LARGEST_STEP = 3.0  # nats that one measurement may add or take: a gross error is not evidence of a constant one
MARGIN = 3.0  # nats above the threshold at which the sum is held, so that an alarm can end


def threshold(steps_per_hour: float, hypotheses: int = 1, hours: float = FALSE_ALARM_HOURS) -> float:
    """Nats. Lorden (1971): Page's CUSUM of log-likelihood ratios with threshold h has a mean number of steps between
    false alarms of at least e^h; of several hypotheses each gets its part of the rate."""
    return math.log(steps_per_hour * hours * hypotheses)


class Cusum:
    """Page's CUSUM: the alarm begins when the sum reaches ``limit`` and ends when it is back at zero."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.sum = 0.0
        self.active = False

    def add(self, log_ratio: float) -> None:
        """``log_ratio``: log-likelihood of the fault less that of its absence, nats."""
        step = max(-LARGEST_STEP, min(LARGEST_STEP, log_ratio))
        self.sum = max(0.0, min(self.limit + MARGIN, self.sum + step))
        if self.sum >= self.limit:
            self.active = True
        elif self.sum == 0.0:
            self.active = False
