"""Rig of the link's tests: estimates of a vehicle on a straight line, and simplified loops of the shell."""

import gc
import math
import time
from collections.abc import Callable

from terrafix import messages as m
from terrafix.link.edge import MavlinkEdge
from terrafix.link.integrity.output_predictor import offset
from terrafix.link.node import LinkNode

LAT, LON, ALT = 48.0, 11.0, 620.0
SPEED_EAST = 20.0
S = 1_000_000_000
MS = 1_000_000
TICK_NS = 20 * MS


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
    **changes: object,
) -> m.NavEstimate:
    """Estimate of a vehicle that flies east at 20 m/s through LAT, LON at t = 0. ``east_m``: error to the east."""
    lat, lon = offset(LAT, LON, SPEED_EAST * t_ns / S + east_m, 0.0)
    fields: dict[str, object] = dict(
        t_ns=t_ns,
        frame_id=t_ns // MS,
        lat_deg=lat,
        lon_deg=lon,
        alt_amsl_m=ALT,
        agl_m=120.0,
        velocity_enu_mps=(SPEED_EAST, 0.0, 0.0),
        velocity_sigma_mps=velocity_sigma,
        q_w_b=(1.0, 0.0, 0.0, 0.0),
        cov=covariance(sigma_m),
        source_label=m.SourceLabel.SATELLITE_ANCHORED,
        covariance_mode=m.CovarianceMode.MARGINALS,
        last_anchor_age_ms=anchor_age_ms,
        emitted_at_ns=t_ns + late_ns,
    )
    return m.NavEstimate(**(fields | changes))  # type: ignore[arg-type]


Feed = Callable[[int], list[m.Message]]


def fly(node: LinkNode, start_ns: int, end_ns: int, feed: Feed, step_ns: int = TICK_NS) -> list[m.Message]:
    """Ticks the node at 50 Hz in simulated time. ``feed(now_ns)``: messages that arrive before a tick. -> all published
    messages."""
    published: list[m.Message] = []
    for now_ns in range(start_ns, end_ns, step_ns):
        for message in feed(now_ns):
            published += node.on(message)
        published += node.tick(now_ns)
    return published


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
    published: list[m.Message] = []
    until_ns = time.monotonic_ns() + round(seconds * S)
    next_tick_ns = 0
    while (now_ns := time.monotonic_ns()) < until_ns:
        for message in feed(now_ns):
            published += _pass_to_edge(edge, list(node.on(message)))
        for message in edge.poll(now_ns):
            published.append(message)
            published += _pass_to_edge(edge, list(node.on(message)))
        if now_ns >= next_tick_ns:
            next_tick_ns = now_ns - now_ns % TICK_NS + TICK_NS
            published += _pass_to_edge(edge, list(node.tick(now_ns)))
        time.sleep(0.001)
    gc.unfreeze()
    return published


def _pass_to_edge(edge: MavlinkEdge, messages: list[m.Message]) -> list[m.Message]:
    for message in messages:
        edge.on_message(message)
    return messages
