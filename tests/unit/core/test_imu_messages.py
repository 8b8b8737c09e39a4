"""IMU messages of MAVLink, live and from a log: units, time, batches, selection of one stream."""

import math
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import MS, S
from link_wire import armed, decoded
from terrafix.core.mavlink.imu import boot_ns, imu_readings
from terrafix.core.mavlink.tlog import read_imu, record
from terrafix.link.autopilot.telemetry import TelemetryDecoder
from terrafix.link.mavlink.timesync import TimeSync
from terrafix.messages import Imu

G = 9.80665
T0_US = 1_700_000_000_000_000


def raw(boot_us: int, forward_mg: int = 100) -> Any:
    return mavlink.MAVLink_raw_imu_message(boot_us, forward_mg, -20, -1000, 10, -20, 500, 0, 0, 0)


def scaled(boot_ms: int, second: bool = False) -> Any:
    make = mavlink.MAVLink_scaled_imu2_message if second else mavlink.MAVLink_scaled_imu_message
    return make(boot_ms, 300, -20, -1000, 10, -20, 500, 0, 0, 0)


def highres(boot_us: int) -> Any:
    return mavlink.MAVLink_highres_imu_message(boot_us, 1.5, -0.2, -9.8, 0.01, -0.02, 0.5, *(0.0,) * 7, 63)


def published(messages: list[tuple[int, Any]]) -> list[Imu]:
    """(arrival time, message) -> published Imu messages."""
    telemetry = TelemetryDecoder(TimeSync())
    telemetry.on_message(decoded(armed()), 0)
    answers = [telemetry.on_message(decoded(message), now_ns) for now_ns, message in messages]
    return [a for a in answers if isinstance(a, Imu)]


def test_imu_messages_are_converted_to_si_units() -> None:
    expected = (0.1 * G, -0.02 * G, -G, 0.01, -0.02, 0.5)
    assert imu_readings(decoded(raw(1000))) == pytest.approx(expected)
    assert imu_readings(decoded(scaled(1))) == pytest.approx((0.3 * G, *expected[1:]))
    assert imu_readings(decoded(scaled(1, second=True))) == pytest.approx((0.3 * G, *expected[1:]))
    assert imu_readings(decoded(highres(1000))) == pytest.approx((1.5, -0.2, -9.8, 0.01, -0.02, 0.5))


def test_saturated_and_nan_imu_readings_are_rejected() -> None:
    assert imu_readings(decoded(raw(1000, forward_mg=32767))) is None  # saturated
    broken = highres(1000)
    broken.zacc = math.nan
    assert imu_readings(broken) is None


def test_time_since_boot_is_read_and_unix_time_is_rejected() -> None:
    assert boot_ns(raw(1_234_567)) == 1_234_567_000
    assert boot_ns(scaled(1_234)) == 1_234_000_000
    assert boot_ns(raw(T0_US)) is None  # a UNIX time
    assert boot_ns(raw(0)) is None


def test_imu_samples_are_published_in_short_batches() -> None:
    imus = published([(i * 20 * MS, raw(0)) for i in range(1, 31)])
    assert len(imus) == 10
    assert [len(imu.samples) for imu in imus] == [3] * 10
    assert [imu.t_ns for imu in imus[:2]] == [60 * MS, 120 * MS]
    assert [before_ns for before_ns, *_ in imus[0].samples] == [40 * MS, 20 * MS, 0]
    assert imus[0].samples[0][1:] == pytest.approx((0.1 * G, -0.02 * G, -G, 0.01, -0.02, 0.5))


def forces(messages: list[tuple[int, Any]]) -> list[tuple[int, float]]:
    """(time [ns], force forward [G]) of every published sample: 0.1 from RAW_IMU, 0.3 from SCALED_IMU, SCALED_IMU2."""
    batches = [(imu.t_ns, imu.samples) for imu in published(messages)]
    return [(t_ns - before_ns, round(force / G, 1)) for t_ns, batch in batches for before_ns, force, *_ in batch]


