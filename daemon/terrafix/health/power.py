"""Clocks, power rails, fans and power mode of the computer, from files of the kernel and of nvpmodel.

cpufreq: https://docs.kernel.org/admin-guide/pm/cpufreq.html (kHz). devfreq: class/devfreq (Hz). hwmon:
https://docs.kernel.org/hwmon/sysfs-interface.html (mV, mA, microwatts, rpm). A Jetson measures its rails with INA3221
monitors, which have voltage and current of each channel and no power."""

import re
from pathlib import Path

from terrafix.health.sensor_files import read_number, read_text
from terrafix.messages import Fan, PowerRail, ProcessorClock

NVPMODEL_STATUS = Path("/var/lib/nvpmodel/status")  # "pmode:0002"
NVPMODEL_MODES = Path("/etc/nvpmodel.conf")  # "< POWER_MODEL ID=2 NAME=15W >"
# Rails that feed the whole module or board: Orin, Xavier NX and TX2 (VDD_IN), Nano (POM_5V_IN); names of
# https://docs.nvidia.com/jetson/archives/r36.4/DeveloperGuide/SD/PlatformPowerAndPerformance.html
WHOLE_COMPUTER_RAILS = ("VDD_IN", "POM_5V_IN", "5V_IN")


# Channels of an INA3221 with a bus voltage; in4 to in6 are the voltages at their shunts, in7 and curr4 the sums of all.
# [spec: docs.kernel.org/hwmon/ina3221.html]
INA3221, INA3221_CHANNELS = "ina3221", 3


def read_clocks(sysfs: Path) -> list[ProcessorClock]:
    """All CPU policies, then all devfreq devices, of the mount point ``sysfs``."""
    cpus = (sysfs / "devices" / "system" / "cpu" / "cpufreq").glob("policy*")
    others = (sysfs / "class" / "devfreq").glob("*")
    clocks = [
        _clock(folder, ("scaling_cur_freq", "scaling_max_freq", "cpuinfo_max_freq"), 1e3) for folder in sorted(cpus)
    ]
    clocks += [_clock(folder, ("cur_freq", "max_freq", "available_frequencies"), 1e6) for folder in sorted(others)]
    return [clock for clock in clocks if clock is not None]


def most_limited(clocks: list[ProcessorClock]) -> ProcessorClock | None:
    """-> the processor that may run at the lowest share of its highest clock; None without clocks."""
    return min(clocks, key=lambda clock: clock.limit_mhz / clock.max_mhz, default=None)


def read_rails(hwmon: Path) -> list[PowerRail]:
    """Channels with a power, or else with a bus voltage and a current. ``hwmon``: sysfs folder class/hwmon."""
    rails = []
    for device in sorted(hwmon.glob("hwmon*")):
        measured = set()
        for number in _channels(device, "power"):
            microwatts = read_number(device / f"power{number}_input")
            if microwatts is not None:
                measured.add(number)
                rails.append(PowerRail(name=_label(device, f"power{number}"), power_w=microwatts / 1e6))
        is_ina3221 = read_text(device / "name") == INA3221
        for number in _channels(device, "curr"):
            if number in measured or (is_ina3221 and number > INA3221_CHANNELS):
                continue
            millivolts, milliamperes = (read_number(device / f"{kind}{number}_input") for kind in ("in", "curr"))
            if millivolts is not None and milliamperes is not None:
                rails.append(PowerRail(name=_label(device, f"in{number}"), power_w=millivolts * milliamperes / 1e6))
    return rails


def whole_computer_w(rails: list[PowerRail]) -> float | None:
    """-> power of the rail that feeds the whole computer [W]; None without one.

    Rails are not added up: on most boards one of them feeds others."""
    return next((rail.power_w for rail in rails if rail.name in WHOLE_COMPUTER_RAILS), None)


def read_fans(hwmon: Path) -> list[Fan]:
    """Fans with a tachometer. ``hwmon``: sysfs folder class/hwmon."""
    fans = []
    for device in sorted(hwmon.glob("hwmon*")):
        for number in _channels(device, "fan"):
            rpm = read_number(device / f"fan{number}_input")
            if rpm is not None:
                fans.append(Fan(name=_label(device, f"fan{number}"), rpm=rpm))
    return fans


def read_power_mode(status: Path = NVPMODEL_STATUS, modes: Path = NVPMODEL_MODES) -> str | None:
    """Power mode of a Jetson, e.g. "2 (15W)"; "2" when ``modes`` does not name it; None where there is no nvpmodel."""
    found = re.search(r"pmode:\s*(\d+)", read_text(status) or "")
    if found is None:
        return None
    mode = int(found[1])
    names = re.findall(r"POWER_MODEL\s+ID=(\d+)\s+NAME=(\S+)", read_text(modes) or "")
    name = next((name for number, name in names if int(number) == mode), None)
    return f"{mode}" if name is None else f"{mode} ({name})"


def _clock(folder: Path, files: tuple[str, str, str], per_mhz: float) -> ProcessorClock | None:
    """``files``: names of present clock, present limit, and highest clock (or a list of clocks); the limit may be
    absent."""
    now, limit, available = files
    present = read_number(folder / now)
    choices = [int(text) for text in (read_text(folder / available) or "").split() if text.isdecimal()]
    if present is None or not choices or max(choices) <= 0:
        return None
    allowed = read_number(folder / limit)
    highest = max(choices)
    return ProcessorClock(
        name=folder.name,
        mhz=present / per_mhz,
        limit_mhz=(highest if allowed is None else min(allowed, highest)) / per_mhz,
        max_mhz=highest / per_mhz,
    )


def _channels(device: Path, kind: str) -> list[int]:
    """Numbers N of the files ``kind``N_input, in order."""
    numbers = (re.fullmatch(rf"{kind}(\d+)_input", path.name) for path in device.glob(f"{kind}*_input"))
    return sorted(int(number[1]) for number in numbers if number)


def _label(device: Path, channel: str) -> str:
    """Label of a channel, or "DEVICE CHANNEL" where it has none."""
    return read_text(device / f"{channel}_label") or f"{read_text(device / 'name') or device.name} {channel}"
