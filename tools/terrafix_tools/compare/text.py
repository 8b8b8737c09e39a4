"""A comparison as lines of text."""

from collections.abc import Iterator
from typing import Any

MAX_VALUE = 60  # characters of a value that are shown
MAX_SETTINGS = 10  # changed settings that are shown


def summary(comparison: dict[str, Any]) -> Iterator[str]:
    """Lines for a terminal: how far the positions are apart, the first verdict that changed, then the messages."""
    yield from _positions(comparison["positions"])
    if comparison["first_verdict"]:
        yield f"first verdict that changed: {changed_verdict(comparison['first_verdict'])}"
    if comparison["equal"]:
        yield f"equal: all {comparison['compared']} messages"
    else:
        counts = comparison["messages"].values()
        different = sum(count["different"] + count["only_a"] + count["only_b"] for count in counts)
        yield f"different: {different} of {comparison['compared']} messages"
        yield f"first difference: {divergence(comparison['first'])}"
        for found in comparison["first_of_each_message"][1:]:
            yield f"  first {divergence(found)}"
    clocked = [kind for kind in comparison["not_compared"] if kind not in comparison["only_live"]]
    if clocked:
        yield f"not compared, because the clocks differ: {', '.join(clocked)}"
    if comparison["only_live"]:
        yield f"not compared, because a replay has none: {', '.join(comparison['only_live'])}"
    for name in ("a", "b"):
        for file in comparison[name]["cut_off"]:
            yield f"{comparison[name]['path']}: {file} ends in the middle of a record"
    yield from _verdicts(comparison["verdicts"])
    yield from _delays(comparison["delay_ms"])
    for what in ("configuration", "versions"):
        for change in comparison[what][:MAX_SETTINGS]:
            yield f"{what}: {change['name']}: {shortened(change['a'])} -> {shortened(change['b'])}"


def divergence(found: dict[str, Any]) -> str:
    """One difference: "NavEstimate of frame 12 at 6.000 s: lat_deg 48.1 -> 48.2"."""
    frame = f" of frame {found['frame_id']}" if "frame_id" in found else ""
    measurement = f" ({found['measurement']})" if "measurement" in found else ""
    where = f"{found['message']}{measurement}{frame} {at(found['t_s'])}"
    if "only_in" in found:
        return f"{where}: only in {found['only_in'].upper()}"
    fields = ", ".join(f"{f['field']} {shortened(f['a'])} -> {shortened(f['b'])}" for f in found["fields"])
    more = f" and {found['more_fields']} more fields" if found["more_fields"] else ""
    return f"{where}: {fields}{more}"


def at(t_s: float) -> str:
    """A time since the start of the flight."""
    return f"at {t_s:.3f} s" if t_s >= 0 else f"{-t_s:.3f} s before the start"


def changed_verdict(found: dict[str, Any]) -> str:
    """ "map of frame 41 at 20.500 s: accepted -> innovation"."""
    frame = f" of frame {found['frame_id']}" if found["frame_id"] >= 0 else ""
    return f"{found['measurement']}{frame} {at(found['t_s'])}: {found['a'] or 'none'} -> {found['b'] or 'none'}"


def shortened(value: Any) -> str:
    text = str(value)
    return text if len(text) <= MAX_VALUE else f"{text[: MAX_VALUE - 3]}..."


def _positions(found: dict[str, Any]) -> Iterator[str]:
    if not found["frames"]:
        yield "positions: no frame has one in both"
        return
    alone = "".join(f", {found[f'only_{x}']} frames only in {x.upper()}" for x in ("a", "b") if found[f"only_{x}"])
    yield (
        f"positions: {found['equal']} of {found['frames']} frames equal, distance median {found['median_m']:.3f} m, "
        f"p95 {found['p95_m']:.3f} m, at most {found['max_m']:.3f} m at {found['max_at_s']:.1f} s{alone}"
    )


def _verdicts(found: list[dict[str, Any]]) -> Iterator[str]:
    changed = [row for row in found if row["a"] != row["b"]]
    if not changed:
        yield "verdicts: the same numbers"
    for row in changed:
        yield f"verdicts: {row['measurement']} {row['verdict']}: {row['a']} -> {row['b']}"


def _delays(found: dict[str, Any]) -> Iterator[str]:
    for name in ("a", "b"):
        delays = found[name]
        if delays is not None:
            shown = ", ".join(f"{p} {ms:.1f} ms" for p, ms in delays.items())
            yield f"delay of an estimate in {name.upper()}: {shown}"
