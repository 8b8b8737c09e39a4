"""The messages that the autopilot is asked for, at which rate, and whether they come.

SET_MESSAGE_INTERVAL first; a firmware that does not know it is asked with REQUEST_DATA_STREAM, which sets whole groups.
What comes too slowly is asked for again: an autopilot that has rebooted is back at its own rates."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

NS_PER_S = 1_000_000_000
WINDOW_NS = 3 * NS_PER_S  # rates are measured over this long, and a stream is asked for again at most so often
PATIENCE = 5  # asked so often in vain: from then on
SELDOM_NS = 30 * NS_PER_S
ENOUGH = 0.7  # share of the rate below which it counts as too slow: ArduPilot rounds intervals to its loop
OLD_AFTER = 2  # windows without any effect or answer, after which the old request is tried too
# Attitude at 25 Hz interpolates a turn for the frames and levels the IMU. Of that 33 Hz are 1.3 kB/s, and what a plane
# can give: ArduPilot sends nothing faster than 0.8 of its main loop (plane: 50 Hz), in whole loops. Height at 5 Hz
# follows the barometer; time once a second; receivers at 5 Hz, that a spoofed one is seen within a second.
STREAMS_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 25.0,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 33.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,  # for relative_alt alone: the zero of the height, and without
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 5.0,  # this the height itself (pressure_height.py)
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: 5.0,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 1.0,  # whether its filter uses our position
    mavlink.MAVLINK_MSG_ID_AIRSPEED: 5.0,
}
PX4_HAS = {  # what PX4 says instead
    mavlink.MAVLINK_MSG_ID_RAW_IMU: mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
}
OPTIONAL = {  # not there without a second receiver; not everywhere; not without a sensor; there is another height
    mavlink.MAVLINK_MSG_ID_GPS2_RAW,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
    mavlink.MAVLINK_MSG_ID_AIRSPEED,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
}
NOT_OF_PX4 = {mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE}  # not tried there
# Without a receiver, without a position, PX4 says nothing at all; its height above home is then in ALTITUDE.
OPTIONAL_ON_PX4 = OPTIONAL | {mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT}
ONLY_PX4_HZ = {mavlink.MAVLINK_MSG_ID_ALTITUDE: 5.0}
# How often what has never come is asked for: ArduPilot before 4.6 refuses it, and tells its pilot so each time.
UNKNOWN_TO_MANY = {mavlink.MAVLINK_MSG_ID_AIRSPEED: 2}
GROUPS = {  # the group of REQUEST_DATA_STREAM that carries it (ArduPilot's SRn_ parameters)
    mavlink.MAVLINK_MSG_ID_ATTITUDE: mavlink.MAV_DATA_STREAM_EXTRA1,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: mavlink.MAV_DATA_STREAM_RAW_SENSORS,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: mavlink.MAV_DATA_STREAM_POSITION,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: mavlink.MAV_DATA_STREAM_EXTRA3,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: mavlink.MAV_DATA_STREAM_EXTENDED_STATUS,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: mavlink.MAV_DATA_STREAM_EXTENDED_STATUS,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: mavlink.MAV_DATA_STREAM_EXTRA3,
}


def wanted_of(firmware: str) -> dict[int, float]:
    if firmware != "px4":
        return STREAMS_HZ
    return {PX4_HAS.get(i, i): hz for i, hz in STREAMS_HZ.items() if i not in NOT_OF_PX4} | ONLY_PX4_HZ


class Streams:
    """``heard`` every message of the autopilot; send what ``requests`` gives."""

    def __init__(self, wanted_hz: dict[int, float]) -> None:
        self.wanted_hz = wanted_hz
        self._optional = OPTIONAL
        self.restart()

    def serve(self, firmware: str, wanted_hz: dict[int, float]) -> None:
        """``wanted_hz``: of ``wanted_of`` what fits the line. Nothing happens while it is the same."""
        if wanted_hz != self.wanted_hz:
            self.wanted_hz = wanted_hz
            self._optional = OPTIONAL_ON_PX4 if firmware == "px4" else OPTIONAL
            self.restart()

    def restart(self) -> None:
        """Also for a new connection: everything is asked for again."""
        self._counts: dict[int, int] = {}
        self._window_ns: int | None = None
        self.rates_hz: dict[int, float] = {}  # of the last whole window
        self._least_hz = 0.0  # what one message makes in it
        self._asked_ns: dict[int, int] = {}
        self._asked: dict[int, int] = {}  # how often, since it last came as wanted
        self._came: set[int] = set()
        self._old_way = False
        self._refused: set[int] = set()

    def heard(self, message_id: int) -> None:
        if message_id in self.wanted_hz:
            self._counts[message_id] = self._counts.get(message_id, 0) + 1
            self._came.add(message_id)

    def answered(self, result: int) -> None:
        """COMMAND_ACK of SET_MESSAGE_INTERVAL; it does not say of which message."""
        if result == mavlink.MAV_RESULT_UNSUPPORTED:
            self._old_way = True
        elif result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
            self._refused.add(result)

    def requests(self, sysid: int, compid: int, now_ns: int) -> Iterator[Any]:
        self._measure(now_ns)
        groups: dict[int, float] = {}
        for message_id, rate_hz in self.wanted_hz.items():
            if not self._due(message_id, now_ns):
                continue
            self._asked_ns[message_id] = now_ns
            self._asked[message_id] = self._asked.get(message_id, 0) + 1
            yield mavlink.MAVLink_command_long_message(
                sysid,
                compid,
                mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                0,
                float(message_id),
                1e6 / rate_hz,
                *(0.0,) * 5,
            )
            in_vain = self._asked[message_id] > OLD_AFTER and message_id not in self._optional
            if (self._old_way or in_vain) and message_id in GROUPS:
                groups[GROUPS[message_id]] = max(rate_hz, groups.get(GROUPS[message_id], 0.0))
        for group, rate_hz in groups.items():
            yield mavlink.MAVLink_request_data_stream_message(sysid, compid, group, round(rate_hz), 1)

    def problem(self) -> str:
        """Which streams are too slow; empty when all is well."""
        slow = [
            f"{mavlink.mavlink_map[i].msgname} {self.rates_hz[i]:.1f} of {wanted:g} Hz"
            for i, wanted in self.wanted_hz.items()
            if i not in self._optional and self._slow(i)
        ]
        notes = [f"too slow: {', '.join(slow)}"] if slow else []
        if slow and self._refused:
            notes.append(f"message rates refused (MAV_RESULT {', '.join(map(str, sorted(self._refused)))})")
        return "; ".join(notes)

    def _measure(self, now_ns: int) -> None:
        if self._window_ns is None:
            self._window_ns = now_ns
        elapsed_ns = now_ns - self._window_ns
        if elapsed_ns < WINDOW_NS:
            return
        self.rates_hz = {i: self._counts.get(i, 0) * 1e9 / elapsed_ns for i in self.wanted_hz}
        self._counts.clear()
        self._window_ns = now_ns
        self._least_hz = 1e9 / elapsed_ns
        for message_id in self.rates_hz:
            if not self._slow(message_id):
                self._asked[message_id] = 0

    def _due(self, message_id: int, now_ns: int) -> bool:
        """The first time at once, even if it already comes: its rate is another's choice."""
        asked_ns = self._asked_ns.get(message_id)
        if asked_ns is None:
            return True
        asked, known = self._asked.get(message_id, 0), message_id in self._came or message_id not in UNKNOWN_TO_MANY
        if not known and asked >= UNKNOWN_TO_MANY[message_id]:
            return False
        wait_ns = WINDOW_NS if known and asked < PATIENCE else SELDOM_NS
        if now_ns - asked_ns < wait_ns or message_id not in self.rates_hz:
            return False
        return self._slow(message_id)

    def _slow(self, message_id: int) -> bool:
        """In the last window; of what comes once a second, one more may have come just before or behind it."""
        rate_hz = self.rates_hz.get(message_id)
        return rate_hz is not None and rate_hz + self._least_hz < ENOUGH * self.wanted_hz[message_id]