def test_another_imu_stream_is_selected_when_the_first_one_stops() -> None:
    messages: list[tuple[int, Any]] = []
    for i in range(1, 200):
        now_ns = i * 20 * MS
        if now_ns < S:
            messages.append((now_ns, raw(0)))
        messages.append((now_ns, scaled(0)))
    samples = forces(messages)
    assert {force for t_ns, force in samples if t_ns < S} == {0.1}
    assert {force for t_ns, force in samples if t_ns > 1.1 * S} == {0.3}


@pytest.mark.parametrize("second", [False, True])
def test_a_slow_first_imu_stream_is_replaced_by_a_faster_one(second: bool) -> None:
    messages: list[tuple[int, Any]] = []
    for i in range(300):
        if i % 33 == 0:
            messages.append((i * 30 * MS, scaled(0, second)))
        messages.append((i * 30 * MS + MS, raw(0)))
    samples = forces(messages)
    assert [force for _, force in samples].count(0.3) == 1  # the very first
    assert {force for t_ns, force in samples if t_ns > 200 * MS} == {0.1}


def test_the_selection_does_not_alternate_between_equally_fast_imu_streams() -> None:
    messages = [(i * 30 * MS, [raw(0), scaled(0), scaled(0, second=True)][i % 3]) for i in range(300)]
    assert {force for _, force in forces(messages)} == {0.1}


def test_imu_messages_of_another_system_or_component_are_ignored() -> None:
    telemetry = TelemetryDecoder(TimeSync())
    telemetry.on_message(decoded(armed()), 0)
    for i in range(1, 20):
        assert telemetry.on_message(decoded(raw(0), sysid=9), i * 20 * MS) is None
        assert telemetry.on_message(decoded(raw(0), compid=154), i * 20 * MS) is None


# --- logs ---------------------------------------------------------------------------------------------------------


def log(path: Path, records: list[tuple[float, Any]]) -> Path:
    """Writes a log of (arrival time [s], message)."""
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    path.write_bytes(b"".join(record(T0_US + round(t_s * 1e6), bytes(m.pack(mav))) for t_s, m in records))
    return path


def times_s(imus: list[Imu]) -> list[float]:
    return [(imu.t_ns - before_ns) / 1e9 for imu in imus for before_ns, *_ in imu.samples]


def test_a_log_gives_imu_samples_with_the_intervals_of_the_autopilot_clock(tmp_path: Path) -> None:
    """Arrival times have a jitter of up to 80 ms; the sampling interval is 20 ms."""
    late = [0.0, 0.03, 0.08, 0.01, 0.05]
    records = [(0.0, armed())]
    records += [(0.5 + 0.02 * i + late[i % 5], raw(7_000_000 + 20_000 * i)) for i in range(100)]
    imus = read_imu(log(tmp_path / "a.tlog", records))
    assert times_s(imus) == pytest.approx([0.5 + 0.02 * i for i in range(100)], abs=1e-6)
    assert all(before_ns <= 120 * MS for imu in imus for before_ns, *_ in imu.samples)
    moved = read_imu(log(tmp_path / "a.tlog", records), T0_US + 500_000)
    assert times_s(moved) == pytest.approx([0.02 * i for i in range(100)], abs=1e-6)


def test_a_log_with_a_reboot_of_the_autopilot_gives_all_imu_samples(tmp_path: Path) -> None:
    records = [(1.0 + 0.02 * i, raw(50_000_000 + 20_000 * i)) for i in range(50)]
    records += [(9.0 + 0.02 * i, raw(1_000_000 + 20_000 * i)) for i in range(50)]
    sampled_s = times_s(read_imu(log(tmp_path / "a.tlog", records), T0_US))
    assert sampled_s == pytest.approx([start_s + 0.02 * i for start_s in (1.0, 9.0) for i in range(50)], abs=1e-6)


def test_a_log_without_imu_messages_gives_no_samples(tmp_path: Path) -> None:
    assert read_imu(log(tmp_path / "a.tlog", [(0.0, armed())])) == []
