"""Check of the links to ground stations that do not pass the autopilot: they can be opened."""

import time
from collections.abc import Iterator

from terrafix.core.config import LinkSection
from terrafix.core.errors import TerrafixError
from terrafix.link.ground_station.links import GroundLinks
from terrafix.link.ground_station.position_prior import HintReceiver
from terrafix_tools.preflight.lines import Line, fail, ok, warn


def check_lines(link: LinkSection) -> Iterator[Line]:
    """Yields no line when there are no such links."""
    try:
        links = GroundLinks(link, time.time_ns, HintReceiver(link.sysid, link.compid))
    except TerrafixError as error:
        text, _, todo = str(error).rpartition("; ")
        yield fail("ground links", text or str(error), todo if text else "correct link.ground_devices")
        return
    try:
        notes = list(links.notes())
    finally:
        links.close()
    for note in notes:
        yield warn("ground links", note, "is it plugged in and free? The link to the autopilot flies without it")
    if link.ground_devices and not notes:
        view = f", our position as vehicle {link.view_sysid}" if link.view_sysid else ""
        yield ok("ground links", f"{', '.join(link.ground_devices)}{view}")
