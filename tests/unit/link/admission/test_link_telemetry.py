"""Rejection of inconsistent telemetry: sequence numbers of two senders, time since boot, attitude and gyroscopes."""

import math
import random
from collections.abc import Iterable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import MS, S
from link_wire import WiredEdge, heartbeat, packed, states
from terrafix import messages as m
from terrafix.link.admission.boot_clock import BOOT_CONFIRM_NS, MAX_BACKWARD_STEP_MS, WRAP_MS, BootClock, boot_step_ms
from terrafix.link.admission.sequence_numbers import (
    MAX_LATE,
    MAX_LOST,
    MIN_SERIES_PACKETS,
    SECOND_SENDER_TIMEOUT_NS,
    SequenceCheck,
)
from terrafix.link.admission.turn_check import JUMP_RAD, TurnCheck, attitude_sample

# --- sequence numbers ---


def accepted(
    sequence: SequenceCheck, numbers: Iterable[int], *, begin_ns: int = S, every_ns: int = 12 * MS
) -> list[bool]:
    """-> for each sequence number whether the packet is accepted."""
    return [not sequence.rejection_reason(number % 256, begin_ns + i * every_ns) for i, number in enumerate(numbers)]


def test_one_sender_is_accepted_through_sequence_wrap_and_losses() -> None:
    assert all(accepted(SequenceCheck(), range(600)))
    draw = random.Random(1)
    assert all(accepted(SequenceCheck(), (n for n in range(5000) if draw.random() > 0.2)))
    assert all(accepted(SequenceCheck(), [*range(10), *range(10 + MAX_LOST, 40)]))


def test_late_and_duplicated_packets_are_not_a_second_sender() -> None:
    draw, numbers = random.Random(2), []
    delayed: list[int] = []
    for n in range(5000):
        late = draw.random() < 0.1
        numbers += [] if late else [n]
        numbers += [n] if draw.random() < 0.1 else []
        numbers, delayed = numbers + delayed, [n] if late else []
    assert all(accepted(SequenceCheck(), numbers))
    assert all(accepted(SequenceCheck(), [*range(100), 100 - MAX_LATE, 100]))


def test_a_sequence_gap_costs_a_few_packets_and_a_pause_costs_none() -> None:
    accepted_flags = accepted(SequenceCheck(), [*range(50), *range(150, 200)])
    assert accepted_flags == [True] * 50 + [False] * (MIN_SERIES_PACKETS - 1) + [True] * (50 - MIN_SERIES_PACKETS + 1)
    sequence = SequenceCheck()
    assert all(accepted(sequence, range(50))) and all(accepted(sequence, range(150, 160), begin_ns=10 * S))


