"""Readings of a GNSS receiver with known errors, and a link that is fed with them."""

from collections.abc import Callable
from typing import Any

from link_rig import LAT, LON, MS, SPEED_EAST, TICK_NS, S, estimate, fly
from terrafix import messages as m
from terrafix.link.integrity.output_predictor import offset
from terrafix.link.node import LinkNode

READING_AGE_NS = 150 * MS


Where = Callable[[float], tuple[float, float] | None]  # s -> receiver's error east, north [m]; None: no fix


def reading(t_ns: int, error: tuple[float, float] | None, **changes: Any) -> m.GnssReading:
    """Reading of a receiver on the vehicle of link_rig, which flies east at 20 m/s. It is 150 ms old."""
    fields: dict[str, Any] = {"t_ns": t_ns, "receiver": 0, "fix_type": 3, "satellites": 14, "horizontal_m": 1.3}
    fields |= {"speed_mps": SPEED_EAST, "lat_deg": None, "lon_deg": None}
    if error is None:
        fields |= {"fix_type": 1, "horizontal_m": None, "satellites": 0}
    else:
        east_m = SPEED_EAST * (t_ns - READING_AGE_NS) / S
        fields["lat_deg"], fields["lon_deg"] = offset(LAT, LON, east_m + error[0], error[1])
    return m.GnssReading(**fields | changes)


def feed_receiver(
    node: LinkNode,
    seconds: float,
    where: Where,
    *,
    begin_s: float = 0.0,
    ours: Callable[[float], float] = lambda _: 0.0,
    **claims: Any,
) -> list[m.Message]:
    """-> messages of a link that gets readings at 5 Hz with the error ``where``, and estimates at 2 Hz with the error
    ``ours`` [m east]."""

    def feed(now_ns: int) -> list[m.Message]:
        step, t_s, arrived = now_ns // TICK_NS, now_ns / S, list[m.Message]()
        if step % 25 == 5:
            arrived.append(estimate(now_ns - 100 * MS, east_m=ours(t_s), **claims))
        if step % 10 == 0:
            arrived.append(reading(now_ns, where(t_s)))
        return arrived

    return fly(node, round(begin_s * S), round((begin_s + seconds) * S), feed)


def accurate(_: float) -> tuple[float, float]:
    """Errors of a receiver that is not spoofed."""
    return 1.0, -1.0
