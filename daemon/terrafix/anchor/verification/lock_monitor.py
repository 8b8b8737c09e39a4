"""Whether the place that is followed is still believed: log odds over looks and poses.

A belief always has a best place, and wrong ones look good one at a time. Over many looks they do not: what the frames
say for the belief as a whole is less, and no camera pose stands."""

import numpy as np

START_ODDS = 6.0  # log odds of a start coordinate: one in 400 is wrong by far more than it claims
MOST_ODDS = 20.0  # of a place that poses have confirmed: bare ground, or a map of other years, may last for a kilometre
# What a full look says for the belief, in nats: 4 to 9 where it is right, -0.4 to 3 where it is not (measured on real
# flights with the right start and with one that is 700 m off). In between lies chance. A look that says nothing is weak
# evidence, and the next one over the same kind of ground is hardly new: a copter that climbs over fields was right
# through six full looks of -2 (twice as many must not outweigh a start).
CHANCE = 3.0
LOOK_MIN, LOOK_MAX = -0.4, 2.0
DOUBT_ODDS = 2.94  # 5 %: from here on a 95 % ellipse around the place would not be one
# What a pose says, by the patches that agree. Measured on nine flights and maps: at 70 right places a pose was found on
# 25 to 90 % of the frames, with 20 inliers in the median; at 930 wrong ones on 0.5 %, with 9 to 11 (one had 20).
POSE_LLR = ((8, 3.0), (12, 5.0), (20, 6.0))  # inliers, gain
WIDE, WIDE_M = 0.5, 40.0  # share of the height, and metres: a 1-sigma above both claims little


class LockMonitor:
    def __init__(self) -> None:
        self.odds = START_ODDS

    @property
    def lost(self) -> bool:
        """At even odds: from here the position is more likely wrong than right."""
        return self.odds < 0.0

    @property
    def doubt(self) -> float:
        """Probability that the place is wrong, once that is too much to be left out of the covariance."""
        return 0.0 if self.odds > DOUBT_ODDS else 1.0 / (1.0 + float(np.exp(self.odds)))

    def looked(self, gain: float, weight: float, new: float, inliers: int, claimed_m: float, agl_m: float) -> None:
        """``gain`` of the belief (``Belief.update``) for a look of this weight; ``new``: what new ground gives
        of it, since a hundred looks at one field are not evidence against it; ``inliers`` of the pose, 0: none.

        ``claimed_m``: 1-sigma of the position. One that claims little is not wrong by more, and over so wide a belief
        the right place gains little, too; what comes after a way that nobody saw is no surer than a start."""
        if claims_little(claimed_m, agl_m):
            self.odds = min(self.odds, START_ODDS)
            return
        self.odds += min(max(gain - CHANCE * weight, LOOK_MIN * new), LOOK_MAX * weight)
        if inliers:
            self.odds += weight * pose_gain(inliers)
        self.odds = min(self.odds, MOST_ODDS)


def claims_little(sigma_m: float, agl_m: float) -> bool:
    """A position with this 1-sigma."""
    return sigma_m > max(WIDE * agl_m, WIDE_M)


def pose_gain(inliers: int) -> float:
    """Log likelihood ratio, "here against elsewhere", of a pose on which so many patches agree."""
    return max((gain for least, gain in POSE_LLR if inliers >= least), default=0.0)
