"""Frame rate of a live source: by thermal band, and by what the computer finishes in time."""

import itertools
from collections.abc import Callable

import pytest

from link_rig import estimate, texts
from terrafix.core.config import HealthSection
from terrafix.link.node import LinkNode
from terrafix.messages import OVERTAKEN, CalibrationFault, Frame, FrameRate, Message, NavEstimate, ThermalBand
from terrafix.vision.frame_rate import FRAMES, MAX_WAIT_NS, MIN_TAKEN_HZ, WAIT_NS, FrameRateLimit
from terrafix_tools.estimates import Row
from terrafix_tools.flight_verdict import flight_verdict

S, MS = 10**9, 10**6


def limit_of(band: ThermalBand) -> FrameRateLimit:
    limit = FrameRateLimit(HealthSection(hot_rate_hz=5.0, critical_rate_hz=2.0))
    limit.band = band
    return limit


def frames_taken(limit: FrameRateLimit, rate_hz: float, seconds: float, from_s: float = 0.0) -> list[float]:
    """-> times [s] of the frames of a camera with ``rate_hz`` that ``limit`` takes."""
    times = [from_s + i / rate_hz for i in range(round(rate_hz * seconds))]
    return [t for t in times if limit.takes_frame(round(t * 1e9))]


@pytest.mark.parametrize(
    ("band", "rate_hz", "seconds", "taken"),
    [
        pytest.param(ThermalBand.NORMAL, 30.0, 8.0, 240, id="all of a normal computer"),
        pytest.param(ThermalBand.HOT, 30.0, 8.0, 40, id="5 a second of a hot one"),
        pytest.param(ThermalBand.CRITICAL, 30.0, 8.0, 16, id="2 a second of a critical one"),
        pytest.param(ThermalBand.HOT, 7.0, 20.0, 100, id="the mean rate, of which the camera's is no multiple"),
        pytest.param(ThermalBand.CRITICAL, 2.0, 10.0, 20, id="all of a camera that is not faster"),
    ],
)
def test_a_camera_keeps_the_rate_of_the_band(band: ThermalBand, rate_hz: float, seconds: float, taken: int) -> None:
    off = abs(len(frames_taken(limit_of(band), rate_hz, seconds)) - taken)
    assert off <= (rate_hz != 2.0)


def test_after_a_gap_the_frames_come_at_the_limit_and_not_in_a_burst() -> None:
    limit = limit_of(ThermalBand.HOT)
    frames_taken(limit, 30.0, 1.0)
    after = frames_taken(limit, 30.0, 2.0, from_s=60.0)
    assert len(after) == 10
    assert min(b - a for a, b in itertools.pairwise(after)) > 0.19


def test_the_normal_band_takes_every_frame_at_once_after_a_hot_one_also_one_whose_time_went_back() -> None:
    limit = limit_of(ThermalBand.CRITICAL)
    assert limit.takes_frame(10**9)
    limit.band = ThermalBand.NORMAL
    assert limit.takes_frame(10**9 + 1)
    assert limit.takes_frame(10**9 - 1)


# --- by what the computer finishes in time ---


def frame_at(t_ns: int, frame_id: int, error: str = "") -> Frame:
    return Frame(t_ns=t_ns, frame_id=frame_id, file="", width=640, height=480, error=error)


