"""One frame of a source, with its size, rate, time stamps and what is used of it."""

import threading
from collections.abc import Iterator
from itertools import islice, pairwise
from pathlib import Path

import cv2

from terrafix.core.clock import now_ns
from terrafix.core.errors import OutputError, SourceError
from terrafix.vision.sources import Source
from terrafix.vision.sources.facts import facts_of
from terrafix_tools.source.text import fact_lines

SHOTS = 15  # from which rate and delay are taken
LIMIT_S = 15.0  # a camera that gives nothing in this time is not there


def shown(source: Source, out: Path) -> Iterator[str]:
    """Writes the last of a few frames, as it flies, to ``out``; -> lines about it. Closes the source.

    Raises SourceError: no frame that can be used; OutputError."""
    timer = threading.Timer(LIMIT_S, source.close)
    timer.start()
    found, stamps_ns, ages_ms, errors, buffered = None, [], [], [], False
    try:
        for shot in islice(source.shots(), SHOTS):
            stamps_ns.append(shot.frame.t_ns)
            ages_ms.append((now_ns() - shot.frame.t_ns) / 1e6)
            buffered |= shot.frame.buffered
            if shot.image is None:
                errors.append(shot.frame.error)
            else:
                found = shot.image
    finally:
        timer.cancel()
        source.close()
    if found is None:
        raise SourceError(f"{source.name()}: no frame in {LIMIT_S:.0f} s{f' ({errors[-1]})' if errors else ''}")
    if not cv2.imwrite(str(out), found):
        raise OutputError(f"{out}: cannot be written; choose another --out, such as frame.jpg")
    yield f"{out}: written, {found.shape[1]}x{found.shape[0]} px as it flies"
    yield from fact_lines(source.name(), facts_of(source))
    if len(stamps_ns) > 1 and stamps_ns[-1] > stamps_ns[0]:
        steps_ms = sorted((b - a) / 1e6 for a, b in pairwise(stamps_ns))
        yield f"rate: {1e9 * (len(stamps_ns) - 1) / (stamps_ns[-1] - stamps_ns[0]):.1f} a second, steps of " + (
            f"{steps_ms[0]:.0f} to {steps_ms[-1]:.0f} ms"
        )
    if source.live:
        stamp = "at arrival: buffers before it are not in the stamp" if buffered else "by the driver, at the exposure"
        yield f"stamps: {stamp}; frames came {min(ages_ms):.0f} to {max(ages_ms):.0f} ms after them"
    if errors:
        yield f"not usable: {len(errors)} of {len(stamps_ns)} frames ({errors[-1]})"
