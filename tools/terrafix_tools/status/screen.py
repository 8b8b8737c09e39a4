"""The facts of a status on one screen of a terminal."""

from typing import Any

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

GOOD, BAD, QUIET = "green", "bold red", "dim"
SOURCES = {
    "satellite_anchored": "map match",
    "visual_propagated": "odometry since the last map match",
    "dead_reckoned": "dead reckoning",
    "not_placed": "not found on the map yet",
}


def screen(found: dict[str, Any], title: str) -> RenderableType:
    """``found``: result of ``facts``."""
    upper = Columns([_position(found), _autopilot(found)], equal=True, expand=True)
    return Panel(Group(upper, _processes(found["processes"]), _rates(found), _log(found)), title=title)


def _position(found: dict[str, Any]) -> Table:
    position = found["position"]
    table = _pairs("Position")
    fix = position["fix"] == "3D"
    text = f"3D fix, accuracy {position['accuracy_m']} m" if fix else f"no fix: {position['reason'] or 'not known why'}"
    table.add_row("GPS_INPUT", Text(text, GOOD if fix else BAD))
    if "lat_deg" in position:
        if position["lat_deg"] is None:
            table.add_row("estimate", Text(f"position unknown: {SOURCES[position['source']]}", BAD))
        else:
            height = "elevation unknown" if position["alt_amsl_m"] is None else f"{position['alt_amsl_m']} m AMSL"
            table.add_row("estimate", f"{position['lat_deg']:.6f}, {position['lon_deg']:.6f}, {height}")
            table.add_row("95 % radius", f"{position['radius_95_m']} m ({SOURCES[position['source']]})")
        table.add_row("height, speed", f"{position['agl_m']} m above ground, {position['speed_mps']} m/s")
    table.add_row("last map fix", _with_unit(position["since_map_fix_s"], "s ago"))
    table.add_row("search", str(position["search"] or "-"))
    return table


def _autopilot(found: dict[str, Any]) -> Table:
    autopilot, computer = found["autopilot"], found["computer"]
    table = _pairs("Autopilot and computer")
    connected = autopilot["connected"]
    table.add_row(
        "link", Text(f"{autopilot['autopilot']} connected" if connected else "no autopilot", GOOD if connected else BAD)
    )
    uses = autopilot["uses_position"]
    ratio = _with_unit(autopilot["position_test_ratio"], "of the gate")
    table.add_row(
        "EKF",
        "-"
        if uses is None
        else Text(f"{'uses' if uses else 'does not use'} a position, {ratio}", GOOD if uses else BAD),
    )
    for receiver, judged in autopilot["gnss"].items():
        table.add_row(
            f"GNSS {receiver}", Text(f"{judged['state']} {judged['why']}", BAD if judged["state"] == "spoofed" else "")
        )
    heat = f"{computer['band'] or '-'}, {_with_unit(computer['temperature_c'], '°C')}"
    table.add_row("heat", Text(heat, BAD if computer["throttled"] or computer["band"] == "critical" else ""))
    load = None if computer["load"] is None else round(100 * computer["load"])
    if (rate := found["frame_rate"]) is not None:
        slow = ": the computer is too slow" if rate["computer_too_slow"] else ""
        text = f"running at {rate['taken_hz']:.2g} of {rate['offered_hz']:.2g} Hz{slow}"
        table.add_row("frames", Text(text, BAD if slow else ""))
    table.add_row("load, power", f"{_with_unit(load, '%')}, {_with_unit(computer['power_w'], 'W')}")
    table.add_row("disk", _with_unit(computer["disk_free_mb"], "MB free"))
    return table


def _processes(processes: list[dict[str, Any]]) -> Table:
    table = Table(title="Processes", title_justify="left", expand=True)
    for name in ("process", "state", "last progress", "load", "restarts", "last event"):
        table.add_column(name)
    for process in processes:
        load = None if process["load"] is None else round(100 * process["load"])
        table.add_row(
            process["name"],
            Text(process["state"], GOOD if process["state"] == "running" else BAD),
            _with_unit(process["idle_s"], "s"),
            _with_unit(load, "%"),
            str(process["restarts"]),
            Text(process["last_event"], QUIET),
        )
    return table


def _rates(found: dict[str, Any]) -> Text:
    rates = ", ".join(f"{name} {rate:g}/s" for name, rate in found["rates_hz"].items())
    share = found["map_matches_accepted"]
    matched = "" if share is None else f"; {100 * share:.0f} % of the map matches accepted"
    dropped = ", ".join(f"{what} {count}" for what, count in found["dropped"].items())
    return Text(
        f"{rates}{matched}; image to estimate {_with_unit(found['delay_ms'], 'ms')}; lost messages: {dropped or 'none'}"
    )


def _log(found: dict[str, Any]) -> Text:
    lines = [*(f"rejected  {line}" for line in found["rejected"]), *(f"pilot     {line}" for line in found["texts"])]
    return Text("\n".join(lines), QUIET, no_wrap=True, overflow="ellipsis")


def _pairs(title: str) -> Table:
    table = Table(title=title, title_justify="left", show_header=False, box=None)
    table.add_column(style=QUIET)
    table.add_column()
    return table


def _with_unit(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:g} {unit}"
