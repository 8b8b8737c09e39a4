"""Repairs the time stamps of a telemetry log by the autopilot's own time since its start.

The computer that writes the log may begin in 1970, be set by NTP, by hand or to another time zone while it writes, and
a byte on its disk may be damaged. The least difference between stamp and time since the start (the packet with the
least latency) is constant while nothing of that happens; where it changes for good, the clock has jumped by as much.
Packets that were held back by the link change it for a while only, and keep their stamps."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from terrafix.core.mavlink.log_records import MAX_TIME_US

# A smaller change of the difference is a latency or a drift: 60 s are enough for 17 000 ppm.
MIN_JUMP_US = 1_000_000
WINDOW_US = 60_000_000  # of the least latency beside a jump; a link that holds packets back for longer has lost them
# Without the time since the start: a longer silence, or a step back, is a jump of unknown length.
MAX_SILENCE_US = 24 * 3600 * 1_000_000
# After an autopilot's packet its next one in sequence comes within this: it sends a heartbeat each second.
MAX_BETWEEN_US = 10_000_000
MAX_BREAKS_SHARE = 0.25  # of the times since the start; where more of them break, they are no clock
MIN_TIME_US = 946_684_800_000_000  # 2000-01-01; an earlier time is that of a computer without a clock


@dataclass(frozen=True)
class Jump:
    """The stamps from record ``index`` on are ``size_us`` later than those before it say. ``measured``: by the
    autopilot's time; else the length of the gap is not known and taken as none."""

    index: int
    size_us: int
    measured: bool


@dataclass(frozen=True)
class Repaired:
    times_us: list[int]  # of all records, on the clock of the longest stretch without a jump
    jumps: list[Jump]
    damaged_stamps: int


@dataclass
class _Stretch:
    """Records ``first`` to ``last`` with a time since the start, between which the clock did not jump."""

    first: int
    last: int
    count: int
    correction_us: int = 0  # to be added to its stamps


def repaired(stamps_us: Sequence[int], boot_us: Sequence[int | None], numbers: Sequence[int | None]) -> Repaired:
    """``stamps_us``: of all records. ``boot_us``: time since the start of one autopilot, None where a packet does not
    say it. ``numbers``: sequence numbers of that autopilot's packets, None for others."""
    stretches = _stretches(stamps_us, boot_us)
    if stretches is None:
        return _by_stamps(stamps_us)
    _correct(stretches, stamps_us, boot_us)
    plausible = [s for s in stretches if MIN_TIME_US <= stamps_us[s.first] < MAX_TIME_US]
    reference_us = max(plausible or stretches, key=lambda stretch: stretch.count).correction_us
    times_us, damaged = _placed(stamps_us, boot_us, stretches, reference_us)
    if _is_alone(times_us, numbers):
        times_us[0], damaged = times_us[1], damaged + 1
    jumps = [
        Jump(after.first, before.correction_us - after.correction_us, True)
        for before, after in pairwise(_lasting(stretches))
        if before.correction_us != after.correction_us
    ]
    return Repaired(times_us, jumps, damaged + sum(stretch.count == 1 for stretch in _brief(stretches)))


def _stretches(stamps_us: Sequence[int], boot_us: Sequence[int | None]) -> list[_Stretch] | None:
    """None: the log has no running time since the start."""
    timed = [i for i, value in enumerate(boot_us) if value is not None]
    if len(timed) < 2:
        return None
    stretches = [_Stretch(timed[0], timed[0], 1)]
    for before, now in pairwise(timed):
        passed_us = _boot(boot_us, now) - _boot(boot_us, before)
        change_us = stamps_us[now] - stamps_us[before] - passed_us
        restarted = passed_us < -MIN_JUMP_US
        if restarted or abs(change_us) > MIN_JUMP_US:
            stretches.append(_Stretch(now, now, 0))
        stretches[-1].last = now
        stretches[-1].count += 1
    return stretches if len(stretches) <= 1 + MAX_BREAKS_SHARE * len(timed) else None


def _correct(stretches: list[_Stretch], stamps_us: Sequence[int], boot_us: Sequence[int | None]) -> None:
    """Corrections relative to the clock of the first stretch."""
    used_us = [0]
    for i, (before, now) in enumerate(pairwise(stretches)):
        if _boot(boot_us, now.first) < _boot(boot_us, before.last) - MIN_JUMP_US:  # the autopilot has started again
            step_us = stamps_us[now.first] - stamps_us[before.last]
            jumped = not -MIN_JUMP_US <= step_us < MAX_SILENCE_US
        else:
            latest = next(s for s in reversed(stretches[: i + 1]) if s.correction_us == before.correction_us)
            step_us = _level(now, stamps_us, boot_us, from_start=True) - _level(
                latest, stamps_us, boot_us, from_start=False
            )
            jumped = abs(step_us) > MIN_JUMP_US
        wanted_us = before.correction_us - step_us if jumped else before.correction_us
        # A clock that comes back to where it was has the correction of then, not one with another latency in it.
        now.correction_us = next((c for c in reversed(used_us) if abs(c - wanted_us) < MIN_JUMP_US), wanted_us)
        used_us.append(now.correction_us)


