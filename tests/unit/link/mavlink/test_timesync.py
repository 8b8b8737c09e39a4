"""GPS week and leap seconds, TIMESYNC with the autopilot's clock, and the send schedule."""

import random
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import pytest

from link_rig import MS, TICK_NS, S
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.link.output import gps_time
from terrafix.link.output.send_schedule import SendSchedule


def unix_ns(text: str) -> int:
    return round(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()) * S


@pytest.mark.parametrize(
    ("utc", "week", "seconds"),
    [
        ("1980-01-06T00:00:00", 0, 0),  # the epoch of GPS time
        ("1999-08-21T23:59:47", 1024, 0),  # first rollover of the 10 bit week, 13 leap seconds
        ("2019-04-06T23:59:42", 2048, 0),  # second rollover, 18 leap seconds
        ("2016-12-31T23:59:59", 1930, 16),  # 17 leap seconds until the one at the end of this second,
        ("2017-01-01T00:00:00", 1930, 18),  # 18 after it
        ("2026-11-21T12:00:00", 2445, 6 * 86_400 + 43_218),
    ],
)
def test_gps_week_of_known_dates(utc: str, week: int, seconds: int) -> None:
    assert gps_time.week_and_ms(unix_ns(utc)) == (week, seconds * 1000)


def test_gps_week_agrees_with_calendar_arithmetic() -> None:
    rng = random.Random(1)
    for _ in range(200):
        t_ns = rng.randrange(unix_ns("2017-01-02T00:00:00"), unix_ns("2035-01-01T00:00:00"))
        week, ms = gps_time.week_and_ms(t_ns)
        assert 0 <= ms < gps_time.WEEK_MS
        since = datetime(1980, 1, 6) + timedelta(weeks=week, milliseconds=ms) - timedelta(seconds=18)
        assert abs((since - datetime(1970, 1, 1)).total_seconds() * 1e3 - t_ns / 1e6) < 1.1


