"""Thinning of series that are longer than a chart is wide. What stands out stays visible."""

from collections import Counter
from collections.abc import Sequence

Span = tuple[float, float, str, str]  # from, to, css class, tooltip
MAX_SPANS = 1200  # per row; with more, a row is drawn by columns
COLUMNS = 900  # of a row: about its width in SVG units


def thin_line(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Pixel coordinates of a line, x ascending -> first, lowest, highest and last point of each pixel column."""
    if len(points) <= 2 * COLUMNS:
        return list(points)
    kept: list[tuple[float, float]] = []
    begin = 0
    for i in range(1, len(points) + 1):
        if i == len(points) or int(points[i][0]) != int(points[begin][0]):
            column = range(begin, i)
            low = min(column, key=lambda k: points[k][1])
            high = max(column, key=lambda k: points[k][1])
            kept += [points[k] for k in sorted({begin, low, high, i - 1})]
            begin = i
    return kept


def thin_marks(points: Sequence[tuple[float, float]], cell: float) -> list[tuple[float, float]]:
    """Pixel coordinates of single marks -> one for each square of ``cell`` pixels."""
    found: dict[tuple[int, int], tuple[float, float]] = {}
    for x, y in points:
        found.setdefault((int(x / cell), int(y / cell)), (x, y))
    return list(found.values())


def thin_path(points: Sequence[tuple[float, float]], step: float) -> list[tuple[float, float]]:
    """Pixel coordinates of a track -> without points nearer than ``step`` to the one before; both ends stay."""
    kept: list[tuple[float, float]] = []
    for x, y in points:
        if not kept or (x - kept[-1][0]) ** 2 + (y - kept[-1][1]) ** 2 >= step**2:
            kept.append((x, y))
    if kept and kept[-1] != points[-1]:
        kept.append(points[-1])
    return kept


def thin_spans(spans: Sequence[Span], end: float) -> list[Span]:
    """Intervals of states -> at most one for each of COLUMNS columns. In a column, the state that is rarest in the
    whole row is shown, so that a short one is not lost."""
    if len(spans) <= MAX_SPANS:
        return list(spans)
    total: Counter[str] = Counter()
    for low, high, css, _ in spans:
        total[css] += round(1000 * (high - low))
    width = end / COLUMNS
    columns: dict[int, Span] = {}
    for span in spans:
        for column in range(int(span[0] / width), min(COLUMNS - 1, int(span[1] / width)) + 1):
            if column not in columns or total[span[2]] < total[columns[column][2]]:
                columns[column] = span
    merged: list[Span] = []
    for column, (_, _, css, tip) in sorted(columns.items()):
        low, high = column * width, (column + 1) * width
        if merged and merged[-1][2] == css and abs(merged[-1][1] - low) < 0.5 * width:
            merged[-1] = (merged[-1][0], high, css, merged[-1][3])
        else:
            merged.append((low, high, css, tip))
    return merged
