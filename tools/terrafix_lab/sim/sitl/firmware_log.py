"""Figures of a SITL flight from the firmware's own DataFlash log: nothing that Terrafix or the harness has computed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.core.autopilot_log.dataflash import Table, read_dataflash
from terrafix.link.gnss.source_switch import AUTO_SWITCH, PRIMARY
from terrafix.link.integrity.output_predictor import distance_m
from terrafix_lab.sim.sitl.report import FIX_3D
from terrafix_tools.autopilot_log.ardupilot import ARMED, DISARMED
from terrafix_tools.score import longest_gap_s

POSITION_SOURCE = (AUTO_SWITCH, PRIMARY)  # what `link.gnss = "act"` sets


@dataclass(frozen=True)
class FirmwareReceiver:
    """One GPS of the firmware, from arming to disarming."""

    fix_share: float  # share of the GPS messages with a 3D fix
    longest_gap_s: float  # without a 3D fix
    used_share: float  # share of the messages in which it was the one in use (GPS.U)


@dataclass(frozen=True)
class FirmwareFigures:
    """From arming to disarming or the end of the log. Position errors: POS, the autopilot's own, against SIM, the
    simulator's.
    """

    duration_s: float
    position_median_m: float | None
    position_p95_m: float | None
    position_max_m: float | None
    receivers: dict[str, FirmwareReceiver]  # by number, "1" and "2"
    errors: list[str]  # ERR messages: second since arming, subsystem and code (AP_Logger.h, LogErrorSubsystem)
    parameters: dict[str, float]  # position source parameters at the end


def firmware_figures(folder: Path) -> FirmwareFigures | None:
    """Reads the newest log under ``folder``. None: there is no log. Raises OSError.

    By default the firmware logs while it is armed, and opens the log too late for the event of arming.
    """
    logs = sorted(folder.glob("logs/*.BIN"))
    if not logs:
        return None
    tables = read_dataflash(logs[-1], ("SIM", "POS", "GPS", "ERR", "EV", "PARM")).tables
    events, logged = tables.get("EV"), [table for table in tables.values() if len(table)]
    if not logged:
        return None
    armed_s = _time_of(events, ARMED, 0.0) or min(table.t_s[0] for table in logged)
    end_s = _time_of(events, DISARMED, armed_s) or max(table.t_s[-1] for table in logged)

    def in_flight(name: str) -> Table | None:
        table = tables.get(name)
        return None if table is None else table.of((table.t_s >= armed_s) & (table.t_s <= end_s))

    errors_m = _position_errors_m(in_flight("POS"), in_flight("SIM"))
    gps, reported = in_flight("GPS"), in_flight("ERR")
    return FirmwareFigures(
        duration_s=end_s - armed_s,
        position_median_m=float(np.median(errors_m)) if len(errors_m) else None,
        position_p95_m=float(np.quantile(errors_m, 0.95)) if len(errors_m) else None,
        position_max_m=float(errors_m.max()) if len(errors_m) else None,
        receivers={str(i + 1): _receiver(table) for i, table in (gps.by_instance("I") if gps else {}).items()},
        errors=[] if reported is None else _error_texts(reported, armed_s),
        parameters=_last_values(tables.get("PARM")),
    )


def text_lines(found: FirmwareFigures) -> list[str]:
    """The figures for the terminal, one line each."""
    lines = [f"firmware's log: {found.duration_s:.0f} s from arming to disarming"]
    if found.position_median_m is not None:
        figures = f"{found.position_median_m:.1f} / {found.position_p95_m:.1f} / {found.position_max_m:.1f} m"
        lines.append(f"  its position against SIM, median / 95 % / worst: {figures}")
    for number, gps in found.receivers.items():
        share = f"3D fix {gps.fix_share:.1%}, longest gap {gps.longest_gap_s:.1f} s, in use {gps.used_share:.1%}"
        lines.append(f"  GPS {number}: {share}")
    lines.append(f"  errors: {', '.join(found.errors) or 'none'}")
    lines.append("  at the end: " + ", ".join(f"{name} {value:g}" for name, value in found.parameters.items()))
    return lines


def _time_of(events: Table | None, kind: int, from_s: float) -> float | None:
    if events is None:
        return None
    found = events.t_s[(events.column("Id") == kind) & (events.t_s > from_s)]
    return float(found[0]) if len(found) else None


def _position_errors_m(positions: Table | None, truth: Table | None) -> np.ndarray:
    """(N,) distance of each POS from SIM, which is interpolated to its time."""
    if positions is None or truth is None or len(positions) == 0 or len(truth) < 2:
        return np.empty(0)
    true = [np.interp(positions.t_s, truth.t_s, truth.column(name)) for name in ("Lat", "Lng")]
    own = [positions.column(name) for name in ("Lat", "Lng")]
    return np.array([distance_m(*place) for place in zip(*own, *true, strict=True)])


def _receiver(table: Table) -> FirmwareReceiver:
    fixed = table.column("Status") >= FIX_3D
    return FirmwareReceiver(
        fix_share=float(fixed.mean()),
        longest_gap_s=longest_gap_s(table.t_s[fixed].tolist(), float(table.t_s[0]), float(table.t_s[-1])),
        used_share=float((table.column("U") == 1.0).mean()),
    )


def _error_texts(reported: Table, armed_s: float) -> list[str]:
    rows = zip(reported.t_s - armed_s, reported.integers("Subsys"), reported.integers("ECode"), strict=True)
    return [f"{t_s:.0f} s {subsystem}:{code}" for t_s, subsystem, code in rows]


def _last_values(parameters: Table | None) -> dict[str, float]:
    if parameters is None:
        return {}
    values = dict(zip(parameters.texts("Name"), parameters.column("Value"), strict=True))
    return {name: float(values[name]) for name in POSITION_SOURCE if name in values}
