"""Faults in the messages between the nodes: map fixes with a large error, a computer that throttles."""

from collections.abc import Callable, Iterable

import msgspec
import numpy as np

from terrafix.core.node import Node
from terrafix.core.pnp import solved
from terrafix.messages import Frame, Health, MapMatch, Message, Prediction, ThermalBand
from terrafix_lab.faults.edits import Span
from terrafix_lab.sim.true_messages import placed

OUTLIER_M, OUTLIER_SEED = 350.0, 1  # AC-3
OUTLIER_EVERY = 10  # up to 10 % wrong map matches are tolerated (AC-5)
OUTLIER_SIGMA_M, OUTLIER_SIGMA_RAD = 2.0, 0.01  # stated 1-sigma of the wrong fix
HOT_C = 97.0


MatchEdit = Callable[[MapMatch, Prediction], MapMatch]


def outliers() -> MatchEdit:
    """At every tenth frame a fix OUTLIER_M away in a random direction, with a small covariance."""
    rng = np.random.default_rng([OUTLIER_SEED, 350])

    def edit(match: MapMatch, prediction: Prediction) -> MapMatch:
        if prediction.frame_id % OUTLIER_EVERY != OUTLIER_EVERY // 2:
            return match
        towards = rng.uniform(0.0, 2.0 * np.pi)
        near = solved(match).pose or prediction
        there_m = np.array(near.p_c_in_w_m) + OUTLIER_M * np.array([np.sin(towards), np.cos(towards), 0.0])
        sigmas = np.array([OUTLIER_SIGMA_M] * 3 + [OUTLIER_SIGMA_RAD] * 3)
        without = msgspec.structs.replace(match, matches=[], pnp=None)
        return placed(without, there_m, near.q_w_c, sigmas, inliers=48)

    return edit


class AlteredAnchor:
    """An anchor whose matches of predictions are edited."""

    def __init__(self, anchor: Node, edit: MatchEdit) -> None:
        self._anchor, self._edit = anchor, edit

    def on(self, message: Message) -> Iterable[Message]:
        for output in self._anchor.on(message):
            edited = isinstance(message, Prediction) and isinstance(output, MapMatch)
            yield self._edit(output, message) if edited else output  # type: ignore[arg-type]

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._anchor.tick(now_ns)


class HotComputer:
    """An estimator that receives a Health message with each frame, with ``band`` in ``span``; they are published."""

    def __init__(self, estimator: Node, span: Span, band: ThermalBand = ThermalBand.CRITICAL) -> None:
        self._estimator, self._span, self._band = estimator, span, band

    def on(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Frame):
            hot = self._span.has(message.t_ns / 1e9)
            health = Health(
                t_ns=message.t_ns,
                band=self._band if hot else ThermalBand.NORMAL,
                temperature_c=HOT_C if hot else 60.0,
                throttled=hot,
                disk_free_mb=None,
                cause="scenario",
            )
            yield health
            yield from self._estimator.on(health)
        yield from self._estimator.on(message)

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._estimator.tick(now_ns)
