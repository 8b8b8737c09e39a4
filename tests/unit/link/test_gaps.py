"""The position is used again after gaps of the camera, by the simulated autopilot with each parameter file."""

from pathlib import Path

import pytest

from autopilot_rig import Rig
from companion_rig import Companion
from terrafix.core.config import LinkSection
from terrafix.messages import GpsInput
from terrafix_lab.sim.autopilot.parameters import BESIDE_A_RECEIVER, Kind

BEGIN_S = 20.0
EKF_POS_HORIZ_ABS = 16
BACK_S = 2.0  # from the first good estimate until the autopilot uses the position


def flight_with_a_gap(kind: Kind, gap_s: float, folder: Path, parameters: dict[str, float]) -> tuple[Companion, float]:
    """-> the flight at the moment in which the autopilot uses the position again, or 10 s later, and the seconds since
    the first estimate. After the gap the accuracy is 8 m, and 4.9 m after another second."""
    second = parameters.get("GPS2_TYPE") == 14.0
    flight = Companion(Rig(kind, parameters=parameters), LinkSection(gps_id=int(second)), folder)
    flight.fly(BEGIN_S)
    end_s = BEGIN_S + gap_s
    flight.fly(end_s - 0.02, lambda _: None)
    counts = flight.rig.autopilot.counts
    before = counts.accepted + counts.resets
    flight.fly(
        end_s + 10.0,
        lambda t_s: max(4.9, 8.0 - 3.1 * (t_s - end_s)),
        until=lambda: counts.accepted + counts.resets > before and bool(flight.rig.flags() & EKF_POS_HORIZ_ABS),
    )
    return flight, flight.rig.t_s - end_s


@pytest.mark.parametrize("gap_s", [5.0, 10.0, 20.0, 60.0])
@pytest.mark.parametrize("kind", list(Kind))
@pytest.mark.parametrize("beside_a_receiver", [False, True])
def test_after_a_gap_the_autopilot_uses_the_position_within_2_s(
    kind: Kind, gap_s: float, beside_a_receiver: bool, tmp_path: Path
) -> None:
    """The receiver has no fix: it is jammed."""
    parameters = BESIDE_A_RECEIVER | {"GPS1_TYPE": 1.0} if beside_a_receiver else {}
    flight, after_s = flight_with_a_gap(kind, gap_s, tmp_path, parameters)
    assert after_s <= BACK_S
    assert flight.rig.error_m() < 5.0


@pytest.mark.parametrize("gap_s", [20.0, 60.0])
def test_a_copter_with_the_default_check_uses_a_position_that_gets_better_within_a_second(
    gap_s: float, tmp_path: Path
) -> None:
    """EK3_GPS_CHECK 31, which preflight reports: the first accuracy is withheld until it opens the check."""
    flight, after_s = flight_with_a_gap(Kind.COPTER, gap_s, tmp_path, {"EK3_GPS_CHECK": 31.0})
    assert after_s <= BACK_S
    sent = [x for x in flight.published if isinstance(x, GpsInput) and x.t_ns > (BEGIN_S + gap_s) * 1e9]
    first = next(x for x in sent if x.fix_type == 3)
    assert first.horiz_accuracy_m <= 6.5
