"""Edge of the health process: reads temperatures, cooling devices, clocks, power and free disk space once a second.

Files: https://docs.kernel.org/driver-api/thermal/sysfs-api.html (temperatures in thousandths of a degree Celsius).
A sensor that cannot be read is left out (on a Jetson the zones of powered-down units return EAGAIN)."""

import shutil
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from terrafix.core import logs
from terrafix.core.clock import Ticker
from terrafix.core.node import NodeContext
from terrafix.health.load import CpuLoad
from terrafix.health.power import read_clocks, read_fans, read_power_mode, read_rails
from terrafix.health.sensor_files import read_number, read_text
from terrafix.messages import Health, Message, TemperatureZone, ThermalBand, ThermalReading

RATE_HZ = 1.0  # readings per second
PLAUSIBLE_C = (-55.0, 150.0)  # degrees Celsius; broken sensors report -256 or 255; silicon works in -40..125
# Cooling devices that slow a processor down when their state is above 0: Jetson (cpu-throttle-alert, devfreq-...gpu),
# generic (cpufreq-cpu0, thermal-cpufreq-0), ACPI (Processor). Fans and warnings (hot-surface-alert) do not.
THROTTLING = ("throttle-alert", "cpufreq", "devfreq", "processor")


class HealthEdge:
    """Publishes ThermalReading; logs Health."""

    def __init__(self, ctx: NodeContext) -> None:
        self._sysfs = Path(ctx.config.health.sysfs_root)
        self._out_dir = ctx.out_dir
        self._ticker: Ticker | None = None
        self._band: ThermalBand | None = None
        self._load = CpuLoad()

    def poll(self, now_ns: int) -> Iterable[Message]:
        self._ticker = self._ticker or Ticker(RATE_HZ, now_ns)
        if self._ticker.due(now_ns):
            thermal = self._sysfs / "class" / "thermal"
            yield ThermalReading(
                t_ns=now_ns,
                zones=read_zones(thermal),
                throttling=read_throttling(thermal),
                disk_free_mb=read_disk_free_mb(self._out_dir),
                clocks=read_clocks(self._sysfs),
                rails=read_rails(self._sysfs / "class" / "hwmon"),
                fans=read_fans(self._sysfs / "class" / "hwmon"),
                power_mode=read_power_mode(),
                cpu_load=self._load.read(),
            )

    def on_message(self, message: Message) -> None:
        """Logs every change of the band with its cause."""
        if isinstance(message, Health) and message.band is not self._band:
            before, self._band = self._band, message.band
            log = logs.get().info if message.band is ThermalBand.NORMAL else logs.get().warning
            log(
                "thermal band",
                band=message.band,
                before=before,
                cause=message.cause,
                clock_limit=message.clock_limit,
                clock_mhz=message.clock_mhz,
                power_w=message.power_w,
            )

    def close(self) -> None:
        pass


def read_zones(thermal: Path) -> list[TemperatureZone]:
    """All zones with a plausible temperature, each with a name of its own: its type, and its folder where another zone
    has that type, too. ``thermal``: sysfs folder class/thermal."""
    folders = sorted(thermal.glob("thermal_zone*"))
    kinds = {folder: read_text(folder / "type") or folder.name for folder in folders}
    uses = Counter(kinds.values())
    zones = []
    for folder in folders:
        millidegrees = read_number(folder / "temp")
        if millidegrees is None:
            continue
        temperature_c = millidegrees / 1000
        if PLAUSIBLE_C[0] < temperature_c < PLAUSIBLE_C[1]:
            name = kinds[folder] if uses[kinds[folder]] == 1 else f"{kinds[folder]} ({folder.name})"
            zones.append(TemperatureZone(name=name, temperature_c=temperature_c))
    return zones


def read_throttling(thermal: Path) -> list[str]:
    """Names of the cooling devices that slow a processor down at present."""
    active = []
    for folder in sorted(thermal.glob("cooling_device*")):
        kind = read_text(folder / "type") or ""
        if any(word in kind.lower() for word in THROTTLING) and (read_number(folder / "cur_state") or 0) > 0:
            active.append(kind)
    return active


def read_disk_free_mb(folder: Path) -> int | None:
    """Free space of the disk that holds ``folder`` [MB]; None when it cannot be read."""
    try:
        return shutil.disk_usage(folder).free // 10**6
    except OSError:
        return None