def test_the_leap_second_table_ends_at_18_and_has_valid_dates() -> None:
    assert gps_time.gps_minus_utc_s(gps_time.GPS_EPOCH_UNIX_S) == 0
    assert gps_time.gps_minus_utc_s(unix_ns("2030-01-01T00:00:00") // S) == 18
    assert all(a < b for a, b in pairwise(gps_time.LEAP_SECONDS_UNIX_S))
    for at in gps_time.LEAP_SECONDS_UNIX_S:  # only ever at midnight of 1 January or 1 July
        date = datetime.fromtimestamp(at, UTC)
        assert (date.month, date.day, date.hour, date.minute, date.second) in [(1, 1, 0, 0, 0), (7, 1, 0, 0, 0)]


@pytest.mark.parametrize("year", [1970, 2000, 2006, 2024, 2046, 2200])
def test_an_implausible_year_is_rejected(year: int) -> None:
    assert not gps_time.is_plausible(unix_ns(f"{year}-06-01T00:00:00"))
    assert gps_time.is_plausible(unix_ns("2026-06-01T00:00:00"))


def test_a_date_off_by_one_week_counter_rollover_is_implausible() -> None:
    for utc in ("2025-01-01T00:00:00", "2026-06-01T00:00:00", "2044-06-01T00:00:00"):
        assert gps_time.is_plausible(unix_ns(utc))
        for rounds in (-1, 1):
            assert not gps_time.is_plausible(unix_ns(utc) + rounds * 1024 * 7 * 24 * 3600 * S)


class OtherClock:
    """Another clock behind a connection with delay; responds to TIMESYNC."""

    def __init__(self, offset_s: float, drift: float, seed: int = 0) -> None:
        self.offset_s, self.drift, self.rng = offset_s, drift, random.Random(seed)

    def time_ns(self, ours_ns: int) -> int:
        return ours_ns + round(self.offset_s * S + self.drift * ours_ns)

    def exchange(self, sync: TimeSync, now_ns: int, slow: float = 0.2) -> None:
        """A fast connection on which a share ``slow`` of the responses is delayed in one direction."""
        there, back = (self.rng.uniform(0.3, 1.0) * MS for _ in range(2))
        if self.rng.random() < slow:
            back += self.rng.uniform(5, 40) * MS
        request = sync.request(now_ns)
        sync.on_response(self.time_ns(now_ns + round(there)), request, now_ns + round(there + back))


@pytest.mark.parametrize("drift", [0.0, 40e-6, -40e-6])
def test_timesync_follows_offset_and_drift_within_a_millisecond(drift: float) -> None:
    sync, autopilot = TimeSync(), OtherClock(-1234.5, drift)
    assert sync.to_local_ns(1) is None
    for second in range(5000, 5100):
        autopilot.exchange(sync, second * S)
        if second > 5015:
            at_ns = second * S + 700 * MS
            ours = sync.to_local_ns(autopilot.time_ns(at_ns))
            assert ours is not None
            assert abs(ours - at_ns) < 1 * MS


def test_timesync_ignores_one_outlier_and_follows_a_reboot() -> None:
    sync, autopilot = TimeSync(), OtherClock(500.0, 0.0)
    for second in range(20):
        autopilot.exchange(sync, second * S, slow=0.0)
    before = sync.offset_at_ns(20 * S)
    assert before is not None
    sync.on_response(autopilot.time_ns(20 * S) + 3 * S, sync.request(20 * S), 20 * S + MS)
    assert sync.offset_at_ns(20 * S) == before
    rebooted = OtherClock(-5.0, 0.0)
    for second in range(21, 30):
        rebooted.exchange(sync, second * S, slow=0.0)
    after = sync.offset_at_ns(30 * S)
    assert after is not None
    assert abs(after - rebooted.offset_s * S) < 1 * MS
    assert sync.resets == 1


def test_timesync_ignores_responses_to_other_requests() -> None:
    sync = TimeSync()
    sync.request(1 * S)
    sync.on_response(5 * S, 1 * S + 1, 2 * S)
    sync.on_response(0, 1 * S, 1 * S + MS)
    assert sync.offset_at_ns(2 * S) is None


def sent_times(rate_hz: float, ticks: list[int]) -> list[int]:
    pacer = SendSchedule(rate_hz, 50.0)
    return [t for t in ticks if pacer.due(t)]


def jittered(seconds: float, jitter_ns: int, seed: int = 0) -> list[int]:
    rng = random.Random(seed)
    return [i * TICK_NS + rng.randrange(jitter_ns + 1) for i in range(int(seconds * 50))]


def gaps_ms(times: list[int]) -> list[float]:
    return sorted((b - a) / MS for a, b in pairwise(times))


@pytest.mark.parametrize("jitter_ms", [0, 5, 15])
def test_sends_at_10_hz_hold_their_interval_with_tick_jitter(jitter_ms: int) -> None:
    gaps = gaps_ms(sent_times(10.0, jittered(100.0, jitter_ms * MS)))
    assert len(gaps) in range(995, 1001)
    assert gaps[int(0.99 * len(gaps))] <= 120.0 + jitter_ms
    assert gaps[-1] < 245.0
    assert gaps[0] >= 50.0


@pytest.mark.parametrize("rate_hz", [5.0, 7.0, 10.0, 12.5, 15.0])
def test_the_mean_send_rate_is_the_configured_rate(rate_hz: float) -> None:
    times = sent_times(rate_hz, jittered(60.0, 3 * MS))
    assert len(times) / 60.0 == pytest.approx(rate_hz, rel=0.01)


def test_sends_missed_in_a_stall_are_dropped_and_the_time_grid_stays() -> None:
    ticks = [t for t in jittered(20.0, 0) if not 5 * S < t < 5 * S + 650 * MS]
    times = sent_times(10.0, ticks)
    assert gaps_ms(times)[0] >= 50.0
    assert times[-1] % (100 * MS) == times[0] % (100 * MS)


def test_late_sends_keep_the_minimum_interval_of_the_ekf() -> None:
    rng = random.Random(3)
    ticks = [t for t in jittered(60.0, 18 * MS) if rng.random() > 0.3]
    gaps = gaps_ms(sent_times(10.0, ticks))
    assert gaps[0] >= 50.0
    assert gaps[-1] < 245.0
