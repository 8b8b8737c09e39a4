"""Delays of the stages of a live flight, from the exposure of a frame to the reception at the recorder."""

from dataclasses import dataclass, field

import numpy as np

from terrafix.messages import Frame, GpsInput, MapMatch, Message, NavEstimate, Odometry, Prediction

# In the order of a frame's path. "estimate": the last one of a frame, with its map match; GPS_INPUT: the first after
# it.
STAGES = ("frame", "odometry", "prediction", "map match", "estimate", "GPS_INPUT")
PERCENTILES = (50, 95, 99)
_STAGE_OF: dict[type[Message], str] = {
    Frame: "frame",
    Odometry: "odometry",
    Prediction: "prediction",
    MapMatch: "map match",
    NavEstimate: "estimate",
}
_MS = 1_000_000


@dataclass
class StageTimes:
    """``delay_ns``: by stage, then by the time of exposure [ms], since that time. The recorder reads its clock every
    10 ms."""

    delay_ns: dict[str, dict[int, int]] = field(default_factory=lambda: {stage: {} for stage in STAGES})

    def take(self, received_ns: int, message: Message) -> None:
        stage = _STAGE_OF.get(type(message))
        if stage is not None:
            self.delay_ns[stage][round(message.t_ns / _MS)] = received_ns - message.t_ns
            if isinstance(message, NavEstimate):
                self.delay_ns["GPS_INPUT"].pop(round(message.t_ns / _MS), None)
        elif isinstance(message, GpsInput) and message.estimate_age_ms >= 0:
            exposed_ns = message.t_ns - round(message.estimate_age_ms * _MS)
            # Later messages propagate the same estimate further.
            self.delay_ns["GPS_INPUT"].setdefault(round(exposed_ns / _MS), received_ns - exposed_ns)

    def series(self, stage: str, zero_ns: int) -> list[tuple[float, float]]:
        """-> (time since zero_ns [s], delay [ms]), in order of time"""
        return [((at - zero_ns / _MS) / 1000, ns / _MS) for at, ns in sorted(self.delay_ns[stage].items())]

    def percentiles_ms(self, stage: str) -> list[float]:
        """Median, 95 and 99 % of the delay; [] without messages."""
        found = list(self.delay_ns[stage].values())
        return [float(value) / _MS for value in np.percentile(found, PERCENTILES)] if found else []

    def step_ms(self, stage: str) -> float | None:
        """Median time since the stage before, of the frames that have both; None: there are none."""
        if stage == STAGES[0]:
            return None
        before = self.delay_ns[STAGES[STAGES.index(stage) - 1]]
        steps = [ns - before[at] for at, ns in self.delay_ns[stage].items() if at in before]
        return float(np.median(steps)) / _MS if steps else None
