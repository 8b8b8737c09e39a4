"""Lock monitor: whether the tracked position is right or the vehicle elsewhere (core/agreement.py), over frames and
poses.

A belief always has a best position, and a wrong one can score well in single frames. Over many frames the evidence for
the belief as a whole is lower at a wrong position, and no camera pose is found.
"""

import math

from terrafix.core.agreement import Agreement, Cause, Range

START_LOG_ODDS = 6.0  # log odds of a start coordinate: one in 400 is wrong by far more than its 1-sigma [tuned]
# upper bound for a position confirmed by poses; bare ground or an outdated map may follow for a kilometre [tuned]
MAX_LOG_ODDS = 20.0
# Nats of a full observation under the null hypothesis. The right position gives 4 to 9, a wrong one -0.4 to 3 (real
# flights with the right start and with one 700 m off). [measured: docs/search.md]
LOCK_NULL_GAIN = 3.0
# Bounds of one full observation's gain, nats. An observation without evidence counts little against the position, and
# the next one over the same kind of ground is not independent: a copter that climbed over fields was right through six
# full observations of -2, and twice as many must not outweigh a start. [measured: this comment]
MIN_GAIN, MAX_GAIN = -0.4, 2.0
# Evidence of a pose by its number of inliers. On nine flights and maps a pose was found at 70 right places in 25 to 90
# % of the frames, with 20 inliers in the median, and at 930 wrong places in 0.5 %, with 9 to 11 inliers (one had 20).
# [measured: docs/search.md]
POSE_LLR = ((8, 3.0), (12, 5.0), (20, 6.0))  # (inliers, nats)
# share of the height, and metres: a position whose 1-sigma exceeds both is not tested [tuned]
WIDE_SIGMA, WIDE_SIGMA_M = 0.5, 40.0


class LockMonitor:
    def __init__(self) -> None:
        self.agreement = Agreement({Cause.ELSEWHERE: Range(-START_LOG_ODDS, -MAX_LOG_ODDS, math.inf)})

    @property
    def log_odds(self) -> float:
        """That the position is right."""
        return -self.agreement.log_odds[Cause.ELSEWHERE]

    @property
    def lost(self) -> bool:
        """At even odds the position is more likely wrong than right."""
        return self.log_odds < 0.0

    @property
    def wrong_probability(self) -> float:
        """Probability that the position is wrong; 0 while it is too small to matter in the covariance."""
        return self.agreement.weight(Cause.ELSEWHERE)

    def update(
        self, evidence_nats: float, weight: float, new: float, inliers: int, sigma_m: float, agl_m: float
    ) -> None:
        """Measurement update. ``evidence_nats``: result of ``Belief.update`` for an observation with ``weight``;
        ``new``: share of new ground, since repeated observations of one field are no evidence against it;
        ``inliers`` of the pose, 0: no pose.

        ``sigma_m``: 1-sigma of the position. If it is large nothing counts against the position, because over a wide
        belief the right one gains little too, and the log odds are limited to those of a start, because the flight
        since then was not observed. What counts for it ends a doubt from before.
        """
        is_wide = has_wide_sigma(sigma_m, agl_m)
        least, most = (0.0, START_LOG_ODDS) if is_wide else (MIN_GAIN * new, MAX_LOG_ODDS)
        gain = min(max(evidence_nats - LOCK_NULL_GAIN * weight, least), MAX_GAIN * weight) + weight * pose_gain(inliers)
        self.agreement.begin(Cause.ELSEWHERE, -min(self.log_odds + gain, most))


def has_wide_sigma(sigma_m: float, agl_m: float) -> bool:
    """Whether the 1-sigma of a position is so large that evidence against the position is not counted."""
    return sigma_m > max(WIDE_SIGMA * agl_m, WIDE_SIGMA_M)


def pose_gain(inliers: int) -> float:
    """Log likelihood ratio "here against elsewhere" of a pose with so many inliers."""
    return max((llr for fewest, llr in POSE_LLR if inliers >= fewest), default=0.0)
