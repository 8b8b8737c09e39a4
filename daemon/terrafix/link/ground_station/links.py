"""Links to ground stations that do not go through the autopilot: people read us there, and may send a hint.

Nothing that is heard here is taken for the autopilot's, and nothing is forwarded: that is a router's work. Each link is
a connection of its own; one that dies is opened again, and touches no other."""

import ipaddress
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from terrafix.core.config import LinkSection
from terrafix.core.errors import ConfigError, LinkError
from terrafix.link.ground_station.ghost_vehicle import VehicleView
from terrafix.link.ground_station.position_prior import Hints
from terrafix.link.mavlink.connection import Connection
from terrafix.link.mavlink.diagnosis import Heard
from terrafix.link.mavlink.transport import Transport, open_transport
from terrafix.messages import GpsInput, PositionHint


class GroundLink:
    """One device."""

    def __init__(self, config: LinkSection, wall_clock_ns: Callable[[], int], hints: Hints, link_id: int) -> None:
        """``config``: with ``device`` and ``baud`` of this link. Raises LinkError for what cannot be understood."""
        self.device = config.device
        self.heard = Heard()
        transport, why = _opened(config.device, config.baud)
        self.connection = Connection(config, transport, wall_clock_ns, link_id=link_id)
        self.connection.down = why
        self._hints = hints
        self.view = VehicleView(config.view_sysid) if config.view_sysid else None
        self._as_view = self.view.sender() if self.view is not None else None

    def poll(self, now_ns: int, systems: set[int]) -> Iterator[PositionHint]:
        for message, sender in self.connection.messages(now_ns):
            self.heard.take(message)
            for said in self._hints.take(message, now_ns, systems):
                if isinstance(said, PositionHint):
                    yield said
                else:
                    self.connection.send(said, to=sender)
            if self.view is not None:
                self.send_as_view(self.view.answer(message))

    def send_as_view(self, messages: Iterator[Any]) -> None:
        for message in messages:
            self.connection.send(message, self._as_view)


class GroundLinks:
    """All of them; without any in the configuration it does nothing."""

    def __init__(self, config: LinkSection, wall_clock_ns: Callable[[], int], hints: Hints) -> None:
        """``hints``: one for all links, since a hint may come over several.

        Raises LinkError or ConfigError for a configuration that cannot be meant."""
        _check(config)
        configs = [
            msgspec.structs.replace(config, device=device, baud=config.ground_baud) for device in config.ground_devices
        ]
        self._links = [GroundLink(c, wall_clock_ns, hints, number) for number, c in enumerate(configs, start=1)]
        self._view_sysid = config.view_sysid
        self._good = False

    def __len__(self) -> int:
        return len(self._links)

    def poll(self, now_ns: int, autopilot_sysid: int) -> Iterator[PositionHint]:
        """``autopilot_sysid``: 0 while none was heard."""
        for link in self._links:
            yield from link.poll(now_ns, {autopilot_sysid, self._view_sysid} - {0})

    def say(self, message: Any) -> None:
        for link in self._links:
            link.connection.send(message)

    def heartbeat(self, vehicle_type: int) -> None:
        """Of the view; ours is said like everything else."""
        for link in self._links:
            if link.view is not None:
                link.send_as_view(iter([link.view.heartbeat(vehicle_type, good=self._good)]))

    def position(self, gps: GpsInput) -> None:
        self._good = gps.fix_type >= 3
        for link in self._links:
            if link.view is not None:
                link.send_as_view(link.view.position(gps))

    def autopilots(self) -> dict[str, list[int]]:
        """Devices on which an autopilot is heard too, with its system ids: of help when it is heard nowhere else."""
        return {link.device: list(link.heard.autopilots()) for link in self._links if link.heard.autopilots()}

    def notes(self) -> Iterator[str]:
        for link in self._links:
            if link.connection.down:
                yield f"ground link {link.device}: {link.connection.down}"

    def close(self) -> None:
        for link in self._links:
            link.connection.close()


def _opened(device: str, baud: int) -> tuple[Transport | None, str]:
    """A ground link that cannot be opened must not keep the link to the autopilot from starting again in flight."""
    try:
        return open_transport(device, baud, wait=False), ""
    except OSError as error:
        return None, f"cannot be opened ({error.strerror or error}); trying again"


def _check(config: LinkSection) -> None:
    if config.device in config.ground_devices:
        raise ConfigError(
            f"link.ground_devices names the autopilot's device '{config.device}' again; leave it out there"
        )
    if config.view_sysid in (config.sysid, config.autopilot_sysid) and config.view_sysid:
        raise ConfigError(
            f"link.view_sysid {config.view_sysid} is the vehicle's own id; choose another, for example 201"
        )
    if config.view_sysid and not config.ground_devices:
        raise ConfigError(
            "link.view_sysid needs a link of its own to the ground: name it in link.ground_devices "
            "(the autopilot must not hear a second vehicle)"
        )
    for device in config.ground_devices:
        kind, _, rest = device.partition(":")
        if kind in ("udpin", "udpout", "tcp") and not _is_address(rest.rpartition(":")[0]):
            raise LinkError(
                f"ground link '{device}' has a name: in flight nobody waits for a name server; write its address"
            )


def _is_address(host: str) -> bool:
    if host in ("", "localhost"):  # without any it is the transport that says what is missing
        return True
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        return False
    return True
