"""Faults of the table in the sensors of a simulated autopilot."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.core.geodesy import rot_from_quat
from terrafix_lab.faults.edits import Span, gimbal_reports, unchanged
from terrafix_lab.faults.source import EditedSensors
from terrafix_lab.faults.table import FAULTS
from terrafix_lab.sim.camera.mount import Gimbal
from terrafix_lab.sim.interfaces import Readings, State

ZERO = np.zeros(3)
STATE = State(0.0, np.array([0.0, 0.0, 620.0]), ZERO, 0.5, 0.1, -0.2, 100.0, ZERO, ZERO, 12.0)


class Perfect:
    def read(self, state: State) -> Readings:
        angles = state.yaw_rad, state.pitch_rad, state.roll_rad
        held = Gimbal(error_deg=0.0).reported(state)
        return Readings(state.t_s, ZERO, ZERO, *angles, float(state.p_b_in_w_m[2]), None, None, held)


def read(fault: str, span: Span, zero_s: float = 0.0) -> list[Readings]:
    """At 0 to 9 s, with yaw 0.5 + 0.1 a second."""
    sensors = EditedSensors(Perfect())
    sensors.alter(FAULTS[fault].of_telemetry(span), zero_s)
    return [sensors.read(replace(STATE, t_s=float(t), yaw_rad=0.5 + 0.1 * t)) for t in range(10)]


def test_a_wrong_height_is_in_the_barometer_and_a_forged_heading_in_the_compass_within_its_span() -> None:
    assert all(r.baro_amsl_m == pytest.approx(590.0) for r in read("height 30 % low", Span(0.0, 9.0, "")))
    off = [r.yaw_rad - 0.5 - 0.1 * i for i, r in enumerate(read("forged heading", Span(103.0, 105.0, ""), 100.0))]
    assert [round(float(np.degrees(x))) for x in off] == [0, 0, 0, 90, 90, 90, 0, 0, 0, 0]


def test_late_telemetry_shows_what_was_and_true_readings_come_back() -> None:
    late = read("telemetry 2 s late", Span(0.0, 9.0, ""))
    assert [r.yaw_rad for r in late[2:]] == [pytest.approx(0.5 + 0.1 * i) for i in range(8)]
    sensors = EditedSensors(Perfect())
    sensors.alter(FAULTS["roll and pitch swapped"].of_telemetry(Span(0.0, 9.0, "")))
    assert (sensors.read(STATE).pitch_rad, sensors.read(STATE).roll_rad) == (-0.2, 0.1)
    sensors.alter(unchanged)
    assert (sensors.read(STATE).pitch_rad, sensors.read(STATE).roll_rad) == (0.1, -0.2)


def views(readings: list[Readings]) -> list[tuple[float, float] | None]:
    """Heading of a gimbal's right axis less that of STATE's [rad], and angle of its view to straight down [degrees]."""
    found: list[tuple[float, float] | None] = []
    for held in (r.gimbal for r in readings):
        r_w_g = np.eye(3) if held is None else rot_from_quat(held)
        heading_rad, view_deg = np.arctan2(-r_w_g[0, 1], r_w_g[1, 1]) - 0.5, np.degrees(np.arccos(r_w_g[2, 0]))
        found.append(None if held is None else (float(heading_rad), float(view_deg)))
    return found


def test_reports_of_a_gimbal_are_missing_late_frozen_drifting_or_of_a_view_of_the_horizon_within_their_span() -> None:
    span, true = Span(3.0, 6.0, ""), [0.1 * i for i in range(10)]
    assert [v is None for v in views(read("gimbal not reported", span))] == [3 <= i <= 6 for i in range(10)]
    frozen, late = views(read("gimbal frozen", span)), EditedSensors(Perfect())
    late.alter(gimbal_reports(span, age_s=lambda _: 2.0))
    seen = views([late.read(replace(STATE, t_s=float(t), yaw_rad=0.5 + 0.1 * t)) for t in range(10)])
    assert [v and v[0] for v in frozen] == pytest.approx([*true[:3], *[0.3] * 4, *true[7:]])
    assert [v and v[0] for v in seen] == pytest.approx([*true[:3], 0.1, 0.2, 0.3, 0.4, *true[7:]])
    drift, away = (views(read(f"gimbal {name}", span)) for name in ("drifts", "looks away"))
    assert [v and v[1] for v in drift] == pytest.approx([0, 0, 0, 0, 0.25, 0.5, 0.75, 0, 0, 0], abs=1e-4)
    assert [v and round(v[1]) for v in away] == [0, 0, 0, 90, 90, 90, 90, 0, 0, 0]


@pytest.mark.parametrize("name", [name for name, fault in FAULTS.items() if fault.process is None])
def test_no_fault_stops_the_readings(name: str) -> None:
    assert len(read(name, Span(2.0, 8.0, ""))) == 10, "a fault of the camera alone leaves them as they are"
