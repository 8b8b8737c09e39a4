"""Estimates before a download: its size, its duration, and the space on the disk."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.core.errors import OutputError, UsageError
from terrafix_tools.mapping.sources.tiles.grid import TileRange

PACKAGE_BYTES_PER_PX = 1.3  # JPEG of quality 95 with its pyramid: 8 to 11 MB/km2 at 0.3 m/px, rounded up
STORE_OVERHEAD = 1.15  # SQLite's pages around tiles of 10 to 50 kB
RESERVE_BYTES = 500 << 20  # space that stays free on the disk
LARGE_BYTES = 1 << 30  # larger downloads need confirmation
LARGE_S = 3600.0
SAMPLES = 12  # tiles that are fetched to measure their size; they are part of the download


@dataclass(frozen=True)
class FetchEstimate:
    """Of one source. ``fetch_bytes`` and ``seconds``: of the remaining download."""

    title: str
    items: int  # total number of tiles or images
    missing: int
    fetch_bytes: float
    seconds: float


def spread_sample(missing: TileRange, count: int = SAMPLES) -> TileRange:
    """Tiles spread evenly over the missing ones, because tiles of towns and lakes differ in size by a factor of ten."""
    places = np.argwhere(missing.touched)
    chosen = places[np.unique(np.linspace(0, len(places) - 1, min(count, len(places))).astype(int))]
    touched = np.zeros_like(missing.touched)
    touched[chosen[:, 0], chosen[:, 1]] = True
    return TileRange(missing.zoom, missing.column, missing.row, touched)


def check_room(estimates: Sequence[FetchEstimate], cache: Path, package_bytes: float, out: Path) -> None:
    """Raises OutputError when the downloads do not fit beside the cache, or the package beside ``out``."""
    fetch_bytes = sum(e.fetch_bytes for e in estimates) * STORE_OVERHEAD
    needs = {_nearest_existing(cache): fetch_bytes}
    place = _nearest_existing(out.parent)
    if place.stat().st_dev == _nearest_existing(cache).stat().st_dev:
        needs[_nearest_existing(cache)] += package_bytes
    else:
        needs[place] = package_bytes
    for folder, need in needs.items():
        free = shutil.disk_usage(folder).free
        if need + RESERVE_BYTES > free:
            raise OutputError(
                f"{folder}: about {format_bytes(need)} are needed and {format_bytes(free)} are free; "
                "make room, or give a smaller area, a coarser --gsd or another --cache"
            )


def check_consent(estimates: Sequence[FetchEstimate], agreed: bool) -> None:
    """Raises UsageError when the downloads are large and not confirmed."""
    fetch_bytes, seconds = sum(e.fetch_bytes for e in estimates), sum(e.seconds for e in estimates)
    if (fetch_bytes > LARGE_BYTES or seconds > LARGE_S) and not agreed:
        raise UsageError(
            f"about {format_bytes(fetch_bytes)} in {format_time(seconds)} would be downloaded; "
            "add --yes to do it, or give a smaller --buffer, --corridor 2 for a mission, or a coarser --gsd"
        )


def describe(e: FetchEstimate) -> str:
    """One-line description."""
    existing = f"{e.title}: {e.items - e.missing} of {e.items} there"
    if not e.missing:
        return existing
    return f"{existing}, {e.missing} to fetch: about {format_bytes(e.fetch_bytes)} in {format_time(e.seconds)}"


def format_bytes(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def format_time(seconds: float) -> str:
    if seconds >= 5400.0:
        return f"{seconds / 3600.0:.1f} h"
    return f"{seconds / 60.0:.0f} min" if seconds >= 90.0 else f"{seconds:.0f} s"


def _nearest_existing(folder: Path) -> Path:
    """The folder, or its nearest existing parent."""
    folder = folder.resolve()
    while not folder.is_dir():
        folder = folder.parent
    return folder
