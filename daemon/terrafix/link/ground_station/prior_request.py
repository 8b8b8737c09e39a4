"""When the operator is asked for a coarse position (AC-6), and in which words."""

from terrafix.link.integrity.output_predictor import worst_horizontal_variance
from terrafix.messages import NavEstimate, SearchStep

NS_PER_S = 1_000_000_000
FRAMES, AFTER_NS = 3, 2 * NS_PER_S  # AC-6: so many frames and so long without a place
# 1-sigma: a place that is known worse is searched on the map (SEARCHED_START_M of core/initial_position.py, which loads
# more than this process may), and only then does a hint say anything.
NOT_KNOWN_M = 100.0
AGAIN_NS = 30 * NS_PER_S  # a pilot who reads it every few seconds stops reading
FRESH_NS = 10 * NS_PER_S  # who has not said anything for so long is not lost: something else is wrong, and is said
HINTED_NS = 60 * NS_PER_S  # after a hint the search has its time


class PriorRequest:
    """``estimate`` each one that is heard, ``due`` at every send."""

    def __init__(self) -> None:
        self._frames = 0  # in a row whose place was not known
        self._frame_id: int | None = None
        self._since_ns: int | None = None
        self._heard_ns = 0
        self._next_ns = 0
        self.step = SearchStep.NORMAL  # of the search, as the anchor says it

    def estimate(self, estimate: NavEstimate) -> None:
        known = worst_horizontal_variance(estimate.cov) <= NOT_KNOWN_M**2
        if known:
            self._frames, self._since_ns = 0, None
        elif estimate.frame_id != self._frame_id:
            self._frames += 1
            self._since_ns = estimate.t_ns if self._since_ns is None else self._since_ns
        self._frame_id, self._heard_ns = estimate.frame_id, estimate.t_ns

    def hinted(self, now_ns: int) -> None:
        """The operator has answered."""
        self._next_ns = max(self._next_ns, now_ns + HINTED_NS)

    def due(self, now_ns: int) -> str:
        """What to ask now; empty: nothing."""
        if self._since_ns is None or self._frames < FRAMES or now_ns - self._since_ns < AFTER_NS:
            return ""
        if now_ns < self._next_ns or now_ns - self._heard_ns > FRESH_NS:
            return ""
        self._next_ns = now_ns + AGAIN_NS
        return "whole map searched, send a hint" if self.step is SearchStep.ASK else "lost, send a position hint"
