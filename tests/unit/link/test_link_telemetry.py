"""Telemetry that contradicts itself: packet numbers of two senders, time since boot, attitude against gyroscopes."""

import math
import random
from collections.abc import Iterable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import MS, S
from link_wire import MemoryWire, heartbeat, packed, states
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.admission.boot_clock import BACK_MS, CONFIRM_NS, WRAP_MS, BootClock, boot_step_ms
from terrafix.link.admission.sequence_numbers import LATE, LOST, PROOF, TWO_NS, Sequence
from terrafix.link.admission.turn_check import JUMP_RAD, TurnCheck, said
from terrafix.link.edge import MavlinkEdge

# --- packet numbers ---


def taken(sequence: Sequence, numbers: Iterable[int], *, begin_ns: int = S, every_ns: int = 12 * MS) -> list[bool]:
    """Which of these packets are."""
    return [not sequence.refuses(number % 256, begin_ns + i * every_ns) for i, number in enumerate(numbers)]


def test_one_sender_is_taken_all_around_and_through_losses() -> None:
    assert all(taken(Sequence(), range(600)))
    draw = random.Random(1)
    assert all(taken(Sequence(), (n for n in range(5000) if draw.random() > 0.2)))
    assert all(taken(Sequence(), [*range(10), *range(10 + LOST, 40)]))


def test_packets_that_come_late_or_twice_are_no_second_sender() -> None:
    draw, numbers = random.Random(2), []
    held: list[int] = []
    for n in range(5000):
        late = draw.random() < 0.1
        numbers += [] if late else [n]
        numbers += [n] if draw.random() < 0.1 else []
        numbers, held = numbers + held, [n] if late else []
    assert all(taken(Sequence(), numbers))
    assert all(taken(Sequence(), [*range(100), 100 - LATE, 100]))


def test_a_gap_costs_a_few_packets_and_a_pause_none() -> None:
    answers = taken(Sequence(), [*range(50), *range(150, 200)])
    assert answers == [True] * 50 + [False] * (PROOF - 1) + [True] * (50 - PROOF + 1)
    sequence = Sequence()
    assert all(taken(sequence, range(50))) and all(taken(sequence, range(150, 160), begin_ns=10 * S))


