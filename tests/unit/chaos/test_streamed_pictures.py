"""Pictures of a stream that fails in flight."""

import numpy as np

from terrafix.messages import Frame
from terrafix.vision.sources import Shot
from terrafix_lab.faults.edits import Edit, Span
from terrafix_lab.faults.pictures import jittering, zooming

SPAN = Span(1.0, 3.0, "")
PICTURE = np.random.default_rng(1).integers(0, 255, (40, 60, 3), dtype=np.uint8)


def shown(edit: Edit) -> list[np.ndarray]:
    """Of five pictures, one a second, each turned by a pixel against the one before."""
    frames = (Frame(t_ns=i * 10**9, frame_id=i, file="", width=60, height=40) for i in range(5))
    shots = (Shot(frame, (), np.roll(PICTURE, frame.frame_id, axis=1)) for frame in frames)
    return [shot.image for shot in edit(shots) if shot.image is not None]


def test_a_picture_that_jitters_is_the_last_one_before_it_by_less_than_two_pixels_and_never_twice_the_same() -> None:
    seen = shown(jittering(SPAN))
    off = [float(np.abs(image.astype(float) - PICTURE).mean()) for image in seen]
    assert off[0] == 0.0 and all(0.0 < one < off[4] for one in off[1:4])
    assert not np.array_equal(seen[1], seen[2])
    assert np.array_equal(seen[4], np.roll(PICTURE, 4, axis=1))


def test_a_zoom_that_creeps_grows_in_its_span_and_is_gone_after_it() -> None:
    seen = shown(zooming(SPAN, 2.0))
    assert all(np.array_equal(seen[i], np.roll(PICTURE, i, axis=1)) for i in (0, 1, 4))
    detail = [float(np.abs(np.diff(image.astype(float), axis=1)).mean()) for image in seen]
    assert detail[3] < detail[2] < detail[1]  # larger structures
