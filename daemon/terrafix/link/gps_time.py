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

# A board without a battery-backed clock starts in 1970, or at the date of its image; nothing flies this before 2025.
EARLIEST_PLAUSIBLE_UNIX_NS = 1_735_689_600 * NS_PER_S  # 2025-01-01
LATEST_PLAUSIBLE_UNIX_NS = 4_102_444_800 * NS_PER_S  # 2100-01-01


def plausible(unix_ns: int) -> bool:
    """A wall clock that can be right."""
    return EARLIEST_PLAUSIBLE_UNIX_NS <= unix_ns < LATEST_PLAUSIBLE_UNIX_NS


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