def _level(stretch: _Stretch, stamps_us: Sequence[int], boot_us: Sequence[int | None], *, from_start: bool) -> int:
    """Least difference between stamp and time since the start, in the WINDOW_US at one end of a stretch."""
    end_us = _boot(boot_us, stretch.first if from_start else stretch.last)
    order = range(stretch.first, stretch.last + 1) if from_start else range(stretch.last, stretch.first - 1, -1)
    least_us: int | None = None
    for i in order:
        value = boot_us[i]
        if value is None:
            continue
        if abs(value - end_us) > WINDOW_US:
            break
        least_us = stamps_us[i] - value if least_us is None else min(least_us, stamps_us[i] - value)
    assert least_us is not None
    return least_us


def _placed(
    stamps_us: Sequence[int], boot_us: Sequence[int | None], stretches: list[_Stretch], reference_us: int
) -> tuple[list[int], int]:
    """-> times of all records, and the number of damaged stamps among those without a time since the start. Such a
    record has the clock of the autopilot's time before or after it that puts it between those two; if none does, its
    stamp is damaged, and it gets the time of the record before."""
    correction_us: dict[int, int] = {
        i: stretch.correction_us - reference_us
        for stretch in stretches
        for i in range(stretch.first, stretch.last + 1)
        if boot_us[i] is not None
    }
    timed = [*correction_us, None]
    times_us = [stamp + correction_us.get(i, 0) for i, stamp in enumerate(stamps_us)]
    first = stretches[0].first
    damaged = 0
    first_clocks = {stretch.correction_us - reference_us for stretch in stretches[:2]}
    for i in range(first - 1, -1, -1):
        low_us, high_us = times_us[i + 1] - MAX_SILENCE_US, times_us[i + 1] + MIN_JUMP_US
        fitting = [t for clock in first_clocks if low_us < (t := stamps_us[i] + clock) <= high_us]
        damaged += not fitting
        times_us[i] = max(fitting, default=times_us[i + 1])
    for before, after in pairwise(timed):
        assert before is not None
        until = len(stamps_us) if after is None else after
        last_us = times_us[before] + MAX_SILENCE_US if after is None else times_us[after]
        clocks = {correction_us[before], correction_us[before if after is None else after]}
        for i in range(before + 1, until):
            low_us, high_us = times_us[i - 1] - MIN_JUMP_US, last_us + MIN_JUMP_US
            fitting = [t for clock in clocks if low_us <= (t := stamps_us[i] + clock) <= high_us]
            damaged += not fitting
            times_us[i] = fitting[0] if fitting else times_us[i - 1]
    return times_us, damaged


def _is_alone(times_us: list[int], numbers: Sequence[int | None]) -> bool:
    """Whether the first record is an autopilot's packet that lies long before its next one, though none is missing
    between them: its stamp is damaged."""
    following = next((i for i in range(1, len(times_us)) if numbers[i] is not None), None)
    if following is None or numbers[0] is None:
        return False
    steps = (numbers[following] - numbers[0]) % 256  # type: ignore[operator]
    return steps <= 1 and times_us[following] - times_us[0] > MAX_BETWEEN_US


def _lasting(stretches: list[_Stretch]) -> list[_Stretch]:
    brief = _brief(stretches)
    return [stretch for stretch in stretches if stretch not in brief]


def _brief(stretches: list[_Stretch]) -> list[_Stretch]:
    """Single records with a clock of their own: damaged stamps."""
    clocks = {stretch.correction_us for stretch in stretches if stretch.count > 1}
    return [s for s in stretches if s.count == 1 and clocks and s.correction_us not in clocks]


def _by_stamps(stamps_us: Sequence[int]) -> Repaired:
    """Without the autopilot's time: stamps go on where they stopped after a step that no silence explains."""

    def follows(step_us: int) -> bool:
        return -MIN_JUMP_US <= step_us < MAX_SILENCE_US

    times_us: list[int] = []
    jumps: list[Jump] = []
    damaged, correction_us = 0, 0
    for i, stamp_us in enumerate(stamps_us):
        step_us = stamp_us + correction_us - times_us[-1] if times_us else 0
        following = stamps_us[i + 1 : i + 2]
        if not times_us and following and not follows(following[0] - stamp_us) and len(stamps_us) > 2:
            if follows(stamps_us[2] - stamps_us[1]) and not follows(stamps_us[2] - stamp_us):
                stamp_us, damaged = following[0], damaged + 1  # the first stamp alone is wrong
        elif not follows(step_us):
            if following and follows(following[0] + correction_us - times_us[-1]):
                stamp_us, damaged = times_us[-1] - correction_us, damaged + 1  # this one alone is wrong
            else:
                jumps.append(Jump(i, step_us, False))
                correction_us -= step_us
        times_us.append(stamp_us + correction_us)
    return Repaired(times_us, jumps, damaged)


def _boot(boot_us: Sequence[int | None], i: int) -> int:
    value = boot_us[i]
    assert value is not None
    return value
