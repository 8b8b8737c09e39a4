"""A computer that is too slow for the camera: text to the pilot, and the span that the verdict of the report names."""

import pytest

from link_rig import MS, S, estimate, texts
from terrafix.link.node import LinkNode
from terrafix.messages import OVERTAKEN, CalibrationFault, Frame, Message
from terrafix_tools.estimates import Row
from terrafix_tools.flight_verdict import flight_verdict

RATE = 2  # frames per second


def frame_at(i: int, error: str = "") -> Frame:
    return Frame(t_ns=i * S // RATE, frame_id=i, file="", width=640, height=480, error=error)


def published_of(left_out: list[bool], error: str = OVERTAKEN) -> list[Message]:
    """By a link that receives frames at RATE, each with ``error`` where it is left out."""
    node, published = LinkNode(10.0), list[Message]()
    for i, out in enumerate(left_out):
        published += node.on(frame_at(i, error if out else ""))
    return published


def texts_of(left_out: list[bool], error: str = OVERTAKEN) -> list[str]:
    return texts(published_of(left_out, error))


def test_a_computer_that_leaves_out_most_frames_is_reported_once_and_so_is_its_recovery() -> None:
    slow, fast = [i % 4 != 0 for i in range(60)], [False] * 60
    assert texts_of(fast + slow + fast) == [
        "Terrafix: computer too slow: 4 of 10 frames late",
        "Terrafix: computer keeps up again",
    ]


def test_the_verdict_names_the_span_in_which_the_computer_was_too_slow() -> None:
    left_out = [False] * 60 + [True] * 40 + [False] * 60
    faults = [(x.t_ns / S, x) for x in published_of(left_out) if isinstance(x, CalibrationFault)]
    ((from_s, to_s, which),) = flight_verdict([Row(file="", t_s=80.0)], faults).refused
    assert from_s == 30.0 and 50.0 < to_s <= 53.0 and which == "computer too slow"


def test_a_few_overtaken_frames_are_no_slow_computer() -> None:
    assert texts_of([i % 4 == 0 for i in range(100)]) == []


def test_unreadable_images_are_no_slow_computer() -> None:
    assert texts_of([True] * 100, error="truncated") == []


def test_a_load_at_the_limit_is_reported_seldom() -> None:
    assert len(texts_of(([True] * 20 + [False] * 20) * 10)) <= 10  # 200 s; 20 changes


@pytest.mark.parametrize(("took_ms", "camera_ms", "sent"), [(300, 0, 0), (700, 0, 1), (700, 600, 0), (1300, 600, 1)])
def test_positions_that_come_after_the_next_frame_are_a_slow_computer_and_a_slow_camera_is_none(
    took_ms: int, camera_ms: int, sent: int
) -> None:
    """``camera_ms``: from the stamp of a frame to its message."""
    node, published = LinkNode(10.0), list[Message]()
    for i in range(60):
        frame = frame_at(i)
        node.tick(frame.t_ns + camera_ms * MS)
        published += node.on(frame)
        late_ns = (took_ms if i > 20 else camera_ms + 50) * MS
        published += node.on(estimate(frame.t_ns, late_ns=late_ns, frame_id=i))
    assert texts(published) == ["Terrafix: computer too slow: 4 of 10 frames late"] * sent
