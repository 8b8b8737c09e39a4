"""Before anything is downloaded: how much it will be, how long it will take, and whether the disk holds it."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.core.errors import OutputError, UsageError
from terrafix_tools.mapping.sources.tile_grid import TileRange

PACKAGE_BYTES_PER_PX = 1.3  # JPEG of quality 95 with its pyramid: 8 to 11 MB/km2 at 0.3 m/px, rounded up
STORE_OVERHEAD = 1.15  # SQLite's pages around tiles of 10 to 50 kB
RESERVE_BYTES = 500 << 20  # what the machine needs for itself
LARGE_BYTES = 1 << 30  # from here on a person says yes first
LARGE_S = 3600.0
SAMPLES = 12  # tiles whose size is measured; they are part of the download


@dataclass(frozen=True)
class Estimate:
    """One source. ``fetch_bytes`` and ``seconds`` are of what is still to come."""

    title: str
    items: int  # tiles or pictures in all
    missing: int
    fetch_bytes: float
    seconds: float


def sampled(missing: TileRange, count: int = SAMPLES) -> TileRange:
    """Tiles spread evenly over what is missing: town and lake differ in size by ten."""
    places = np.argwhere(missing.touched)
    chosen = places[np.unique(np.linspace(0, len(places) - 1, min(count, len(places))).astype(int))]
    touched = np.zeros_like(missing.touched)
    touched[chosen[:, 0], chosen[:, 1]] = True
    return TileRange(missing.zoom, missing.column, missing.row, touched)


def check_room(estimates: Sequence[Estimate], cache: Path, package_bytes: float, out: Path) -> None:
    """Raises OutputError when the downloads do not fit beside the cache, or the package beside ``out``."""
    fetch_bytes = sum(e.fetch_bytes for e in estimates) * STORE_OVERHEAD
    needs = {_existing(cache): fetch_bytes}
    place = _existing(out.parent)
    if place.stat().st_dev == _existing(cache).stat().st_dev:
        needs[_existing(cache)] += package_bytes
    else:
        needs[place] = package_bytes
    for folder, need in needs.items():
        free = shutil.disk_usage(folder).free
        if need + RESERVE_BYTES > free:
            raise OutputError(
                f"{folder}: about {said_bytes(need)} are needed and {said_bytes(free)} are free; "
                "make room, or give a smaller area, a coarser --gsd or another --cache"
            )


def check_consent(estimates: Sequence[Estimate], agreed: bool) -> None:
    """Raises UsageError when the downloads are large and nobody has agreed to them."""
    fetch_bytes, seconds = sum(e.fetch_bytes for e in estimates), sum(e.seconds for e in estimates)
    if (fetch_bytes > LARGE_BYTES or seconds > LARGE_S) and not agreed:
        raise UsageError(
            f"about {said_bytes(fetch_bytes)} in {said_time(seconds)} would be downloaded; "
            "add --yes to do it, or give a smaller --buffer, --corridor 2 for a mission, or a coarser --gsd"
        )


def said(e: Estimate) -> str:
    """In one line."""
    there = f"{e.title}: {e.items - e.missing} of {e.items} there"
    if not e.missing:
        return there
    return f"{there}, {e.missing} to fetch: about {said_bytes(e.fetch_bytes)} in {said_time(e.seconds)}"


def said_bytes(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def said_time(seconds: float) -> str:
    if seconds >= 5400.0:
        return f"{seconds / 3600.0:.1f} h"
    return f"{seconds / 60.0:.0f} min" if seconds >= 90.0 else f"{seconds:.0f} s"


def _existing(folder: Path) -> Path:
    """The folder, or what of it is already there."""
    folder = folder.resolve()
    while not folder.is_dir():
        folder = folder.parent
    return folder
