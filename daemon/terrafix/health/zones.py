"""Which temperature zones decide the thermal band: those that measure something, or those that the operator has
chosen."""

import re
from collections.abc import Iterable, Sequence

from terrafix.messages import TemperatureZone, ThermalReading

# The PMIC of a Jetson Nano, TX1, TX2 and Xavier says only whether it has passed 120 or 140 degrees; until then its
# driver reports 100. [spec: Linux drivers/thermal/max77620_thermal.c, MAX77620_NORMAL_OPERATING_TEMP]
_ALARM_ONLY, _ALARM_ONLY_NORMAL_C = re.compile(r"pmic[-_ ]?die\b", re.IGNORECASE), 100.0
# Seconds after which a zone that never changed, while others did, is a constant. Readings of silicon change by their
# last digit within seconds; the first minute of a flight loads and heats the processor.
CONSTANT_AFTER_S = 60.0
_FOLDER = re.compile(r" \(thermal_zone\d+\)$")  # of a zone whose type another one has, too (sysfs.read_zones)


class DecidingZones:
    """State: which zones have ever changed. ``chosen``: names of [health] zones; empty: all that measure something."""

    def __init__(self, chosen: Sequence[str]) -> None:
        self._chosen = tuple(chosen)
        self._first: dict[str, tuple[int, float]] = {}  # first time and temperature of each zone
        self._changed: set[str] = set()

    def of(self, reading: ThermalReading) -> tuple[list[TemperatureZone], list[str]]:
        """-> the zones of the reading that decide, and those that do not although nobody left them out, in words."""
        for zone in reading.zones:
            _, first_c = self._first.setdefault(zone.name, (reading.t_ns, zone.temperature_c))
            if zone.temperature_c != first_c:
                self._changed.add(zone.name)
        constant = {zone.name for zone in reading.zones if self._is_constant(zone.name, reading.t_ns)}
        return deciding_zones(reading.zones, self._chosen, constant)

    def _is_constant(self, name: str, t_ns: int) -> bool:
        old = t_ns - self._first[name][0] >= CONSTANT_AFTER_S * 1e9
        return old and name not in self._changed and bool(self._changed)


def deciding_zones(
    zones: Iterable[TemperatureZone], chosen: Sequence[str], constant: Iterable[str] = ()
) -> tuple[list[TemperatureZone], list[str]]:
    """As ``DecidingZones.of`` for a single reading. ``constant``: names of zones that have never changed."""
    if chosen:
        return [zone for zone in zones if {zone.name, _FOLDER.sub("", zone.name)} & set(chosen)], []
    left_out = set(constant)
    deciding, words = [], []
    for zone in zones:
        if zone.name in left_out or _is_no_measurement(zone):
            words.append(f"{zone.name} {zone.temperature_c:.1f} C is a constant of its driver and does not decide")
        else:
            deciding.append(zone)
    return deciding, words


def _is_no_measurement(zone: TemperatureZone) -> bool:
    return bool(_ALARM_ONLY.match(zone.name)) and zone.temperature_c <= _ALARM_ONLY_NORMAL_C
