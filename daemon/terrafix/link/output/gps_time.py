"""GPS week and millisecond from Unix time, with the leap seconds.

GPS time starts at 1980-01-06 00:00:00 UTC and counts all seconds (IS-GPS-200, 20.3.3.5.2.4); Unix time does not count
leap seconds. The difference follows from the table below: the dates on which a leap second had just been inserted,
from IERS Bulletin C (the same list as ``leap-seconds.list`` of the IANA time zone database). There was none after
2017-01-01, and the 27th General Conference on Weights and Measures (resolution 4) ends the practice by 2035."""

from bisect import bisect_right

from terrafix.core.clock import NS_PER_S

GPS_EPOCH_UNIX_S = 315_964_800  # 1980-01-06 00:00:00 UTC [spec: IS-GPS-200]
WEEK_MS = 7 * 24 * 3600 * 1000  # [spec: unit]

# Unix second from which GPS time is ahead of UTC by (index + 1) seconds. [spec: IERS Bulletin C]
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

# A board without a battery-backed clock starts in 1970 or at the date of its image. This program does not fly before
# 2025. A receiver counts weeks with 10 bits (IS-GPS-200, 20.3.3.3.1.1); one with the wrong rollover is off by 1024
# weeks, 19.6 years. The range below has that length and ends in August 2044, so that only one of two dates that differ
# by a rollover is plausible.
EARLIEST_PLAUSIBLE_UNIX_NS = 1_735_689_600 * NS_PER_S  # 2025-01-01 [tuned]
LATEST_PLAUSIBLE_UNIX_NS = EARLIEST_PLAUSIBLE_UNIX_NS + 1024 * WEEK_MS * 1_000_000  # [spec: IS-GPS-200 10 bit week]

# Smaller differences of the wall clock are ignored, ns: GPS time keeps the rate of the monotonic clock. [tuned]
MIN_CLOCK_STEP_NS = 500_000_000
# ns for which a clock must stay at its new offset before the step is taken. [tuned]
CLOCK_STEP_CONFIRM_NS = 20 * NS_PER_S


def is_plausible(unix_ns: int) -> bool:
    """Whether a wall clock with this reading can be right."""
    return EARLIEST_PLAUSIBLE_UNIX_NS <= unix_ns < LATEST_PLAUSIBLE_UNIX_NS


class LatchedClock:
    """Wall time as the first plausible reading plus the monotonic clock, so that GPS time in GPS_INPUT has no steps.

    A step of the wall clock may be right or wrong: a network that comes up corrects it, and an autopilot was measured
    that stepped by -25 hours and then by 20 years. On the ground a step is taken after CLOCK_STEP_CONFIRM_NS at the new
    offset. In flight none is taken, because an autopilot takes a position with a stepped time for an older one or for
    one of the future."""

    def __init__(self, unix_minus_monotonic_ns: int | None = None) -> None:
        """``unix_minus_monotonic_ns``: offset of the link process that this one replaces, if there was one."""
        self._offset_ns = unix_minus_monotonic_ns
        self._candidate: tuple[int, int] | None = None  # (offset, monotonic time of its first reading)

    def update(self, unix_ns: int, t_ns: int, *, in_flight: bool) -> str:
        """``unix_ns``: reading at ``t_ns`` of the monotonic clock. -> reason of a rejection; empty when the reading is
        taken or agrees."""
        if not is_plausible(unix_ns):
            return f"Unix time {unix_ns // NS_PER_S} cannot be"
        offset_ns = unix_ns - t_ns
        if self._offset_ns is None:
            self._offset_ns = offset_ns
        step_ns = offset_ns - self._offset_ns
        if abs(step_ns) <= MIN_CLOCK_STEP_NS:
            self._candidate = None
            return ""
        if self._candidate is None or abs(offset_ns - self._candidate[0]) > MIN_CLOCK_STEP_NS:
            self._candidate = (offset_ns, t_ns)
        if in_flight or t_ns - self._candidate[1] < CLOCK_STEP_CONFIRM_NS:
            return f"steps by {step_ns / NS_PER_S:.1f} s" + (" in flight" if in_flight else "")
        self._offset_ns, self._candidate = offset_ns, None
        return ""

    def week_and_ms(self, t_ns: int) -> tuple[int, int]:
        """-> (GPS week, millisecond of the week) at ``t_ns`` of the monotonic clock; (0, 0), "use the time of arrival",
        while no reading was plausible, because a wrong week would set the autopilot's clock."""
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
    """Inverse of week_and_ms: GPS week and millisecond -> Unix milliseconds; None for week 0, "not known"."""
    if week == 0:
        return None
    gps_ms = week * WEEK_MS + week_ms + GPS_EPOCH_UNIX_S * 1000
    leap_s = gps_minus_utc_s(gps_ms // 1000)
    return gps_ms - gps_minus_utc_s(gps_ms // 1000 - leap_s) * 1000
