"""The table of what the smoother has changed. This module loads no GTSAM: the report shows the table, too."""

from dataclasses import dataclass
from typing import Any

from rich.table import Table

HEADER = ("", "before", "after")
FINALISED, REFINED = "finalised", "refined"  # the solution in the table: of the batch smoother, or of the flight


@dataclass(frozen=True)
class Change:
    """One row: a quantity with its 1-sigma. ``before``: as described, or as last estimated in flight. None: it has
    none."""

    what: str
    unit: str
    before: float | None
    before_sigma: float | None
    after: float | None
    after_sigma: float | None

    def cells(self) -> tuple[str, str, str]:
        """Texts of the row, for people."""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.what}{unit}", _text(self.before, self.before_sigma), _text(self.after, self.after_sigma)


def table(rows: list[dict[str, Any]]) -> Table:
    """The rows of one flight for a terminal."""
    shown = Table(title="Before and after", title_justify="left")
    for name in HEADER:
        shown.add_column(name, justify="right" if name else "left")
    for row in rows:
        shown.add_row(*Change(**row).cells())
    return shown


def kept_line(flight: dict[str, Any]) -> str:
    """Why finalised.csv has the refined positions of a flight; empty where it has the batch smoother's, and for a
    summary of an older version."""
    if flight.get("solution", FINALISED) == FINALISED:
        return ""
    kept = "The finalised positions are the refined ones of the flight"
    track = flight["held_out"]["track"]
    if track is None or not track["matches"]:
        return f"{kept}: no map match could be held out to compare the batch solution with them."
    distances = (
        f"{track['before']:.1f} px from the estimates in flight, {track['after']:.1f} px from the batch solution"
    )
    enough = "too few to tell which is better" if track["sigmas"] == 0.0 else f"{track['sigmas']:+.1f} standard errors"
    return f"{kept}: {track['matches']} map matches that were held out are {distances} ({enough})."


def _text(value: float | None, sigma: float | None) -> str:
    if value is None:
        return "-"
    digits = 4 if abs(value) < 1.0 else 1
    return f"{value:.{digits}f}" + ("" if sigma is None else f" ± {sigma:.{digits}f}")