def interleaved(numbers: list[int], forged: list[int]) -> list[tuple[int, bool]]:
    """(number, whether it is forged); one forged for three true ones."""
    mixed: list[tuple[int, bool]] = []
    for i, number in enumerate(numbers):
        mixed.append((number % 256, False))
        if i % 3 == 0 and i // 3 < len(forged):
            mixed.append((forged[i // 3] % 256, True))
    return mixed


def test_of_two_series_the_one_that_was_there_first_is_taken() -> None:
    sequence = Sequence()
    assert all(taken(sequence, range(100)))
    mixed = interleaved(list(range(100, 2500)), list(range(200, 1000)))
    answers = [(forged, not sequence.refuses(n, 3 * S + i * 9 * MS)) for i, (n, forged) in enumerate(mixed)]
    true = [answer for forged, answer in answers if not forged]
    false = [answer for forged, answer in answers if forged]
    assert sum(true) / len(true) > 0.95
    # The faster one passes the other's numbers now and then; what slips through then has to pass the other checks.
    assert sum(false) / len(false) < 0.05


def test_a_sender_that_does_not_count_is_not_taken_beside_one_that_does() -> None:
    sequence = Sequence()
    assert all(taken(sequence, range(100, 200)))
    mixed = interleaved(list(range(200, 240)), [5] * 13)
    answers = [(forged, not sequence.refuses(n, 3 * S + i * 9 * MS)) for i, (n, forged) in enumerate(mixed)]
    assert answers == [(forged, not forged) for forged, _ in answers]


def test_a_few_stray_packets_are_no_second_sender() -> None:
    sequence = Sequence()
    stray = [*range(50), 200, *range(50, 58), 201, 202, *range(58, 62)]
    assert taken(sequence, stray).count(False) == 3
    assert all(taken(sequence, [*range(62 + LOST, 90)], begin_ns=2 * S))  # losses are forgiven as before


def test_after_a_second_sender_losses_are_forgiven_again() -> None:
    sequence = Sequence()
    taken(sequence, [n for pair in zip(range(60), range(150, 210), strict=True) for n in pair])
    gap = [*range(60, 70), *range(80, 90)]
    assert not all(taken(sequence, gap, begin_ns=3 * S))
    assert all(taken(sequence, range(90, 100), begin_ns=3 * S + TWO_NS))
    assert all(taken(sequence, range(110, 120), begin_ns=3 * S + TWO_NS + 200 * MS))


# --- time since boot ---


def test_time_since_boot_that_goes_on_is_taken_also_over_the_wrap_after_49_days() -> None:
    clock = BootClock()
    for i in range(200):
        assert not clock.refuses((WRAP_MS - 2000 + i * 20) % WRAP_MS, S + i * 20 * MS)
    assert clock.reboots == 0
    assert (boot_step_ms(WRAP_MS - 5, 5), boot_step_ms(5, WRAP_MS - 5)) == (10, -10)


def test_messages_that_overtake_each_other_are_taken() -> None:
    clock = BootClock()
    assert not clock.refuses(100_000, S)
    assert not clock.refuses(100_000 - BACK_MS, S + MS)
    assert clock.refuses(100_000 - BACK_MS - 1, S + 2 * MS)


@pytest.mark.parametrize("step_s", [-60, 8, 60])
def test_time_that_steps_beside_time_that_goes_on_is_never_taken(step_s: int) -> None:
    clock = BootClock()
    for i in range(1000):
        now_ns, boot_ms = S + i * 20 * MS, 100_000 + i * 20
        assert not clock.refuses(boot_ms, now_ns)
        assert i == 0 or f"steps by {step_s}.0 s" in clock.refuses(boot_ms + step_s * 1000, now_ns)
    assert clock.reboots == 0


def test_a_reboot_is_believed_when_nothing_else_was_heard_for_a_second() -> None:
    clock = BootClock()
    clock.refuses(100_000, S)
    answers = [bool(clock.refuses(i * 20, 2 * S + i * 20 * MS)) for i in range(100)]
    assert answers == [True] * (CONFIRM_NS // (20 * MS)) + [False] * (100 - CONFIRM_NS // (20 * MS))
    assert clock.reboots == 1


def test_after_a_pause_time_has_gone_on_as_long() -> None:
    clock = BootClock()
    clock.refuses(100_000, S)
    assert not clock.refuses(400_000, 301 * S)
    assert clock.reboots == 0


# --- attitude against gyroscopes ---

RATE = 2.0  # rad/s: 115 degrees a second


def checked(
    rolls: list[tuple[float, float]], *, rate: float = 0.0, own: float = 0.0, readings: bool = True
) -> list[bool]:
    """(s, roll) of attitudes -> which are taken; gyroscopes at 33 Hz feel ``rate``, the messages say ``own``."""
    check, answers, fed = TurnCheck(), [], 0
    for t_s, roll in rolls:
        while readings and fed * 0.03 <= t_s:
            check.add(round(fed * 0.03 * S), (rate, 0.0, 0.0))
            fed += 1
        answers.append(not check.refuses(said(round(t_s * S), (1.0, 0.1, roll), (own, 0.0, 0.0))))
    return answers


def at_25_hz(seconds: float, begin_s: float = 0.0) -> list[float]:
    return [begin_s + i * 0.04 for i in range(round(seconds * 25))]


def test_a_turn_that_the_gyroscopes_felt_is_taken() -> None:
    assert all(checked([(t, RATE * t) for t in at_25_hz(2.0)], rate=RATE))
    assert all(checked([(t, RATE * t) for t in at_25_hz(2.0)], own=RATE, readings=False))


def test_a_slow_correction_is_left_to_the_estimator() -> None:
    """5 degrees a second were measured when a filter got a position again."""
    assert all(checked([(t, math.radians(5.0) * t) for t in at_25_hz(4.0)]))


@pytest.mark.parametrize("readings", [True, False])
def test_a_forged_tilt_beside_true_attitudes_is_never_taken(readings: bool) -> None:
    tilt = 1.2 * JUMP_RAD
    rolls = [pair for t in at_25_hz(5.0) for pair in ((t, 0.0), (t + 0.02, tilt))]
    assert checked(rolls, readings=readings) == [True, False] * 125


def test_below_the_stated_threshold_a_tilt_is_taken() -> None:
    assert all(checked([(t, 0.8 * JUMP_RAD * (i % 2)) for i, t in enumerate(at_25_hz(2.0))]))


def test_a_tenth_of_what_was_turned_is_allowed_for() -> None:
    assert checked([(0.0, 0.0), (0.9, 3.0 * 0.9 * 1.08)], rate=3.0) == [True, True]
    assert checked([(0.0, 0.0), (0.9, 3.0 * 0.9 * 1.20)], rate=3.0) == [True, False]
    assert checked([(0.0, 0.0), (0.1, 3.0 * 0.1 * 1.7)], own=3.0, readings=False) == [True, True]
    assert checked([(0.0, 0.0), (0.1, 3.0 * 0.1 * 2.2)], own=3.0, readings=False) == [True, False]


def test_rates_that_a_forger_writes_into_its_attitude_count_for_nothing_beside_gyroscopes() -> None:
    rolls = [pair for t in at_25_hz(2.0) for pair in ((t, 0.0), (t + 0.02, 0.5))]
    assert checked(rolls, own=25.0) == [True, False] * 50
    assert checked(rolls, own=math.nan, readings=False) == [True, False] * 50


def test_an_attitude_that_was_reset_is_taken_when_it_alone_was_heard_for_a_second() -> None:
    rolls = [(t, 0.0 if t < 1.0 else 0.5) for t in at_25_hz(4.0)]
    assert checked(rolls) == [True] * 25 + [False] * 25 + [True] * 50


def test_an_attitude_that_jumps_on_is_not() -> None:
    rolls = [(t, 0.0 if t < 1.0 else 0.5 * (i % 5 + 1)) for i, t in enumerate(at_25_hz(4.0))]
    assert checked(rolls) == [True] * 25 + [False] * 75


def test_what_cannot_be_compared_is_taken() -> None:
    assert checked([(0.0, 0.0), (1.2, 0.5)]) == [True, True]
    assert checked([(0.0, 0.0), (0.25, 0.5)], readings=False) == [True, True]


# --- all of it on one wire ---


class Wire:
    """An autopilot and a forger with its system id behind one router."""

    def __init__(self) -> None:
        self._memory = MemoryWire()
        self.edge = MavlinkEdge(LinkSection(), self._memory, lambda: 0)
        self.true = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        self.forger = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        self.forger.seq = 128
        self.said: list[m.Message] = []

    def run(self, seconds: float, forged: Any = None) -> None:
        """``forged``: makes a message of milliseconds since boot."""
        for i in range(round(seconds * 50)):
            now_ns = S + self._steps * 20 * MS
            boot_ms = now_ns // MS
            beat = [heartbeat()] if i % 50 == 0 else []
            true = [*beat, raw(boot_ms + self.imu_ahead_ms), attitude(boot_ms, 0.0)]
            self._memory.arrive(*(packed(x, self.true) for x in true))
            if forged is not None:
                self._memory.arrive(packed(forged(boot_ms), self.forger))
            self.said += self.edge.poll(now_ns)
            self._steps += 1

    _steps, imu_ahead_ms = 0, 0

    def verdicts(self) -> list[m.MeasurementVerdict]:
        return [x for x in self.said if isinstance(x, m.MeasurementVerdict)]

    def texts(self) -> list[str]:
        return [x.text for x in self.said if isinstance(x, m.StatusText)]


def attitude(boot_ms: int, roll: float) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ms, roll, 0.1, 1.0, 0, 0, 0)


def raw(boot_ms: int) -> Any:
    return mavlink.MAVLink_raw_imu_message(boot_ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0)


def test_a_flight_without_a_forger_has_no_verdict_on_telemetry() -> None:
    wire = Wire()
    wire.run(20.0)
    assert len(states(wire.said)) == 1000 and wire.verdicts() == [] and wire.texts() == []


def test_a_forged_tilt_does_not_reach_the_vehicle_state_and_is_on_record() -> None:
    wire = Wire()
    wire.run(2.0)
    wire.run(20.0, lambda boot_ms: attitude(boot_ms, 0.4))
    rolls = [state.roll_rad for state in states(wire.said)]
    assert set(rolls) == {0.0} and len(rolls) > 0.9 * 1100
    reasons = {verdict.detail.split(":")[0] for verdict in wire.verdicts()}
    assert {v.measurement for v in wire.verdicts()} == {"telemetry"} and "sequence" in reasons
    assert "Terrafix: telemetry of two senders, one ignored" in wire.texts()
    assert "telemetry refused, sequence" in [x for x in wire.said if isinstance(x, m.LinkStatus)][-1].detail


def test_a_forged_tilt_whose_numbers_fit_is_refused_by_the_gyroscopes() -> None:
    wire = Wire()
    wire.run(2.0)
    wire.forger = wire.true  # it listens, and counts on
    wire.run(5.0, lambda boot_ms: attitude(boot_ms, 0.4))
    assert {state.roll_rad for state in states(wire.said)} == {0.0}
    assert {verdict.detail.split(":")[0] for verdict in wire.verdicts()} == {"attitude"}
    assert wire.texts() == ["Terrafix: attitude jumps without gyros, ignored"]


def test_an_attitude_that_is_no_number_opens_no_gate() -> None:
    wire = Wire()
    wire.forger = wire.true
    wire.run(2.0)
    wire.run(2.0, lambda boot_ms: attitude(boot_ms, math.nan if boot_ms % 40 else 0.4))
    assert {state.roll_rad for state in states(wire.said)} == {0.0}


def test_a_forged_height_from_another_boot_is_refused_by_its_time() -> None:
    wire = Wire()
    wire.forger = wire.true
    wire.run(2.0)
    wire.run(5.0, lambda _: mavlink.MAVLink_global_position_int_message(5, 1, 2, 0, 99_000, 0, 0, 0, 0))
    assert {state.agl_m for state in states(wire.said)} == {None}
    assert {verdict.detail.split(":")[0] for verdict in wire.verdicts()} == {"boot time"}


def test_inertial_readings_may_have_another_clock() -> None:
    wire = Wire()
    wire.imu_ahead_ms = 60_000
    wire.run(4.0)
    assert len(states(wire.said)) == 200
    wire.forger = wire.true
    wire.run(2.0, lambda boot_ms: attitude(boot_ms, 0.4))
    assert {state.roll_rad for state in states(wire.said)} == {0.0}


def test_forged_readings_from_another_boot_do_not_turn_the_gyroscopes() -> None:
    wire = Wire()
    wire.run(2.0)
    wire.forger = wire.true
    wire.run(2.0, lambda boot_ms: mavlink.MAVLink_raw_imu_message(5000, 0, 0, -1000, 9000, 0, 0, 0, 0, 0))
    rates = [sample[4] for x in wire.said if isinstance(x, m.Imu) for sample in x.samples]
    assert rates and set(rates) == {0.0} and len(states(wire.said)) == 200


def test_a_reboot_ends_the_height_of_the_boot_before() -> None:
    memory = MemoryWire()
    edge = MavlinkEdge(LinkSection(), memory, lambda: 0)
    autopilot = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)

    def heard(now_ns: int, boot_ms: int, height_m: float | None = None) -> list[float | None]:
        height = mavlink.MAVLink_global_position_int_message
        heights = [] if height_m is None else [height(boot_ms, 1, 2, 0, round(height_m * 1e3), 0, 0, 0, 0)]
        memory.arrive(*(packed(x, autopilot) for x in (heartbeat(), *heights, attitude(boot_ms, 0.0))))
        return [state.agl_m for state in states(edge.poll(now_ns))]

    assert heard(10 * S, 100_000, 50.0) == [50.0]
    after = [agl for i in range(60) for agl in heard(10 * S + 500 * MS + i * 20 * MS, 1000 + i * 20)]
    assert after and set(after) == {None}
    assert heard(12 * S, 2500, 3.0) == [3.0]
