"""After a restart the link says how the autopilot's filter moved since our last fix, if nothing else led it."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import MemoryWire, packed
from terrafix.core.config import LinkSection
from terrafix.core.geodesy import LocalFrame
from terrafix.link.autopilot.checkpoint import CheckpointWriter
from terrafix.link.autopilot.ekf_dead_reckoning import Filter, LastFix, _moved
from terrafix.link.edge import MavlinkEdge
from terrafix.messages import Coasted, GpsInput, Message

S, MS = 1_000_000_000, 1_000_000
GPS_ID = 1
PLACE = LocalFrame(48.0, 11.0)
MOVES = mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_POS_HORIZ_REL
SPEED_MPS, RATE_RADPS = 22.0, 0.4  # a bank of 42 degrees
KILLED_S, BACK_S = 2.0, 8.0
WRONG_M, WRONG_MPS = (30.0, -10.0), (0.5, -0.25)  # of the filter, all the while


def truth(t_s: float) -> tuple[float, float, float, float]:
    """East, north [m], their velocity [m/s], of a plane that circles."""
    course, radius_m = RATE_RADPS * t_s, SPEED_MPS / RATE_RADPS
    way = radius_m * math.sin(course), radius_m * (1.0 - math.cos(course))
    return *way, SPEED_MPS * math.cos(course), SPEED_MPS * math.sin(course)


def belief(t_s: float, boot_s: float = 100.0) -> Any:
    east_m, north_m, ve, vn = truth(t_s)
    east_m, north_m = east_m + WRONG_M[0] + WRONG_MPS[0] * t_s, north_m + WRONG_M[1] + WRONG_MPS[1] * t_s
    lat_deg, lon_deg = PLACE.to_wgs84(east_m, north_m)
    cm = round(100 * (vn + WRONG_MPS[1])), round(100 * (ve + WRONG_MPS[0])), -150
    place = round(lat_deg * 1e7), round(lon_deg * 1e7), 500_000, 120_000
    return mavlink.MAVLink_global_position_int_message(round(1e3 * (boot_s + t_s)), *place, *cm, 0)


def receiver(fix_type: int) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(0, fix_type, 480_000_000, 110_000_000, 0, 100, 100, 0, 0, 7)


def status(flags: int = MOVES) -> Any:
    return mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.1)


def fix(t_s: float, fix_type: int = 3) -> GpsInput:
    east_m, north_m, ve, vn = truth(t_s)
    lat_deg, lon_deg = PLACE.to_wgs84(east_m, north_m)
    return GpsInput(
        t_ns=round(t_s * S),
        fix_type=fix_type,
        time_week=2445,
        time_week_ms=0,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_amsl_m=500.0,
        hdop=1.0,
        vdop=1.0,
        vn_mps=vn,
        ve_mps=ve,
        vd_mps=-1.0,
        speed_accuracy_mps=0.4,
        horiz_accuracy_m=5.0,
        vert_accuracy_m=5.0,
        satellites_visible=9,
        estimate_age_ms=300.0,
    )


class Autopilot:
    """On the wire of one link after another, which keep what they know in ``kept``."""

    def __init__(self, kept: Path) -> None:
        self._kept = kept
        self._mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        self.restart()

    def restart(self) -> None:
        self.wire = MemoryWire()
        config = msgspec.structs.replace(LinkSection(), gps_id=GPS_ID)
        self.edge = MavlinkEdge(config, self.wire, lambda: 0, keeper=CheckpointWriter(self._kept))

    def sends(self, t_s: float, *messages: Any) -> list[Message]:
        self.wire.arrive(*(packed(message, self._mav) for message in messages))
        return list(self.edge.poll(round(t_s * S)))

    def is_served(self, *, receiver_fix: int = 1) -> None:
        """Ten fixes a second, and five words of the filter, until the link is killed."""
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        plane, ardupilot = mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        beat = mavlink.MAVLink_heartbeat_message(plane, ardupilot, armed, 0, mavlink.MAV_STATE_ACTIVE, 3)
        self.sends(0.0, beat, receiver(receiver_fix), status())
        for tenth in range(round(KILLED_S * 10) + 1):
            if tenth % 2:
                self.sends(0.1 * tenth - 0.04, belief(0.1 * tenth - 0.04))
            self.edge.heard(fix(0.1 * tenth))


def coasted(said: Iterable[Message]) -> list[Coasted]:
    return [x for x in said if isinstance(x, Coasted)]


@pytest.fixture
def autopilot(tmp_path: Path) -> Autopilot:
    return Autopilot(tmp_path / "link.checkpoint")


def test_who_is_started_again_says_how_the_filter_moved(autopilot: Autopilot) -> None:
    autopilot.is_served()
    autopilot.restart()
    assert not coasted(autopilot.sends(BACK_S - 0.2, belief(BACK_S - 0.2)))  # what led it is not known yet
    (said,) = coasted(autopilot.sends(BACK_S, status(), receiver(1), belief(BACK_S)))
    since_s = BACK_S - said.coast_s
    assert KILLED_S - 0.3 < since_s <= KILLED_S and said.t_ns == round(BACK_S * S)
    # Our own position and velocity, at the time of the filter's words ...
    before, now = truth(since_s), truth(BACK_S)
    assert PLACE.to_local(said.lat_deg, said.lon_deg) == pytest.approx(before[:2], abs=0.2)
    assert said.velocity_enu_mps == pytest.approx((*before[2:], 1.0), abs=0.05)
    assert (said.position_sigma_m, said.velocity_sigma_mps) == (5.0, 0.4)
    # ... and what became of them, without what the filter had wrong before.
    way_m = [now[i] - before[i] - said.coast_s * before[2 + i] for i in range(2)]
    assert said.way_m == pytest.approx(way_m, abs=0.3) and math.hypot(*way_m) > 50.0
    assert said.gain_mps == pytest.approx((now[2] - before[2], now[3] - before[3], 0.0), abs=0.02)


def test_it_asks_for_what_it_would_have_to_wait_for(autopilot: Autopilot) -> None:
    autopilot.is_served()
    autopilot.restart()
    autopilot.sends(BACK_S, belief(BACK_S))
    asked = {int(x.param1) for x in autopilot.wire.take("COMMAND_LONG") if x.command == mavlink.MAV_CMD_REQUEST_MESSAGE}
    assert asked == {193, 24, 124}  # EKF_STATUS_REPORT, GPS_RAW_INT, GPS2_RAW
    autopilot.sends(BACK_S + 0.5, status(), receiver(1))
    assert not any(x.command == mavlink.MAV_CMD_REQUEST_MESSAGE for x in autopilot.wire.take("COMMAND_LONG"))


@pytest.mark.parametrize(("before", "after"), [(3, 1), (1, 3)])
def test_not_while_a_receiver_may_lead_it_astray(autopilot: Autopilot, before: int, after: int) -> None:
    autopilot.is_served(receiver_fix=before)
    autopilot.restart()
    assert not coasted(autopilot.sends(BACK_S, status(), receiver(after), belief(BACK_S)))
    assert not coasted(autopilot.sends(BACK_S + 0.2, status(), receiver(1), belief(BACK_S + 0.2)))


def test_not_before_the_receiver_that_it_had_was_heard(autopilot: Autopilot) -> None:
    autopilot.is_served()
    autopilot.restart()
    assert not coasted(autopilot.sends(BACK_S, status(), belief(BACK_S)))
    assert coasted(autopilot.sends(BACK_S + 0.2, receiver(1), belief(BACK_S + 0.2)))


@pytest.mark.parametrize("flags", [mavlink.EKF_ATTITUDE, MOVES | mavlink.EKF_CONST_POS_MODE])
def test_not_of_a_filter_that_has_lost_its_velocity(autopilot: Autopilot, flags: int) -> None:
    autopilot.is_served()
    autopilot.restart()
    assert not coasted(autopilot.sends(BACK_S, status(flags), receiver(1), belief(BACK_S)))


def test_not_of_another_boot_nor_after_more_than_a_minute(autopilot: Autopilot) -> None:
    autopilot.is_served()
    autopilot.restart()
    assert not coasted(autopilot.sends(BACK_S, status(), receiver(1), belief(BACK_S, boot_s=1.0)))
    assert not coasted(autopilot.sends(80.0, status(), receiver(1), belief(80.0)))


def test_not_while_it_has_our_own_fix(autopilot: Autopilot) -> None:
    autopilot.is_served()
    assert not coasted(autopilot.sends(KILLED_S + 0.1, belief(KILLED_S + 0.1)))
    autopilot.edge.heard(fix(KILLED_S + 0.2, fix_type=1))
    assert coasted(autopilot.sends(KILLED_S + 0.3, status(), receiver(1), belief(KILLED_S + 0.3)))


def test_the_wrap_of_the_autopilots_time_is_no_other_boot() -> None:
    at_fix = Filter(2**32 - 1000, 48.0, 11.0, (0.0, 0.0, 0.0))
    last = LastFix(at_fix, 48.0, 11.0, (0.0, 0.0, 0.0), 3.0, 0.5, frozenset())
    (coasted,) = _moved(last, msgspec.structs.replace(at_fix, boot_ms=1000), S)
    assert coasted.coast_s == 2.0
    assert list(_moved(last, msgspec.structs.replace(at_fix, boot_ms=70_000), S)) == []
