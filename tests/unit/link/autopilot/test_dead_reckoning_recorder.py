"""After a restart the link publishes the dead reckoning of the autopilot's EKF since our last fix, if the EKF had no
other position source."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gps_messages import GPS
from link_wire import WiredEdge, heartbeat
from terrafix.core.geodesy import LocalFrame
from terrafix.link.autopilot.ekf_dead_reckoning import EkfState, LastFix, _dead_reckoning_since
from terrafix.messages import EkfDeadReckoning, GpsInput, Message

S = 1_000_000_000
GPS_ID = 1
PLACE = LocalFrame(48.0, 11.0)
HEALTHY_FLAGS = mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_POS_HORIZ_REL
SPEED_MPS, RATE_RADPS = 22.0, 0.4  # a bank of 42 degrees
KILLED_S, RESTARTED_S = 2.0, 8.0
EKF_ERROR_M, EKF_ERROR_MPS = (30.0, -10.0), (0.5, -0.25)  # constant errors of the EKF: position, velocity

CLIMB_MPS2 = 0.05  # the climb rate grows


def truth(t_s: float) -> tuple[float, float, float, float]:
    """-> east, north [m] and their velocities [m/s] of a circling plane."""
    course, radius_m = RATE_RADPS * t_s, SPEED_MPS / RATE_RADPS
    way = radius_m * math.sin(course), radius_m * (1.0 - math.cos(course))
    return *way, SPEED_MPS * math.cos(course), SPEED_MPS * math.sin(course)


def ekf_position(t_s: float, boot_s: float = 100.0) -> Any:
    east_m, north_m, ve, vn = truth(t_s)
    east_m, north_m = (
        east_m + EKF_ERROR_M[0] + EKF_ERROR_MPS[0] * t_s,
        north_m + EKF_ERROR_M[1] + EKF_ERROR_MPS[1] * t_s,
    )
    lat_deg, lon_deg = PLACE.to_wgs84(east_m, north_m)
    cm = round(100 * (vn + EKF_ERROR_MPS[1])), round(100 * (ve + EKF_ERROR_MPS[0])), -round(100 * CLIMB_MPS2 * t_s)
    place = round(lat_deg * 1e7), round(lon_deg * 1e7), 500_000, 120_000
    return mavlink.MAVLink_global_position_int_message(round(1e3 * (boot_s + t_s)), *place, *cm, 0)


def receiver(fix_type: int) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(0, fix_type, 480_000_000, 110_000_000, 0, 100, 100, 0, 0, 7)


def status(flags: int = HEALTHY_FLAGS) -> Any:
    return mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.1)


def fix(t_s: float, fix_type: int = 3) -> GpsInput:
    east_m, north_m, ve, vn = truth(t_s)
    lat_deg, lon_deg = PLACE.to_wgs84(east_m, north_m)
    velocity = {"vn_mps": vn, "ve_mps": ve, "vd_mps": -1.0, "speed_accuracy_mps": 0.4}
    where = {"lat_deg": lat_deg, "lon_deg": lon_deg, "horiz_accuracy_m": 5.0}
    return msgspec.structs.replace(GPS, t_ns=round(t_s * S), fix_type=fix_type, **where, **velocity)


class RecordingAutopilot:
    """An autopilot connected to successive link processes that share a checkpoint file."""

    def __init__(self, checkpoint_file: Path) -> None:
        self._checkpoint_file = checkpoint_file
        self.restart()

    def restart(self) -> None:
        self.link = WiredEdge(checkpoint=self._checkpoint_file, gps_id=GPS_ID)

    def sends(self, t_s: float, *messages: Any) -> list[Message]:
        return self.link.receives(round(t_s * S), *messages)

    def requested(self) -> list[int]:
        """-> ids of messages that were requested once, since the last call."""
        commands = self.link.wire.take("COMMAND_LONG")
        return [int(x.param1) for x in commands if x.command == mavlink.MAV_CMD_REQUEST_MESSAGE]

    def fly_until_killed(self, *, receiver_fix: int = 1) -> None:
        """Sends fixes at 10 Hz and EKF positions at 5 Hz until KILLED_S."""
        beat = heartbeat(mode=mavlink.MAV_MODE_FLAG_SAFETY_ARMED, kind=mavlink.MAV_TYPE_FIXED_WING)
        self.sends(0.0, beat, receiver(receiver_fix), status())
        for tenth in range(round(KILLED_S * 10) + 1):
            if tenth % 2:
                self.sends(0.1 * tenth - 0.04, ekf_position(0.1 * tenth - 0.04))
            self.link.edge.on_message(fix(0.1 * tenth))


def dead_reckonings(messages: Iterable[Message]) -> list[EkfDeadReckoning]:
    return [x for x in messages if isinstance(x, EkfDeadReckoning)]


@pytest.fixture
def autopilot(tmp_path: Path) -> RecordingAutopilot:
    return RecordingAutopilot(tmp_path / "link.checkpoint")


@pytest.fixture
def restarted(autopilot: RecordingAutopilot) -> RecordingAutopilot:
    """The link was killed in flight and has started again."""
    autopilot.fly_until_killed()
    autopilot.restart()
    return autopilot


def test_a_restarted_link_publishes_the_dead_reckoning_of_the_ekf(restarted: RecordingAutopilot) -> None:
    assert not dead_reckonings(
        restarted.sends(RESTARTED_S - 0.2, ekf_position(RESTARTED_S - 0.2))
    )  # EKF status and receivers are not known yet
    (message,) = dead_reckonings(restarted.sends(RESTARTED_S, status(), receiver(1), ekf_position(RESTARTED_S)))
    since_s = RESTARTED_S - message.duration_s
    assert KILLED_S - 0.3 < since_s <= KILLED_S and message.t_ns == round(RESTARTED_S * S)
    # Position and velocity are those of our fix at the time of the EKF state.
    before, now = truth(since_s), truth(RESTARTED_S)
    assert PLACE.to_local(message.lat_deg, message.lon_deg) == pytest.approx(before[:2], abs=0.2)
    assert message.velocity_enu_mps == pytest.approx((*before[2:], 1.0), abs=0.05)
    assert (message.position_sigma_m, message.velocity_sigma_mps) == (5.0, 0.4)
    # Displacement and change of velocity do not contain the error that the EKF had at that time.
    way_m = [now[i] - before[i] - message.duration_s * before[2 + i] for i in range(2)]
    assert message.delta_p_m == pytest.approx(way_m, abs=0.3) and math.hypot(*way_m) > 50.0
    assert message.delta_v_mps == pytest.approx(
        (now[2] - before[2], now[3] - before[3], CLIMB_MPS2 * message.duration_s), abs=0.02
    )
    assert message.delta_v_mps[2] > 0.2


def test_a_restarted_link_requests_the_slow_messages(restarted: RecordingAutopilot) -> None:
    restarted.sends(RESTARTED_S, ekf_position(RESTARTED_S))
    assert set(restarted.requested()) == {193, 24, 124}  # EKF_STATUS_REPORT, GPS_RAW_INT, GPS2_RAW
    restarted.sends(RESTARTED_S + 0.5, status(), receiver(1))
    assert not restarted.requested()


@pytest.mark.parametrize(("before", "after"), [(3, 1), (1, 3)])
def test_no_dead_reckoning_is_published_while_another_receiver_has_a_fix(
    autopilot: RecordingAutopilot, before: int, after: int
) -> None:
    autopilot.fly_until_killed(receiver_fix=before)
    autopilot.restart()
    assert not dead_reckonings(autopilot.sends(RESTARTED_S, status(), receiver(after), ekf_position(RESTARTED_S)))
    assert not dead_reckonings(
        autopilot.sends(RESTARTED_S + 0.2, status(), receiver(1), ekf_position(RESTARTED_S + 0.2))
    )


def test_no_dead_reckoning_is_published_before_the_known_receiver_is_received(restarted: RecordingAutopilot) -> None:
    assert not dead_reckonings(restarted.sends(RESTARTED_S, status(), ekf_position(RESTARTED_S)))
    assert dead_reckonings(restarted.sends(RESTARTED_S + 0.2, receiver(1), ekf_position(RESTARTED_S + 0.2)))


@pytest.mark.parametrize("flags", [mavlink.EKF_ATTITUDE, HEALTHY_FLAGS | mavlink.EKF_CONST_POS_MODE])
def test_no_dead_reckoning_is_published_without_a_valid_ekf_velocity(restarted: RecordingAutopilot, flags: int) -> None:
    assert not dead_reckonings(restarted.sends(RESTARTED_S, status(flags), receiver(1), ekf_position(RESTARTED_S)))


def test_no_dead_reckoning_is_published_after_a_reboot_or_more_than_a_minute(restarted: RecordingAutopilot) -> None:
    assert not dead_reckonings(
        restarted.sends(RESTARTED_S, status(), receiver(1), ekf_position(RESTARTED_S, boot_s=1.0))
    )
    assert not dead_reckonings(restarted.sends(80.0, status(), receiver(1), ekf_position(80.0)))


def test_no_dead_reckoning_is_published_while_we_send_a_fix(autopilot: RecordingAutopilot) -> None:
    autopilot.fly_until_killed()
    assert not dead_reckonings(autopilot.sends(KILLED_S + 0.1, ekf_position(KILLED_S + 0.1)))
    autopilot.link.edge.on_message(fix(KILLED_S + 0.2, fix_type=1))
    assert dead_reckonings(autopilot.sends(KILLED_S + 0.3, status(), receiver(1), ekf_position(KILLED_S + 0.3)))


def test_dead_reckoning_continues_through_the_wrap_of_the_boot_time() -> None:
    at_fix = EkfState(2**32 - 1000, 48.0, 11.0, (0.0, 0.0, 0.0))
    last = LastFix(at_fix, 48.0, 11.0, (0.0, 0.0, 0.0), 3.0, 0.5, frozenset())
    (sample,) = _dead_reckoning_since(last, msgspec.structs.replace(at_fix, boot_ms=1000), S)
    assert sample.duration_s == 2.0
    assert list(_dead_reckoning_since(last, msgspec.structs.replace(at_fix, boot_ms=70_000), S)) == []
