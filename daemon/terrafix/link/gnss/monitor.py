"""What follows from the judgement of the receivers: a word to the pilot, and if it may, the autopilot's switch."""

import math
from collections import deque
from collections.abc import Iterator

from terrafix.core.config import GnssMode
from terrafix.link.gnss.map_registration import MapOffsets
from terrafix.link.gnss.spoofing_detector import DELAY_S, VISION_OLD_S, VISION_VAGUE_M, Opinion, SpoofingDetector
from terrafix.link.integrity.output_predictor import Attitudes, PredictedState, distance_m, predict_to
from terrafix.link.pilot_text.statustext import CRITICAL, INFO, NOTICE, WARNING, statustext
from terrafix.messages import (
    GnssReading,
    GnssState,
    GnssVerdict,
    MapOffset,
    Message,
    NavEstimate,
    PositionSource,
    VehicleState,
)

NS_PER_S = 1_000_000_000
SAY_NS = NS_PER_S  # a verdict is said on every change, and this often
STEPS_NS = 10 * NS_PER_S  # for so long a step of our own estimate makes a disagreement doubtful
OURS_GOOD_NS = 2 * NS_PER_S  # of 3D fixes of our own before anybody is switched onto them
BACK_NS = 30 * NS_PER_S  # on us for so long at least, and
AGAIN_NS = 5 * NS_PER_S  # on the receiver for so long: who is spoofed twice need not wait
WORTH_A_WORD_M = 3.0  # of the map's error
BAD = (GnssState.LOST, GnssState.SPOOFED)