class Computer:
    """Needs ``took_ms`` from a frame to its position (None: it leaves the frame out), and its camera ``camera_ms``."""

    def __init__(self) -> None:
        self.limit = limit_of(ThermalBand.NORMAL)
        self.taken_s: list[float] = []
        self.states: list[FrameRate] = []
        self.faults: list[CalibrationFault] = []
        self._frame_id, self._due = 0, list[NavEstimate]()

    def run(
        self, seconds: float, took_ms: Callable[[int], float | None], rate_hz: float = 2.0, camera_ms: float = 0.0
    ) -> "Computer":
        """``took_ms`` of the number of a frame that is taken."""
        for _ in range(round(seconds * rate_hz)):
            t_ns = round(self._frame_id * S / rate_hz)
            for placed in self._due:
                if placed.emitted_at_ns <= t_ns:
                    self.limit.on_estimate(placed)
            self._due = [placed for placed in self._due if placed.emitted_at_ns > t_ns]
            if self.limit.takes_frame(t_ns):
                took = took_ms(self._frame_id)
                self.taken_s.append(t_ns / S)
                frame = frame_at(t_ns, self._frame_id, OVERTAKEN if took is None else "")
                for published in self.limit.published([frame], t_ns + round(camera_ms * MS)):
                    (self.states if isinstance(published, FrameRate) else self.faults).append(published)  # type: ignore[attr-defined]
                if took is not None:
                    self._due.append(estimate(t_ns, late_ns=round(took * MS), frame_id=self._frame_id))
            self._frame_id += 1
        return self

    @property
    def changes(self) -> list[int]:
        """``every`` of the FrameRates, each that differs from the one before."""
        return [every for every, _ in itertools.groupby(state.every for state in self.states)]


def test_a_computer_that_keeps_up_takes_all_and_says_so_once_a_second() -> None:
    computer = Computer().run(60.0, lambda _: 300.0)
    assert len(computer.taken_s) == 120 and computer.changes == [1]
    assert all(not s.computer_too_slow and s.offered_hz == s.taken_hz == 2.0 for s in computer.states)
    assert 55 <= len(computer.states) <= 60


def one_at_a_time(ms: float, rate_hz: float) -> Callable[[int], float | None]:
    """Each frame that is taken keeps the computer busy, and those that come in between are left out."""
    free_s = 0.0

    def took_ms(i: int) -> float | None:
        nonlocal free_s
        if i / rate_hz < free_s:
            return None
        free_s = i / rate_hz + ms / 1e3
        return ms

    return took_ms


def test_one_that_cannot_finish_them_takes_fewer_evenly_and_not_fewer_than_it_finishes() -> None:
    computer = Computer().run(20.0, one_at_a_time(100.0, 6.0), 6.0).run(120.0, one_at_a_time(450.0, 6.0), 6.0)
    assert computer.changes[:3] == [1, 2, 3] and len(computer.changes) <= 11  # higher rates are tried, ever more rarely
    assert sum(state.every == 3 and state.taken_hz == 2.0 for state in computer.states) > 80
    last_s = [t_s for t_s in computer.taken_s if t_s > 120.0]
    assert {round(b - a, 6) for a, b in itertools.pairwise(last_s)} == {0.5}
    two_of_three = Computer().run(40.0, lambda i: None if i % 3 == 0 else 100.0, 6.0)
    assert two_of_three.changes == [1]  # every second one would be fewer
    assert two_of_three.states[-1].taken_hz == pytest.approx(4.0, abs=0.5)


def test_it_takes_all_again_once_it_has_finished_those_for_a_while() -> None:
    computer = Computer().run(40.0, one_at_a_time(450.0, 6.0), 6.0).run(40.0, one_at_a_time(150.0, 6.0), 6.0)
    assert computer.changes[-3:] == [3, 2, 1] and not computer.states[-1].computer_too_slow
    assert 40.0 + WAIT_NS / S <= next(s.t_ns for s in reversed(computer.states) if s.every == 2) / S <= 65.0


def test_a_rate_that_has_failed_is_tried_ever_more_rarely() -> None:
    """Half of the frames are finished, and all of them look lost when all are taken."""
    computer = Computer().run(1.0, lambda _: 100.0)
    computer.run(600.0, lambda _: 100.0 if computer.states[-1].every > 1 else None)
    tried_s = [b.t_ns / S for a, b in itertools.pairwise(computer.states) if b.every == 1 < a.every]
    waits_s = [b - a for a, b in itertools.pairwise(tried_s)]
    assert len(tried_s) >= 5 and waits_s == sorted(waits_s) and waits_s[-1] > MAX_WAIT_NS / S


