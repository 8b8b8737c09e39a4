"""Rig of the link's tests: estimates of a vehicle on a straight line, and simplified loops of the shell."""

import gc
import math
import time
from collections.abc import Callable, Iterable
from typing import Any

from terrafix import messages as m
from terrafix.link.edge import MavlinkEdge
from terrafix.link.integrity.output_predictor import offset
from terrafix.link.node import LinkNode
from terrafix.processes import PROCESSES, SOURCE
from terrafix_lab.sim.true_messages import estimate as true_estimate
from terrafix_tools.in_process import InProcessShell

LAT, LON, ALT = 48.0, 11.0, 620.0
SPEED_EAST = 20.0
S = 1_000_000_000
MS = 1_000_000
TICK_NS = 20 * MS
(LINK,) = (process for process in PROCESSES if process.name == "link")


def covariance(sigma_m: float, vertical_m: float = 3.0) -> tuple[float, ...]:
    cov = [0.0] * 36
    cov[0] = cov[7] = sigma_m**2
    cov[14] = vertical_m**2
    cov[21] = cov[28] = cov[35] = 1e-4
    return tuple(cov)


def estimate(
    t_ns: int,
    *,
    east_m: float = 0.0,
    sigma_m: float = 4.0,
    late_ns: int = 100 * MS,
    anchor_age_ms: int = 0,
    velocity_sigma: float = 0.5,
    **changes: Any,
) -> m.NavEstimate:
    """Estimate of a vehicle that flies east at 20 m/s through LAT, LON at t = 0. ``east_m``: error to the east."""
    lat, lon = offset(LAT, LON, SPEED_EAST * t_ns / S + east_m, 0.0)
    fields: dict[str, Any] = {
        "lat_deg": lat,
        "lon_deg": lon,
        "alt_amsl_m": ALT,
        "velocity_enu_mps": (SPEED_EAST, 0.0, 0.0),
        "velocity_sigma_mps": velocity_sigma,
        "cov": covariance(sigma_m),
        "last_anchor_age_ms": anchor_age_ms,
        "emitted_at_ns": t_ns + late_ns,
    }
    return true_estimate(t_ns, sigmas=(sigma_m, 3.0, 0.01), **fields | changes)


Feed = Callable[[int], list[m.Message]]


class LinkRun:
    """A link node, and its edge if it has one, in the driver of one process (``shell``). ``published``: by the node;
    with an edge also what it has read, and what was fed."""

    def __init__(self, node: LinkNode, edge: MavlinkEdge | None = None) -> None:
        self.published: list[m.Message] = []
        edges = {} if edge is None else {"link": edge}

        def take(publisher: str, message: m.Message) -> None:
            self.published += [message] if edges or publisher != SOURCE else []

        self.shell = InProcessShell({"link": node}, take, edges=edges)

    def feed(self, messages: Iterable[m.Message]) -> None:
        """As the bus delivers them; what the bus does not bring to the link as its edge reads it."""
        for message in messages:
            if isinstance(message, LINK.subscribes):
                self.shell.feed(message)
            else:
                self.shell.feed_read("link", message)


def fly(node: LinkNode, start_ns: int, end_ns: int, feed: Feed) -> list[m.Message]:
    """Ticks the node at 50 Hz in simulated time. ``feed(now_ns)``: messages that arrive before a tick. -> all published
    messages."""
    run = LinkRun(node)
    for now_ns in range(start_ns, end_ns, TICK_NS):
        run.feed(feed(now_ns))
        run.shell.tick(now_ns)
    return run.published


def every(period_ns: int, make: Callable[[int], m.Message], late_ns: int = 100 * MS) -> Feed:
    """-> a feed of ``make(t_ns)`` once per period, which arrives ``late_ns`` after ``t_ns``."""

    def feed(now_ns: int) -> list[m.Message]:
        t_ns = now_ns - late_ns
        return [make(t_ns)] if t_ns >= 0 and t_ns % period_ns < TICK_NS else []

    return feed


def gps(published: list[m.Message]) -> list[m.GpsInput]:
    return [x for x in published if isinstance(x, m.GpsInput)]


def texts(published: list[m.Message]) -> list[str]:
    return [x.text for x in published if isinstance(x, m.StatusText)]


def east_error_m(sent: m.GpsInput) -> float:
    """-> error of a sent position to the east, at its time."""
    true_lat, true_lon = offset(LAT, LON, SPEED_EAST * sent.t_ns / S, 0.0)
    return (sent.lon_deg - true_lon) * 111_320.0 * math.cos(math.radians(true_lat))


def live(node: LinkNode, edge: MavlinkEdge, seconds: float, feed: Feed = lambda _: []) -> list[m.Message]:
    """Runs the loop of the live shell in real time with the real edge. -> all published and received messages."""
    gc.freeze()  # as the shell does: a collection of the objects of all earlier tests takes 150 ms
    run, until_ns = LinkRun(node, edge), time.monotonic_ns() + round(seconds * S)
    while (now_ns := time.monotonic_ns()) < until_ns:
        run.feed(feed(now_ns))
        run.shell.step(now_ns)
        time.sleep(0.001)
    gc.unfreeze()
    return run.published
