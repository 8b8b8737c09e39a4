"""Decides when the operator is asked for a coarse position (AC-6), and with which text."""

from terrafix.core.clock import NS_PER_S
from terrafix.link.integrity.output_predictor import worst_horizontal_variance
from terrafix.messages import NavEstimate, SearchStep

# Frames in a row and time without a known position before the first request. [spec: requirement AC-6]
MIN_FRAMES, MIN_DURATION_NS = 3, 2 * NS_PER_S
# m, 1-sigma. A position with a larger one is searched on the map, and only a search can use a hint. Equal to
# SEARCH_START_SIGMA_M of core/initial_position.py, which imports more than this process may load. [tuned]
UNKNOWN_POSITION_SIGMA_M = 100.0
REPEAT_NS = 30 * NS_PER_S  # ns between requests; a pilot ignores a text that comes every few seconds [tuned]
# ns; without an estimate for so long the cause is another fault, which has its own text. [tuned]
MAX_ESTIMATE_AGE_NS = 10 * NS_PER_S
HOLD_OFF_NS = 60 * NS_PER_S  # ns without requests after a hint: time for the search [tuned]


class PriorRequest:
    """``on_estimate`` for each estimate, ``on_hint`` for each accepted hint, ``due`` at every transmission.
    ``search_step``: step of the search as the anchor published it last."""

    def __init__(self) -> None:
        self._frames = 0  # frames in a row without a known position
        self._frame_id: int | None = None
        self._since_ns: int | None = None
        self._estimate_t_ns = 0
        self._next_ns = 0
        self.search_step = SearchStep.NORMAL

    def on_estimate(self, estimate: NavEstimate) -> None:
        known = worst_horizontal_variance(estimate.cov) <= UNKNOWN_POSITION_SIGMA_M**2
        if known:
            self._frames, self._since_ns = 0, None
        elif estimate.frame_id != self._frame_id:
            self._frames += 1
            self._since_ns = estimate.t_ns if self._since_ns is None else self._since_ns
        self._frame_id, self._estimate_t_ns = estimate.frame_id, estimate.t_ns

    def on_hint(self, now_ns: int) -> None:
        """The operator has sent a hint."""
        self._next_ns = max(self._next_ns, now_ns + HOLD_OFF_NS)

    def due(self, now_ns: int) -> str:
        """-> the text of the request to send now; empty when there is none."""
        if self._since_ns is None or self._frames < MIN_FRAMES or now_ns - self._since_ns < MIN_DURATION_NS:
            return ""
        if now_ns < self._next_ns or now_ns - self._estimate_t_ns > MAX_ESTIMATE_AGE_NS:
            return ""
        self._next_ns = now_ns + REPEAT_NS
        return "whole map searched, send a hint" if self.search_step is SearchStep.ASK else "lost, send a position hint"
