"""GPS week and millisecond from Unix time, with the leap seconds.

GPS time runs without leap seconds from 1980-01-06 00:00:00 UTC (IS-GPS-200, 20.3.3.5.2.4); Unix time leaves them
out. The difference is the table below: the dates on which a leap second had just been inserted, from IERS
Bulletin C (the same list as ``leap-seconds.list`` of the IANA time zone database). None since 2017-01-01; the
27th General Conference on Weights and Measures (resolution 4) ends the practice by 2035."""

from bisect import bisect_right

GPS_EPOCH_UNIX_S = 315_964_800  # 1980-01-06 00:00:00 UTC
WEEK_MS = 7 * 24 * 3600 * 1000
NS_PER_S = 1_000_000_000

# Unix second from which GPS is ahead of UTC by (position in the list + 1) seconds.
LEAP_SECONDS_UNIX_S = (
    362_793_600,  # 1981-07-01
    394_329_600,  # 1982-07-01
    425_865_600,  # 1983-07-01
    489_024_000,  # 1985-07-01
    567_993_600,  # 1988-01-01
    631_152_000,  # 1990-01-01
    662_688_000,  # 1991-01-01
    709_948_800,  # 1992-07-01
    741_484_800,  # 1993-07-01
    773_020_800,  # 1994-07-01
    820_454_400,  # 1996-01-01
    867_715_200,  # 1997-07-01
    915_148_800,  # 1999-01-01
    1_136_073_600,  # 2006-01-01
    1_230_768_000,  # 2009-01-01
    1_341_100_800,  # 2012-07-01
    1_435_708_800,  # 2015-07-01
    1_483_228_800,  # 2017-01-01
)

# A board without a battery-backed clock starts in 1970, or at the date of its image; nothing flies this before 2025. A
# receiver counts weeks in 10 bits (IS-GPS-200, 20.3.3.3.1.1): one that takes them for those of another round is off by
# 1024 weeks, 19.6 years. So of two dates that may be mistaken so one alone is plausible. The range ends in August 2044.
EARLIEST_PLAUSIBLE_UNIX_NS = 1_735_689_600 * NS_PER_S  # 2025-01-01
LATEST_PLAUSIBLE_UNIX_NS = EARLIEST_PLAUSIBLE_UNIX_NS + 1024 * WEEK_MS * 1_000_000

STEP_NS = 500_000_000  # a wall clock that is off by less stays latched: the week keeps the monotonic clock's rhythm
CONFIRM_NS = 20 * NS_PER_S  # a step is believed when the clock has gone on from there for so long


def plausible(unix_ns: int) -> bool:
    """A wall clock that can be right."""
    return EARLIEST_PLAUSIBLE_UNIX_NS <= unix_ns < LATEST_PLAUSIBLE_UNIX_NS


class LatchedClock:
    """The wall clock as it was first heard, carried on by the monotonic one: GPS time in GPS_INPUT has no steps.

    A clock that steps may be right or wrong (a network that comes up; an autopilot that stepped by -25 hours and then
    by 20 years was measured). On the ground it is learnt anew when it has gone on from there for a while; in flight
    never: an autopilot that is told another time takes the next position for older, or for one of the future."""

    def __init__(self, unix_minus_monotonic_ns: int | None = None) -> None:
        """``unix_minus_monotonic_ns``: of a link that this one is started in the place of."""
        self._offset_ns = unix_minus_monotonic_ns
        self._new: tuple[int, int] | None = None  # (offset, monotonic time at which it was heard first)

    def hear(self, unix_ns: int, t_ns: int, *, in_flight: bool) -> str:
        """``unix_ns`` at ``t_ns`` of the monotonic clock. -> why it is not taken; empty: it is, or agrees."""
        if not plausible(unix_ns):
            return f"Unix time {unix_ns // NS_PER_S} cannot be"
        offset_ns = unix_ns - t_ns
        if self._offset_ns is None:
            self._offset_ns = offset_ns
        step_ns = offset_ns - self._offset_ns
        if abs(step_ns) <= STEP_NS:
            self._new = None
            return ""
        if self._new is None or abs(offset_ns - self._new[0]) > STEP_NS:
            self._new = (offset_ns, t_ns)
        if in_flight or t_ns - self._new[1] < CONFIRM_NS:
            return f"steps by {step_ns / NS_PER_S:.1f} s" + (" in flight" if in_flight else "")
        self._offset_ns, self._new = offset_ns, None
        return ""

    def week(self, t_ns: int) -> tuple[int, int]:
        """GPS week and its millisecond at ``t_ns``; (0, 0), "use the time of arrival", while no clock was plausible: a
        wrong week would set the autopilot's clock."""
        return (0, 0) if self._offset_ns is None else week_and_ms(t_ns + self._offset_ns)


def gps_minus_utc_s(unix_s: int) -> int:
    """Whole seconds by which GPS time is ahead of UTC at this Unix second."""
    return bisect_right(LEAP_SECONDS_UNIX_S, unix_s)


def week_and_ms(unix_ns: int) -> tuple[int, int]:
    """Unix time -> (GPS week since 1980, not wrapped at 1024; millisecond of the week, truncated)."""
    unix_s = unix_ns // NS_PER_S
    gps_ns = unix_ns + (gps_minus_utc_s(unix_s) - GPS_EPOCH_UNIX_S) * NS_PER_S
    return divmod(gps_ns // 1_000_000, WEEK_MS)


def unix_ms(week: int, week_ms: int) -> int | None:
    """The way back: GPS week and millisecond -> Unix milliseconds; None for week 0, "not known"."""
    if week == 0:
        return None
    gps_ms = week * WEEK_MS + week_ms + GPS_EPOCH_UNIX_S * 1000
    leap_s = gps_minus_utc_s(gps_ms // 1000)
    return gps_ms - gps_minus_utc_s(gps_ms // 1000 - leap_s) * 1000
