"""Clocks, rails, fans and power mode from a sysfs tree as on a Jetson Orin, and from files that cannot be read."""

import io
import json
from pathlib import Path

import pytest

from terrafix.core import logs
from terrafix.core.config import Config, HealthSection
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.health.node import HealthNode, make_edge
from terrafix.health.power import most_limited, read_clocks, read_fans, read_power_mode, read_rails, whole_computer_w
from terrafix.messages import Fan, Health, PowerRail, ProcessorClock, ThermalReading


def write(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text + "\n")


def orin(sysfs: Path) -> None:
    """Two CPU policies, a GPU, an INA3221 with two channels, a fan, and a chip that states its power."""
    policies = sysfs / "devices" / "system" / "cpu" / "cpufreq"
    write(policies / "policy0", scaling_cur_freq="729600", scaling_max_freq="1510400", cpuinfo_max_freq="2201600")
    write(policies / "policy4", scaling_cur_freq="1510400", scaling_max_freq="2201600", cpuinfo_max_freq="2201600")
    gpu = sysfs / "class" / "devfreq" / "17000000.gpu"
    write(gpu, cur_freq="306000000", max_freq="612000000", available_frequencies="306000000 612000000 918000000")
    hwmon = sysfs / "class" / "hwmon"
    write(
        hwmon / "hwmon1",
        name="ina3221",
        in1_label="VDD_IN",
        in1_input="5040",
        curr1_input="1500",
        in2_label="VDD_CPU_GPU_CV",
        in2_input="5000",
        curr2_input="400",
        in7_label="sum of shunt voltages",
        in7_input="3",
    )
    write(hwmon / "hwmon0", name="pwm_tach", fan1_input="2390")
    write(hwmon / "hwmon2", name="ina238", power1_input="12500000")


def test_clocks_have_the_present_limit_and_the_highest_of_the_hardware(tmp_path: Path) -> None:
    orin(tmp_path)
    clocks = read_clocks(tmp_path)
    assert clocks == [
        ProcessorClock(name="policy0", mhz=729.6, limit_mhz=1510.4, max_mhz=2201.6),
        ProcessorClock(name="policy4", mhz=1510.4, limit_mhz=2201.6, max_mhz=2201.6),
        ProcessorClock(name="17000000.gpu", mhz=306.0, limit_mhz=612.0, max_mhz=918.0),
    ]
    assert most_limited(clocks) == clocks[2]
    assert most_limited([]) is None


def test_a_clock_without_a_limit_may_reach_the_highest(tmp_path: Path) -> None:
    write(tmp_path / "class" / "devfreq" / "gpu", cur_freq="100000000", available_frequencies="100000000 400000000")
    (clock,) = read_clocks(tmp_path)
    assert (clock.limit_mhz, clock.max_mhz) == (400.0, 400.0)


def test_clocks_that_are_garbled_or_incomplete_are_left_out(tmp_path: Path) -> None:
    policies = tmp_path / "devices" / "system" / "cpu" / "cpufreq"
    write(policies / "policy0", scaling_cur_freq="<unsupported>", cpuinfo_max_freq="2201600")
    write(policies / "policy1", scaling_cur_freq="729600")
    write(policies / "policy2", scaling_cur_freq="729600", cpuinfo_max_freq="0")
    assert read_clocks(tmp_path) == []


def test_power_is_voltage_times_current_or_what_the_chip_states(tmp_path: Path) -> None:
    orin(tmp_path)
    rails = read_rails(tmp_path / "class" / "hwmon")
    assert [(rail.name, pytest.approx(rail.power_w)) for rail in rails] == [
        ("VDD_IN", 7.56),
        ("VDD_CPU_GPU_CV", 2.0),
        ("ina238 power1", 12.5),
    ]


def test_power_of_the_computer_is_that_of_the_rail_that_feeds_it_and_no_sum() -> None:
    rails = [PowerRail(name="VDD_SOC", power_w=1.0), PowerRail(name="VDD_IN", power_w=7.5)]
    assert whole_computer_w(rails) == 7.5
    assert whole_computer_w(rails[:1]) is None


def test_fans_have_their_speed(tmp_path: Path) -> None:
    orin(tmp_path)
    assert read_fans(tmp_path / "class" / "hwmon") == [Fan(name="pwm_tach fan1", rpm=2390)]


@pytest.mark.parametrize(
    ("status", "modes", "expected"),
    [
        ("pmode:0002 fmode:quiet", "< POWER_MODEL ID=0 NAME=MAXN >\n< POWER_MODEL ID=2 NAME=15W >", "2 (15W)"),
        ("pmode:0002", "< POWER_MODEL ID=0 NAME=MAXN >", "2"),
        ("garbled", "< POWER_MODEL ID=0 NAME=MAXN >", None),
    ],
)
def test_power_mode_of_nvpmodel(tmp_path: Path, status: str, modes: str, expected: str | None) -> None:
    assert read_power_mode(tmp_path / "status", tmp_path / "modes") is None
    write(tmp_path, status=status, modes=modes)
    assert read_power_mode(tmp_path / "status", tmp_path / "modes") == expected


def test_health_and_the_line_of_a_thermal_band_have_power_and_clock_of_the_reading(tmp_path: Path) -> None:
    orin(tmp_path)
    config = Config(health=HealthSection(sysfs_root=str(tmp_path)))
    edge = make_edge(NodeContext(config=config, frames=MemoryFrameStore(1), map_path=None, out_dir=tmp_path))
    (reading,) = edge.poll(0)
    assert isinstance(reading, ThermalReading)
    assert (len(reading.clocks), len(reading.rails), len(reading.fans)) == (3, 3, 1)
    (health,) = HealthNode(config.health).on(reading)
    assert isinstance(health, Health)
    found = health.power_w, health.clock_limit, health.clock_mhz
    assert found == (pytest.approx(7.56), pytest.approx(612 / 918), 612.0)
    writer = logs.configure("INFO", "health", stream := io.StringIO())
    edge.on_message(health)
    edge.on_message(health)  # the same band
    writer.close()
    (line,) = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert (line["event"], line["band"], line["clock_mhz"]) == ("thermal band", "normal", 612.0)
    assert (line["power_w"], line["clock_limit"]) == (pytest.approx(7.56, abs=0.01), pytest.approx(0.667, abs=0.001))
