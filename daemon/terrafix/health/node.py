"""Health: thermal band of the computer, with hysteresis. Outside of the normal band the estimator propagates the
covariance."""

from collections.abc import Iterable

from terrafix.core.config import HealthSection
from terrafix.core.errors import ConfigError
from terrafix.core.node import Edge, NodeBase, NodeContext
from terrafix.health.power import most_limited, whole_computer_w
from terrafix.health.sysfs import HealthEdge
from terrafix.health.zones import DecidingZones
from terrafix.messages import Health, Message, TemperatureZone, ThermalBand, ThermalReading

_RANK = {ThermalBand.NORMAL: 0, ThermalBand.HOT: 1, ThermalBand.CRITICAL: 2}


class HealthNode(NodeBase):
    """ThermalReading in, Health out. A band is entered at its limit and left ``hysteresis_c`` below it, so that it does
    not oscillate.

    Throttling has no hysteresis here: the kernel's governor has one, and the cheaper covariance must end with the
    throttling (ON-2)."""

    def __init__(self, settings: HealthSection) -> None:
        """Raises ConfigError when ``critical_c`` is not above ``hot_c``."""
        if settings.critical_c <= settings.hot_c:
            raise ConfigError(
                f"[health] critical_c = {settings.critical_c:g} is not above hot_c = {settings.hot_c:g};"
                " raise critical_c"
            )
        self._settings = settings
        self._zones = DecidingZones(settings.zones)
        self._by_temperature = ThermalBand.NORMAL

    def on(self, message: Message) -> Iterable[Message]:
        if isinstance(message, ThermalReading):
            yield self._health(message)

    def _health(self, reading: ThermalReading) -> Health:
        """Band by temperature; at least HOT while a processor is throttled."""
        zones, left_out = self._zones.of(reading)
        hottest = max(zones, key=lambda zone: zone.temperature_c, default=None)
        self._by_temperature, cause = self._band(hottest)
        cause = "; ".join([cause, *left_out])
        band = self._by_temperature
        if reading.throttling and band is ThermalBand.NORMAL:
            band = ThermalBand.HOT
        if reading.throttling:
            cause += f"; throttled by {', '.join(reading.throttling)}"
        limited = most_limited(reading.clocks)
        return Health(
            t_ns=reading.t_ns,
            band=band,
            temperature_c=hottest.temperature_c if hottest else None,
            throttled=bool(reading.throttling),
            disk_free_mb=reading.disk_free_mb,
            cause=cause,
            power_w=whole_computer_w(reading.rails),
            clock_limit=None if limited is None else limited.limit_mhz / limited.max_mhz,
            clock_mhz=None if limited is None else limited.limit_mhz,
        )

    def _band(self, hottest: TemperatureZone | None) -> tuple[ThermalBand, str]:
        """-> (band by temperature, its cause in words)."""
        if hottest is None:
            which = "zone of [health] zones" if self._settings.zones else "temperature zone"
            return ThermalBand.NORMAL, f"no {which} is readable: taken for normal"
        limits = ((ThermalBand.CRITICAL, self._settings.critical_c), (ThermalBand.HOT, self._settings.hot_c))
        for band, enter_c in limits:
            leave_c = enter_c - self._settings.hysteresis_c
            inside = _RANK[self._by_temperature] >= _RANK[band]
            temperature_c = hottest.temperature_c
            if temperature_c >= enter_c or (inside and temperature_c > leave_c):
                return band, f"{hottest.name} {temperature_c:.1f} C; {band} from {enter_c:g} C down to {leave_c:g} C"
        among = " of [health] zones" if self._settings.zones else ""
        return ThermalBand.NORMAL, f"{hottest.name} {hottest.temperature_c:.1f} C is the hottest zone{among}"


def make_node(ctx: NodeContext) -> HealthNode:
    return HealthNode(ctx.config.health)


def make_edge(ctx: NodeContext) -> Edge:
    return HealthEdge(ctx)