def test_frames_of_one_moment_without_the_processor_lower_the_rate_once() -> None:
    computer = Computer().run(10.0, lambda _: 10.0, 30.0)
    left_out = [frame_at(10 * S + i * S // 30, 300 + i, OVERTAKEN) for i in range(60)]
    rates = [x for x in computer.limit.published(left_out, 12 * S) if isinstance(x, FrameRate)]
    assert [rate.every for rate in rates] == [2]


@pytest.mark.parametrize("rate_hz", [0.3, 2.0, 30.0])
def test_no_fewer_than_the_least_rate_are_taken_however_slow_it_is(rate_hz: float) -> None:
    computer = Computer().run(10.0, lambda _: 10.0, rate_hz).run(200.0, lambda _: None, rate_hz)
    assert computer.states[-1].computer_too_slow and computer.states[-1].every == max(1, int(rate_hz / MIN_TAKEN_HZ))


def test_frames_that_lose_their_position_on_the_way_are_lost() -> None:
    """The estimator gets every third frame of a camera of 30 Hz: of others it takes the newest alone."""
    limit, published = limit_of(ThermalBand.NORMAL), list[Message]()
    for i in range(FRAMES + 1):
        limit.takes_frame(i * S // 30)
        published += limit.published([frame_at(i * S // 30, i)], i * S // 30)
        if i % 3 == 0:
            limit.on_estimate(estimate(i * S // 30, late_ns=30 * MS, frame_id=i))
    rates, (fault, *_) = ([x for x in published if isinstance(x, kind)] for kind in (FrameRate, CalibrationFault))
    assert rates[-1].every == 2  # type: ignore[attr-defined]
    assert isinstance(fault, CalibrationFault) and fault.active and fault.t_ns == S // 30


def test_the_pilot_reads_the_rate_and_the_verdict_names_the_span() -> None:
    computer = Computer().run(20.0, lambda _: 100.0).run(40.0, one_at_a_time(900.0, 2.0)).run(40.0, lambda _: 100.0)
    node, heard = LinkNode(10.0), list[Message]()
    for fault in computer.faults:
        node.tick(fault.t_ns)
        heard += node.on(fault)
    slow, *_, ended = texts(heard)
    assert slow.startswith("Terrafix: computer too slow: running at 1.") and slow.endswith(" of 2 Hz")
    assert ended == "Terrafix: computer keeps up again"
    rows, faults = [Row(file="", t_s=100.0)], [(fault.t_ns / S, fault) for fault in computer.faults]
    ((from_s, to_s, which),) = flight_verdict(rows, faults).refused
    assert from_s == 20.0 and 65.0 <= to_s <= 80.0 and which == "computer too slow"


@pytest.mark.parametrize(
    ("took_ms", "camera_ms", "slow"), [(300, 0, False), (700, 0, True), (700, 600, False), (1300, 600, True)]
)
def test_positions_that_come_after_the_next_frame_are_late_and_a_slow_camera_is_not(
    took_ms: int, camera_ms: int, slow: bool
) -> None:
    computer = Computer().run(60.0, lambda _: took_ms, camera_ms=camera_ms)
    assert computer.changes == [1] and [fault.detail for fault in computer.faults] == ["4 of 10 frames late"] * slow


def test_a_few_frames_that_are_left_out_are_no_slow_computer_nor_are_unreadable_ones() -> None:
    assert Computer().run(50.0, lambda i: None if i % 4 == 0 else 100.0).changes == [1]
    limit = limit_of(ThermalBand.NORMAL)
    published = [
        x for i in range(100) if limit.takes_frame(i * S) for x in limit.published([frame_at(i * S, i, "cut")], i * S)
    ]
    assert all(isinstance(x, FrameRate) and not x.computer_too_slow for x in published) and published
