"""Lies in the closed loop: GNSS is jammed, Terrafix is all that the autopilot has, and then the camera lies for 15 s.

In words: docs/acceptance.md. Names and edits only: the simulator is not loaded with this."""

from collections.abc import Callable, Iterator
from functools import partial

from terrafix.vision.sources import Shot
from terrafix_tools.accept import lying_inputs as lying
from terrafix_tools.accept.faults import Edit
from terrafix_tools.accept.judged import Span

SEED = 1  # of the noise
BUFFERS = 4
LATE_S = 1.0
FOREIGN_LAG_S = 25.0  # longer than the lie: no foreign picture is one that the lie itself has shown before


def foreign(span: Span) -> Edit:
    """Pictures of another camera, which agree with each other: the flight's own from 25 s before, mirrored."""

    def edit(shots: Iterator[Shot]) -> Iterator[Shot]:
        return lying.every_picture(lying.mirrored)(lying.late_pictures(FOREIGN_LAG_S)(shots))

    return lying.during(span, edit)


def _stale(buffers: int, span: Span) -> Edit:
    return lying.stale_buffers(span, buffers, noise_grey=lying.NOISE_GREY, seed=SEED)


def _late(span: Span) -> Edit:
    return lying.during(span, lying.late_pictures(LATE_S))


LIES_IN_THE_LOOP: dict[str, Callable[[Span], Edit]] = {
    "GNSS jam, frozen picture": partial(_stale, 1),
    "GNSS jam, four stale buffers": partial(_stale, BUFFERS),
    "GNSS jam, foreign frames": foreign,
    "GNSS jam, late pictures": _late,
}
