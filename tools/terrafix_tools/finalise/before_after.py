"""The table of what the smoother has changed. This module loads no GTSAM: the report shows the table, too."""

from dataclasses import dataclass
from typing import Any

from rich.table import Table

HEADER = ("", "before", "after")


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


def _text(value: float | None, sigma: float | None) -> str:
    if value is None:
        return "-"
    digits = 4 if abs(value) < 1.0 else 1
    return f"{value:.{digits}f}" + ("" if sigma is None else f" ± {sigma:.{digits}f}")
