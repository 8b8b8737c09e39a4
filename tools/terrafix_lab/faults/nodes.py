"""Faults outside of the pictures: map fixes with a large error, a computer that throttles."""

from collections.abc import Iterable

import msgspec
import numpy as np

from terrafix.core.node import Node
from terrafix.core.pnp import solved
from terrafix.messages import Frame, Health, MapMatch, Message, Prediction, ThermalBand
from terrafix_lab.faults.edits import Span
from terrafix_lab.sim.true_messages import placed

OUTLIER_M = 350.0  # AC-3
OUTLIER_SIGMA_M, OUTLIER_SIGMA_RAD = 2.0, 0.01  # stated 1-sigma of the wrong fix
HOT_C = 97.0


class WrongFixes:
    """An anchor with wrong fixes at the frames ``files``: OUTLIER_M away in a random direction, small covariance."""

    def __init__(self, anchor: Node, files: frozenset[str], seed: int) -> None:
        self._anchor, self._files = anchor, files
        self._rng = np.random.default_rng([seed, 350])
        self.file = ""  # of the newest frame, set by FrameNames: the anchor does not subscribe to Frame

    def on(self, message: Message) -> Iterable[Message]:
        for output in self._anchor.on(message):
            wrong = isinstance(message, Prediction) and isinstance(output, MapMatch) and self.file in self._files
            yield self._with_offset(message, output) if wrong else output  # type: ignore[arg-type]

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._anchor.tick(now_ns)

    def _with_offset(self, prediction: Prediction, match: MapMatch) -> MapMatch:
        towards = self._rng.uniform(0.0, 2.0 * np.pi)
        near = solved(match).pose or prediction
        there_m = np.array(near.p_c_in_w_m) + OUTLIER_M * np.array([np.sin(towards), np.cos(towards), 0.0])
        sigmas = np.array([OUTLIER_SIGMA_M] * 3 + [OUTLIER_SIGMA_RAD] * 3)
        without = msgspec.structs.replace(match, matches=[], pnp=None)
        return placed(without, there_m, near.q_w_c, sigmas, inliers=48)


class FrameNames:
    """A vision node that passes the file name of the newest frame to ``wrong``."""

    def __init__(self, vision: Node, wrong: WrongFixes) -> None:
        self._vision, self._wrong = vision, wrong

    def on(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Frame):
            self._wrong.file = message.file
        return self._vision.on(message)

    def tick(self, now_ns: int) -> Iterable[Message]:
        return self._vision.tick(now_ns)


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
