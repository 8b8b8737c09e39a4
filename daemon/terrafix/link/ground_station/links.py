"""Own links to ground stations, besides the way through the autopilot: they carry texts and values to operators, and
hints from them.

Messages that arrive here never count as the autopilot's, and nothing is forwarded between links; a router does that.
Each link is a separate connection. A lost one is opened again, without effect on the others."""

import ipaddress
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from terrafix.core.config import LinkSection
from terrafix.core.errors import ConfigError, LinkError
from terrafix.link.ground_station.ghost_vehicle import GhostVehicle
from terrafix.link.ground_station.position_prior import HintReceiver
from terrafix.link.mavlink.connection import Connection
from terrafix.link.mavlink.diagnosis import ReceivedTraffic
from terrafix.link.mavlink.transport import Transport, open_transport
from terrafix.messages import GpsInput, PositionHint


class GroundLink:
    """Connection to one device."""

    def __init__(
        self, config: LinkSection, wall_clock_ns: Callable[[], int], hints: HintReceiver, link_id: int
    ) -> None:
        """``config``: with ``device`` and ``baud`` of this link. Raises LinkError for a malformed device."""
        self.device = config.device
        self.traffic = ReceivedTraffic()
        transport, error = _opened(config.device, config.baud)
        self.connection = Connection(config, transport, wall_clock_ns, link_id=link_id)
        self.connection.down = error
        self._hints = hints
        self.ghost = GhostVehicle(config.view_sysid) if config.view_sysid else None
        self._ghost_sender = self.ghost.sender() if self.ghost is not None else None

    def poll(self, now_ns: int, systems: set[int]) -> Iterator[PositionHint]:
        """Handles the received messages. ``systems``: as in HintReceiver.on_message."""
        for message, sender in self.connection.messages(now_ns):
            self.traffic.add(message)
            for result in self._hints.on_message(message, now_ns, systems):
                if isinstance(result, PositionHint):
                    yield result
                else:
                    self.connection.send(result, to=sender)
            if self.ghost is not None:
                self.send_as_ghost(self.ghost.reply(message))

    def send_as_ghost(self, messages: Iterator[Any]) -> None:
        for message in messages:
            self.connection.send(message, self._ghost_sender)


class GroundLinks:
    """All ground links of the configuration; there may be none."""

    def __init__(self, config: LinkSection, wall_clock_ns: Callable[[], int], hints: HintReceiver) -> None:
        """``hints``: shared by all links, because one hint may arrive on several.

        Raises LinkError or ConfigError for an inconsistent configuration."""
        _check(config)
        configs = [
            msgspec.structs.replace(config, device=device, baud=config.ground_baud) for device in config.ground_devices
        ]
        self._links = [GroundLink(c, wall_clock_ns, hints, number) for number, c in enumerate(configs, start=1)]
        self._ghost_sysid = config.view_sysid
        self._has_fix = False

    def __len__(self) -> int:
        return len(self._links)

    def poll(self, now_ns: int, autopilot_sysid: int) -> Iterator[PositionHint]:
        """``autopilot_sysid``: 0 before the first heartbeat of an autopilot."""
        for link in self._links:
            yield from link.poll(now_ns, {autopilot_sysid, self._ghost_sysid} - {0})

    def broadcast(self, message: Any) -> None:
        """Sends ``message`` on all links."""
        for link in self._links:
            link.connection.send(message)

    def send_ghost_heartbeat(self, vehicle_type: int) -> None:
        """Heartbeat of the ghost vehicle; that of this program is sent with ``broadcast``."""
        for link in self._links:
            if link.ghost is not None:
                link.send_as_ghost(iter([link.ghost.heartbeat(vehicle_type, has_fix=self._has_fix)]))

    def send_ghost_position(self, gps: GpsInput) -> None:
        self._has_fix = gps.fix_type >= 3
        for link in self._links:
            if link.ghost is not None:
                link.send_as_ghost(link.ghost.position(gps))

    def autopilots(self) -> dict[str, list[int]]:
        """-> device -> system ids of the autopilots received on it, for the diagnosis of a missing autopilot."""
        return {link.device: list(link.traffic.autopilots()) for link in self._links if link.traffic.autopilots()}

    def notes(self) -> Iterator[str]:
        """Texts about links that are down, for LinkStatus."""
        for link in self._links:
            if link.connection.down:
                yield f"ground link {link.device}: {link.connection.down}"

    def close(self) -> None:
        for link in self._links:
            link.connection.close()


def _opened(device: str, baud: int) -> tuple[Transport | None, str]:
    """-> (transport, ""), or (None, error text). It does not raise, because a missing ground link must not prevent a
    restart of the link to the autopilot in flight."""
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
            "(the autopilot must not receive a second vehicle)"
        )
    for device in config.ground_devices:
        kind, _, rest = device.partition(":")
        if kind in ("udpin", "udpout", "tcp") and not _is_address(rest.rpartition(":")[0]):
            raise LinkError(
                f"ground link '{device}' has a host name: name resolution can block in flight; write its IPv4 address"
            )


def _is_address(host: str) -> bool:
    if host in ("", "localhost"):  # the transport reports a missing address
        return True
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        return False
    return True
