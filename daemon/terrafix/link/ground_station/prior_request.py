"""Decides when the operator is asked for a coarse position (AC-6), and with which text."""

import math
from dataclasses import dataclass

from terrafix.core.clock import NS_PER_S
from terrafix.link.integrity.fix_type import DEGRADATION_LEVELS
from terrafix.link.integrity.output_predictor import worst_horizontal_variance
from terrafix.messages import NavEstimate, SearchStep

# Frames in a row and time without a known position before the first request. [spec: requirement AC-6]
MIN_FRAMES, MIN_DURATION_NS = 3, 2 * NS_PER_S
# m, 1-sigma. A position with a larger one is searched on the map, and only a search can use a hint. Equal to
# SEARCH_START_SIGMA_M of core/initial_position.py, which imports more than this process may load. [tuned]
UNKNOWN_POSITION_SIGMA_M = 100.0
# Without a map fix: from the first degradation level and this share of the route so far on. [spec: requirement AC-6]
UNANCHORED_SHARE, MIN_UNANCHORED_NS = 0.2, round(DEGRADATION_LEVELS[1][0] * NS_PER_S)
# From this way in metres on whatever the share is. [spec: AC-2, 20 m, over a drift of 1 %]
MAX_UNANCHORED_M = 2000.0
AGE_STEP_NS = 1_000_000  # ns: the age of a fix is in whole milliseconds [spec: NavEstimate.last_anchor_age_ms]
REPEAT_NS = 30 * NS_PER_S  # ns between requests; a pilot ignores a text that comes every few seconds [tuned]
# ns; without an estimate for so long the cause is another fault, which has its own text. [tuned]
MAX_ESTIMATE_AGE_NS = 10 * NS_PER_S
HOLD_OFF_NS = 60 * NS_PER_S  # ns without requests after a hint: time for the search [tuned]


@dataclass
class _Route:
    """Way over ground of a flight, and since its last map fix."""

    way_m: float = 0.0
    t_ns: int | None = None
    fix_way_m: float = 0.0
    fix_ns: int = 0

    def add(self, estimate: NavEstimate) -> None:
        """Before the first map fix the first estimate counts as one."""
        if self.t_ns is None:
            self.fix_ns = estimate.t_ns
        elif estimate.t_ns > self.t_ns:
            speed_mps = math.hypot(*estimate.velocity_enu_mps[:2])
            self.way_m += speed_mps * (estimate.t_ns - self.t_ns) / NS_PER_S
        self.t_ns = estimate.t_ns if self.t_ns is None else max(self.t_ns, estimate.t_ns)
        fix_ns = estimate.t_ns - estimate.last_anchor_age_ms * AGE_STEP_NS
        if estimate.last_anchor_age_ms >= 0 and fix_ns > self.fix_ns + AGE_STEP_NS:
            self.fix_ns, self.fix_way_m = fix_ns, self.way_m

    @property
    def unanchored_m(self) -> float:
        return self.way_m - self.fix_way_m

    @property
    def is_unanchored(self) -> bool:
        """Whether there was no map fix for so long that a hint is requested."""
        since_ns = 0 if self.t_ns is None else self.t_ns - self.fix_ns
        if self.unanchored_m == 0.0 or since_ns < MIN_UNANCHORED_NS:
            return False
        return self.unanchored_m >= min(UNANCHORED_SHARE * self.way_m, MAX_UNANCHORED_M)


class PriorRequest:
    """``on_estimate`` for each estimate, ``on_hint`` for each accepted hint, ``due`` at every transmission.
    ``search_step``: step of the search as the anchor published it last."""

    def __init__(self) -> None:
        self._frames = 0  # frames in a row without a known position
        self._frame_id: int | None = None
        self._since_ns: int | None = None
        self._estimate_t_ns = 0
        self._next_ns = 0
        self._route = _Route()
        self.search_step = SearchStep.NORMAL

    def on_estimate(self, estimate: NavEstimate) -> None:
        self._route.add(estimate)
        known = estimate.is_placed and worst_horizontal_variance(estimate.cov) <= UNKNOWN_POSITION_SIGMA_M**2
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
        lost = self._is_lost(now_ns)
        if not lost and not self._route.is_unanchored:
            return ""
        if now_ns < self._next_ns or now_ns - self._estimate_t_ns > MAX_ESTIMATE_AGE_NS:
            return ""
        self._next_ns = now_ns + REPEAT_NS
        if self.search_step is SearchStep.ASK:
            return "whole map searched, send a hint"
        if lost:
            return "lost, send a position hint"
        return f"dead reckoning for {self._route.unanchored_m / 1000.0:.1f} km, send a hint"

    def _is_lost(self, now_ns: int) -> bool:
        """Whether the position has been unknown for several frames and some time."""
        return self._since_ns is not None and self._frames >= MIN_FRAMES and now_ns - self._since_ns >= MIN_DURATION_NS
