"""Innovation gate of a reported height or heading, with a time-out after which the measurement is accepted.

It rejects readings that cannot be true: a range finder without an echo, a zero in place of "no data", a compass beside
a power line. The graph would weight such a reading like any other: one height of 300 m in a flight at 80 m pulls the
whole trajectory along, and later odometry is interpreted with the wrong scale. A rejected reading is treated as a
missing one. Compare the innovation gates and the fusion time-out of PX4's EKF2."""

from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.messages import Verdict

# Consecutive rejections without a map fix since the first of them, after which the next reading is accepted: the
# estimate itself may be wrong. [tuned]
FUSION_TIMEOUT_SAMPLES = 10
# Consecutive rejections after which a flight without any map fix is re-initialised, while not more than
# REINIT_MAX_ACCEPTED readings were accepted: the early ones may be defaults of a sensor without data. [tuned]
REINIT_SAMPLES = 2
REINIT_MAX_ACCEPTED = 10  # readings [tuned]


class InnovationGate:
    """Gate of one measurement, ``name`` in its verdicts. Counts accepted readings since (re-)initialisation and
    consecutive rejections."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._accepted = 0  # since the (re-)initialisation
        self._rejected = 0  # consecutive
        self._fixed_s: float | None = None  # time of the last map fix at the first of these rejections

    def accept_initial(self) -> None:
        """The state was (re-)initialised with the reading of its first frame."""
        self._accepted, self._rejected = 1, 0

    @property
    def should_reinitialise(self) -> bool:
        """For a flight without any map fix: the accepted readings may be wrong, begin again with the rejected one."""
        return self._accepted == 1 or (self._rejected >= REINIT_SAMPLES and self._accepted <= REINIT_MAX_ACCEPTED)

    def rejection(self, innovation: Innovation, fixed_s: float | None) -> FusionVerdict | None:
        """The verdict on a reading that is rejected; None: it is accepted, by the gate or after the time-out.
        ``fixed_s``: time of the last map fix, None if there was none."""
        if innovation.is_accepted:
            self._accepted, self._rejected = self._accepted + 1, 0
            return None
        if not self._rejected or fixed_s != self._fixed_s:
            self._rejected, self._fixed_s = 0, fixed_s
        self._rejected += 1
        if self._rejected > FUSION_TIMEOUT_SAMPLES:
            return None
        return innovation.verdict(self._name, rejected=Verdict.IMPLAUSIBLE)
