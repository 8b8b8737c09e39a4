"""False pictures in the closed loop: GNSS is jammed, the autopilot navigates by Terrafix, and for 15 s the camera
delivers false pictures. Described in docs/acceptance.md.

Only names and edits: this module does not load the simulator."""

from collections.abc import Callable, Iterator
from functools import partial

from terrafix.vision.sources import Shot
from terrafix_tools.accept.false_inputs import inputs as lying
from terrafix_tools.accept.faults.flight_edits import Edit
from terrafix_tools.accept.measuring.results import Span

SEED = 1  # of the noise
BUFFERS = 4
LATE_S = 1.0
FOREIGN_LAG_S = 25.0  # longer than the edited span: no foreign picture comes from the span itself


def foreign(span: Span) -> Edit:
    """Self-consistent pictures of another camera: the flight's own of 25 s before, mirrored."""

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