class GnssMonitor:
    """``accepted`` each estimate that the link believes, ``reading`` each of a receiver, ``tick`` at every send."""

    def __init__(self, mode: GnssMode, offsets: MapOffsets | None = None) -> None:
        """``offsets`` None: the map's error is not learnt."""
        self._mode = mode
        self._offsets = offsets
        self._said_offset = False
        self._judges: dict[int, SpoofingDetector] = {}
        self._said: dict[int, tuple[GnssState, int]] = {}  # receiver -> (state, when said)
        self._estimate: NavEstimate | None = None
        self._steps: deque[tuple[int, float]] = deque()
        self._good_since_ns: int | None = None
        self._armed: bool | None = None
        self._on_vision = False
        self._switched_ns: int | None = None

    def accepted(self, estimate: NavEstimate, attitudes: Attitudes) -> None:
        if self._estimate is not None:
            before = predict_to(self._estimate, estimate.t_ns, attitudes)
            step_m = distance_m(before.lat_deg, before.lon_deg, estimate.lat_deg, estimate.lon_deg)
            self._steps.append((estimate.t_ns, step_m))
        self._estimate = estimate

    def vehicle(self, state: VehicleState) -> None:
        self._armed = state.armed

    def reading(self, reading: GnssReading, attitudes: Attitudes) -> Iterator[Message]:
        if self._mode == "off":
            return
        judge = self._judges.setdefault(reading.receiver, SpoofingDetector())
        while self._steps and reading.t_ns - self._steps[0][0] > STEPS_NS:
            self._steps.popleft()
        own_step_m = max((step_m for _, step_m in self._steps), default=0.0)
        vision = self._vision(reading.t_ns, attitudes)
        opinion = judge.take(reading, vision, own_step_m)
        if self._offsets is not None:
            trusted = opinion.state is GnssState.TRUSTED
            learnt = self._offsets.take(reading, vision, self._estimate, trusted=trusted)
            if learnt is not None:
                yield from self._say_offset(learnt, reading)
        yield from self._say(reading.receiver, opinion, reading.t_ns)

    def less_map_offset(self, estimate: NavEstimate, now_ns: int) -> tuple[NavEstimate, tuple[float, float]]:
        """See MapOffsets.corrected."""
        return (estimate, (0.0, 0.0)) if self._offsets is None else self._offsets.corrected(estimate, now_ns)

    def tick(self, now_ns: int, *, good: bool) -> Iterator[Message]:
        """``good``: we send a 3D fix now."""
        if self._mode == "off":
            return
        self._good_since_ns = (self._good_since_ns or now_ns) if good else None
        for receiver, judge in self._judges.items():
            yield from self._say(receiver, judge.look(now_ns), now_ns)
        if self._mode == "act" and self._judges:
            yield from self._switch(now_ns)

    def _vision(self, now_ns: int, attitudes: Attitudes) -> PredictedState | None:
        """Our estimate at the time of a reading that has just come. Before the first map fix it is a start coordinate,
        perhaps that of another start: no witness."""
        if self._estimate is None or self._estimate.last_anchor_age_ms < 0:
            return None
        carried = predict_to(self._estimate, now_ns - round(DELAY_S * NS_PER_S), attitudes)
        vague = carried.horizontal_sigma_m > VISION_VAGUE_M
        return None if vague or carried.age_s > VISION_OLD_S else carried

    def _say(self, receiver: int, opinion: Opinion, now_ns: int) -> Iterator[Message]:
        before, said_ns = self._said.get(receiver, (GnssState.UNKNOWN, -SAY_NS))
        changed = opinion.state is not before
        if not changed and now_ns - said_ns < SAY_NS:
            return
        self._said[receiver] = (opinion.state, now_ns)
        yield GnssVerdict(
            t_ns=now_ns,
            receiver=receiver,
            state=opinion.state,
            distance_m=opinion.distance_m,
            sigmas=opinion.sigmas,
            reason=opinion.reason,
        )
        text = self._text(receiver + 1, before, opinion) if changed else None
        if text is not None:
            yield statustext(now_ns, *text)

    def _say_offset(self, learnt: MapOffset, reading: GnssReading) -> Iterator[Message]:
        yield learnt
        off_m = math.hypot(*learnt.state[:2])
        if not self._said_offset and off_m >= WORTH_A_WORD_M:
            self._said_offset = True
            yield statustext(reading.t_ns, INFO, f"map is {off_m:.0f} m off GPS {reading.receiver + 1}")

    def _text(self, number: int, before: GnssState, opinion: Opinion) -> tuple[int, str] | None:
        """What the pilot reads; a receiver that never was there is no news."""
        match opinion.state:
            case GnssState.SPOOFED:
                return CRITICAL, f"GPS {number} is {opinion.distance_m or 0:.0f} m off the map"
            case GnssState.DISPUTED:
                return WARNING, f"GPS {number} and the map disagree"
            case GnssState.LOST if before is GnssState.TRUSTED:
                return WARNING, f"GPS {number} is lost"
            case GnssState.TRUSTED if before is not GnssState.UNKNOWN:
                return INFO, f"GPS {number} agrees with the map again"
        return None

    def _switch(self, now_ns: int) -> Iterator[Message]:
        wait_ns = BACK_NS if self._on_vision else AGAIN_NS
        if self._armed is False or (self._switched_ns is not None and now_ns - self._switched_ns < wait_ns):
            return
        states = [judge.opinion.state for judge in self._judges.values()]
        ours_good = self._good_since_ns is not None and now_ns - self._good_since_ns >= OURS_GOOD_NS
        if not self._on_vision and ours_good and all(state in BAD for state in states):
            yield from self._order(now_ns, vision=True)
        elif self._on_vision and any(state is GnssState.TRUSTED for state in states):
            yield from self._order(now_ns, vision=False)

    def _order(self, now_ns: int, *, vision: bool) -> Iterator[Message]:
        self._on_vision, self._switched_ns = vision, now_ns
        receiver = next((n for n, j in self._judges.items() if j.opinion.state is GnssState.TRUSTED), 0)
        yield PositionSource(t_ns=now_ns, vision=vision, receiver=receiver)
        yield statustext(now_ns, NOTICE, f"flying on the {'map' if vision else 'GPS'} now")