def interleaved(numbers: list[int], forged: list[int]) -> list[tuple[int, bool]]:
    """-> (sequence number, is forged); one forged packet after every third true one."""
    mixed: list[tuple[int, bool]] = []
    for i, number in enumerate(numbers):
        mixed.append((number % 256, False))
        if i % 3 == 0 and i // 3 < len(forged):
            mixed.append((forged[i // 3] % 256, True))
    return mixed


def test_of_two_interleaved_series_the_first_one_is_accepted() -> None:
    sequence = SequenceCheck()
    assert all(accepted(sequence, range(100)))
    mixed = interleaved(list(range(100, 2500)), list(range(200, 1000)))
    accepted_flags = [
        (forged, not sequence.rejection_reason(n, 3 * S + i * 9 * MS)) for i, (n, forged) in enumerate(mixed)
    ]
    true = [answer for forged, answer in accepted_flags if not forged]
    false = [answer for forged, answer in accepted_flags if forged]
    assert sum(true) / len(true) > 0.95
    # The faster series crosses the other's numbers occasionally; the other checks then have to reject its packets.
    assert sum(false) / len(false) < 0.05


def test_a_sender_with_constant_numbers_is_rejected_beside_one_that_counts() -> None:
    sequence = SequenceCheck()
    assert all(accepted(sequence, range(100, 200)))
    mixed = interleaved(list(range(200, 240)), [5] * 13)
    accepted_flags = [
        (forged, not sequence.rejection_reason(n, 3 * S + i * 9 * MS)) for i, (n, forged) in enumerate(mixed)
    ]
    assert accepted_flags == [(forged, not forged) for forged, _ in accepted_flags]


def test_a_few_stray_packets_are_not_a_second_sender() -> None:
    sequence = SequenceCheck()
    stray = [*range(50), 200, *range(50, 58), 201, 202, *range(58, 62)]
    assert accepted(sequence, stray).count(False) == 3
    assert all(accepted(sequence, [*range(62 + MAX_LOST, 90)], begin_ns=2 * S))  # losses are tolerated as before


def test_losses_are_tolerated_again_after_the_second_sender_times_out() -> None:
    sequence = SequenceCheck()
    accepted(sequence, [n for pair in zip(range(60), range(150, 210), strict=True) for n in pair])
    gap = [*range(60, 70), *range(80, 90)]
    assert not all(accepted(sequence, gap, begin_ns=3 * S))
    assert all(accepted(sequence, range(90, 100), begin_ns=3 * S + SECOND_SENDER_TIMEOUT_NS))
    assert all(accepted(sequence, range(110, 120), begin_ns=3 * S + SECOND_SENDER_TIMEOUT_NS + 200 * MS))


# --- time since boot ---


def test_continuous_time_since_boot_is_accepted_through_the_wrap_after_49_days() -> None:
    clock = BootClock()
    for i in range(200):
        assert not clock.rejection_reason((WRAP_MS - 2000 + i * 20) % WRAP_MS, S + i * 20 * MS)
    assert clock.reboots == 0
    assert (boot_step_ms(WRAP_MS - 5, 5), boot_step_ms(5, WRAP_MS - 5)) == (10, -10)


def test_times_since_boot_out_of_order_within_the_limit_are_accepted() -> None:
    clock = BootClock()
    assert not clock.rejection_reason(100_000, S)
    assert not clock.rejection_reason(100_000 - MAX_BACKWARD_STEP_MS, S + MS)
    assert clock.rejection_reason(100_000 - MAX_BACKWARD_STEP_MS - 1, S + 2 * MS)


@pytest.mark.parametrize("step_s", [-60, 8, 60])
def test_a_stepped_time_since_boot_is_rejected_while_the_continuous_one_is_received(step_s: int) -> None:
    clock = BootClock()
    for i in range(1000):
        now_ns, boot_ms = S + i * 20 * MS, 100_000 + i * 20
        assert not clock.rejection_reason(boot_ms, now_ns)
        assert i == 0 or f"steps by {step_s}.0 s" in clock.rejection_reason(boot_ms + step_s * 1000, now_ns)
    assert clock.reboots == 0


def test_a_reboot_is_accepted_after_one_second_of_only_the_new_time() -> None:
    clock = BootClock()
    clock.rejection_reason(100_000, S)
    accepted_flags = [bool(clock.rejection_reason(i * 20, 2 * S + i * 20 * MS)) for i in range(100)]
    assert accepted_flags == [True] * (BOOT_CONFIRM_NS // (20 * MS)) + [False] * (100 - BOOT_CONFIRM_NS // (20 * MS))
    assert clock.reboots == 1


def test_time_since_boot_may_advance_by_the_duration_of_a_pause() -> None:
    clock = BootClock()
    clock.rejection_reason(100_000, S)
    assert not clock.rejection_reason(400_000, 301 * S)
    assert clock.reboots == 0


# --- attitude against gyroscopes ---

RATE = 2.0  # rad/s: 115 degrees a second


def accepted_attitudes(
    rolls: list[tuple[float, float]], *, rate: float = 0.0, message_rate: float = 0.0, readings: bool = True
) -> list[bool]:
    """(s, roll) of attitudes -> whether each is accepted. Gyroscopes at 33 Hz measure ``rate`` [rad/s]; the attitude
    messages contain the rate ``message_rate``."""
    check, accepted_flags, fed = TurnCheck(), [], 0
    for t_s, roll in rolls:
        while readings and fed * 0.03 <= t_s:
            check.add(round(fed * 0.03 * S), (rate, 0.0, 0.0))
            fed += 1
        accepted_flags.append(
            not check.rejection_reason(attitude_sample(round(t_s * S), (1.0, 0.1, roll), (message_rate, 0.0, 0.0)))
        )
    return accepted_flags


def at_25_hz(seconds: float, begin_s: float = 0.0) -> list[float]:
    return [begin_s + i * 0.04 for i in range(round(seconds * 25))]


def test_a_turn_that_the_gyroscopes_measured_is_accepted() -> None:
    assert all(accepted_attitudes([(t, RATE * t) for t in at_25_hz(2.0)], rate=RATE))
    assert all(accepted_attitudes([(t, RATE * t) for t in at_25_hz(2.0)], message_rate=RATE, readings=False))


def test_a_slow_attitude_correction_is_accepted() -> None:
    """5 degrees/s were measured when an EKF regained a position."""
    assert all(accepted_attitudes([(t, math.radians(5.0) * t) for t in at_25_hz(4.0)]))


@pytest.mark.parametrize("readings", [True, False])
def test_a_forged_tilt_between_true_attitudes_is_rejected(readings: bool) -> None:
    tilt = 1.2 * JUMP_RAD
    rolls = [pair for t in at_25_hz(5.0) for pair in ((t, 0.0), (t + 0.02, tilt))]
    assert accepted_attitudes(rolls, readings=readings) == [True, False] * 125


def test_a_tilt_step_below_the_threshold_is_accepted() -> None:
    assert all(accepted_attitudes([(t, 0.8 * JUMP_RAD * (i % 2)) for i, t in enumerate(at_25_hz(2.0))]))


def test_the_attitude_tolerance_grows_with_the_turned_angle() -> None:
    assert accepted_attitudes([(0.0, 0.0), (0.9, 3.0 * 0.9 * 1.08)], rate=3.0) == [True, True]
    assert accepted_attitudes([(0.0, 0.0), (0.9, 3.0 * 0.9 * 1.20)], rate=3.0) == [True, False]
    assert accepted_attitudes([(0.0, 0.0), (0.1, 3.0 * 0.1 * 1.7)], message_rate=3.0, readings=False) == [True, True]
    assert accepted_attitudes([(0.0, 0.0), (0.1, 3.0 * 0.1 * 2.2)], message_rate=3.0, readings=False) == [True, False]


def test_forged_rates_in_attitude_messages_do_not_explain_a_tilt() -> None:
    rolls = [pair for t in at_25_hz(2.0) for pair in ((t, 0.0), (t + 0.02, 0.5))]
    assert accepted_attitudes(rolls, message_rate=25.0) == [True, False] * 50
    assert accepted_attitudes(rolls, message_rate=math.nan, readings=False) == [True, False] * 50


def test_a_reset_attitude_is_accepted_after_one_second_of_only_the_new_attitude() -> None:
    rolls = [(t, 0.0 if t < 1.0 else 0.5) for t in at_25_hz(4.0)]
    assert accepted_attitudes(rolls) == [True] * 25 + [False] * 25 + [True] * 50


def test_an_attitude_that_keeps_jumping_is_rejected() -> None:
    rolls = [(t, 0.0 if t < 1.0 else 0.5 * (i % 5 + 1)) for i, t in enumerate(at_25_hz(4.0))]
    assert accepted_attitudes(rolls) == [True] * 25 + [False] * 75


def test_attitudes_too_far_apart_to_compare_are_accepted() -> None:
    assert accepted_attitudes([(0.0, 0.0), (1.2, 0.5)]) == [True, True]
    assert accepted_attitudes([(0.0, 0.0), (0.25, 0.5)], readings=False) == [True, True]


# --- all checks on one connection ---


class Wire(WiredEdge):
    """The edge with an autopilot, and a forger with the same system id behind the same router."""

    def __init__(self) -> None:
        super().__init__()
        self.true, self.forger = (mavlink.MAVLink(None, 7, 1) for _ in range(2))
        self.forger.seq = 128

    def run(self, seconds: float, forged: Any = None) -> None:
        """``forged``: milliseconds since boot -> message of the forger."""
        for i in range(round(seconds * 50)):
            now_ns = S + self._steps * 20 * MS
            boot_ms = now_ns // MS
            beat = [heartbeat()] if i % 50 == 0 else []
            true = [*beat, raw(boot_ms + self.imu_ahead_ms), attitude(boot_ms, 0.0)]
            self.wire.arrive(*(packed(x, self.true) for x in true))
            if forged is not None:
                self.wire.arrive(packed(forged(boot_ms), self.forger))
            self.poll(now_ns)
            self._steps += 1

    _steps, imu_ahead_ms = 0, 0

    def verdicts(self) -> list[m.MeasurementVerdict]:
        return [x for x in self.published if isinstance(x, m.MeasurementVerdict)]

    def faults(self) -> list[tuple[str, bool]]:
        return [(x.quantity, x.active) for x in self.published if isinstance(x, m.CalibrationFault)]


def attitude(boot_ms: int, roll: float) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ms, roll, 0.1, 1.0, 0, 0, 0)


def raw(boot_ms: int) -> Any:
    return mavlink.MAVLink_raw_imu_message(boot_ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0)


def test_telemetry_of_one_sender_gets_no_verdict() -> None:
    wire = Wire()
    wire.run(20.0)
    assert len(states(wire.published)) == 1000 and wire.verdicts() == [] and wire.texts() == []


def test_a_forged_tilt_is_not_published_and_is_recorded() -> None:
    wire = Wire()
    wire.run(2.0)
    wire.run(20.0, lambda boot_ms: attitude(boot_ms, 0.4))
    rolls = [state.roll_rad for state in states(wire.published)]
    assert set(rolls) == {0.0} and len(rolls) > 0.9 * 1100
    reasons = {verdict.detail.split(":")[0] for verdict in wire.verdicts()}
    assert {v.measurement for v in wire.verdicts()} == {"telemetry"} and "sequence" in reasons
    assert ("telemetry of two senders", True) in wire.faults()
    assert "telemetry refused, sequence" in wire.status().detail


def test_a_forged_tilt_with_valid_sequence_numbers_is_rejected_by_the_gyroscopes() -> None:
    wire = Wire()
    wire.run(2.0)
    wire.forger = wire.true  # continues the sequence numbers of the autopilot
    wire.run(5.0, lambda boot_ms: attitude(boot_ms, 0.4))
    assert {state.roll_rad for state in states(wire.published)} == {0.0}
    assert {verdict.detail.split(":")[0] for verdict in wire.verdicts()} == {"attitude"}
    assert wire.faults() == [("attitude jumps without gyros", True)]


def test_nan_attitudes_do_not_disable_the_attitude_check() -> None:
    wire = Wire()
    wire.forger = wire.true
    wire.run(2.0)
    wire.run(2.0, lambda boot_ms: attitude(boot_ms, math.nan if boot_ms % 40 else 0.4))
    assert {state.roll_rad for state in states(wire.published)} == {0.0}


def test_a_forged_height_is_rejected_by_its_time_since_boot() -> None:
    wire = Wire()
    wire.forger = wire.true
    wire.run(2.0)
    wire.run(5.0, lambda _: mavlink.MAVLink_global_position_int_message(5, 1, 2, 0, 99_000, 0, 0, 0, 0))
    assert {state.agl_m for state in states(wire.published)} == {None}
    assert {verdict.detail.split(":")[0] for verdict in wire.verdicts()} == {"boot time"}


def test_imu_messages_may_use_another_clock_origin() -> None:
    wire = Wire()
    wire.imu_ahead_ms = 60_000
    wire.run(4.0)
    assert len(states(wire.published)) == 200
    wire.forger = wire.true
    wire.run(2.0, lambda boot_ms: attitude(boot_ms, 0.4))
    assert {state.roll_rad for state in states(wire.published)} == {0.0}


def test_forged_imu_messages_are_rejected_by_their_time_since_boot() -> None:
    wire = Wire()
    wire.run(2.0)
    wire.forger = wire.true
    wire.run(2.0, lambda boot_ms: mavlink.MAVLink_raw_imu_message(5000, 0, 0, -1000, 9000, 0, 0, 0, 0, 0))
    rates = [sample[4] for x in wire.published if isinstance(x, m.Imu) for sample in x.samples]
    assert rates and set(rates) == {0.0} and len(states(wire.published)) == 200


def test_a_reboot_drops_the_height_of_the_previous_boot() -> None:
    link = WiredEdge()

    def published_agl(now_ns: int, boot_ms: int, height_m: float | None = None) -> list[float | None]:
        height = mavlink.MAVLink_global_position_int_message
        heights = [] if height_m is None else [height(boot_ms, 1, 2, 0, round(height_m * 1e3), 0, 0, 0, 0)]
        return [state.agl_m for state in states(link.receives(now_ns, heartbeat(), *heights, attitude(boot_ms, 0.0)))]

    assert published_agl(10 * S, 100_000, 50.0) == [50.0]
    after = [agl for i in range(60) for agl in published_agl(10 * S + 500 * MS + i * 20 * MS, 1000 + i * 20)]
    assert after and set(after) == {None}
    assert published_agl(12 * S, 2500, 3.0) == [3.0]
