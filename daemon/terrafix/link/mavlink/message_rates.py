"""Requests telemetry streams from the autopilot, with their rates, and monitors the rates received.

SET_MESSAGE_INTERVAL is used first; firmware that does not support it gets REQUEST_DATA_STREAM, which sets groups of
messages. A stream that is too slow is requested again: a rebooted autopilot is back at its own rates."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.clock import NS_PER_S

WINDOW_NS = 3 * NS_PER_S  # window of the rate measurement, and shortest time between requests of one stream [tuned]
MAX_QUICK_REQUESTS = 5  # requests without success at the period of WINDOW_NS, then SLOW_REQUEST_PERIOD_NS [tuned]
SLOW_REQUEST_PERIOD_NS = 30 * NS_PER_S  # [tuned]
# Share of the wanted rate below which a stream is too slow: ArduPilot rounds intervals to its main loop. [tuned]
MIN_RATE_SHARE = 0.7
# Requests by SET_MESSAGE_INTERVAL without effect, after which REQUEST_DATA_STREAM is sent as well. [tuned]
MAX_INTERVAL_REQUESTS = 2
# Hz. ATTITUDE at 25 Hz interpolates turns for the frames and levels the IMU. RAW_IMU at 33 Hz takes 1.3 kB/s; it is the
# most that a plane delivers: ArduPilot sends nothing faster than 0.8 of its main loop (plane: 50 Hz), in whole loops.
# Heights at 5 Hz follow the barometer; between reports at 10 Hz a gimbal that turns by 10 degrees/s turns by one.
# Receivers at 5 Hz: spoofing is then detected within a second. [tuned]
STREAMS_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 25.0,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 33.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,  # relative_alt only: zero of the height (pressure_height.py)
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 5.0,  # the height; without it relative_alt is used
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: 5.0,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 1.0,  # whether the EKF uses our position
    mavlink.MAVLINK_MSG_ID_AIRSPEED: 5.0,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: 5.0,  # all streams then fit 57600 baud
}
PX4_EQUIVALENTS = {  # ArduPilot's message -> the one that PX4 sends instead
    mavlink.MAVLINK_MSG_ID_RAW_IMU: mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
}
OPTIONAL = {  # their absence is not reported
    mavlink.MAVLINK_MSG_ID_GPS2_RAW,  # needs a second receiver
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,  # not supported by all firmware
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
    mavlink.MAVLINK_MSG_ID_AIRSPEED,  # needs a sensor
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS,  # needs a gimbal
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,  # relative_alt replaces it
}
PX4_UNAVAILABLE = {mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE}  # not tested on PX4
# PX4 sends neither message without a receiver and a position; its height above home is then in ALTITUDE.
OPTIONAL_ON_PX4 = OPTIONAL | {mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT}
PX4_EXTRA_HZ = {mavlink.MAVLINK_MSG_ID_ALTITUDE: 5.0}  # Hz, on PX4 only [tuned]
# Requests of a message that was never received: ArduPilot before 4.6 rejects each with a text to the pilot. [tuned]
MAX_UNANSWERED_REQUESTS = {mavlink.MAVLINK_MSG_ID_AIRSPEED: 2, mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: 2}
DATA_STREAM_GROUPS = {  # message -> group of REQUEST_DATA_STREAM that contains it (ArduPilot's SRn_ parameters)
    mavlink.MAVLINK_MSG_ID_ATTITUDE: mavlink.MAV_DATA_STREAM_EXTRA1,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: mavlink.MAV_DATA_STREAM_RAW_SENSORS,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: mavlink.MAV_DATA_STREAM_POSITION,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: mavlink.MAV_DATA_STREAM_EXTRA3,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: mavlink.MAV_DATA_STREAM_EXTENDED_STATUS,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: mavlink.MAV_DATA_STREAM_EXTENDED_STATUS,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: mavlink.MAV_DATA_STREAM_EXTRA3,
}


def streams_of_firmware(firmware: str) -> dict[int, float]:
    """-> message id -> wanted rate [Hz]."""
    if firmware != "px4":
        return STREAMS_HZ
    return {PX4_EQUIVALENTS.get(i, i): hz for i, hz in STREAMS_HZ.items() if i not in PX4_UNAVAILABLE} | PX4_EXTRA_HZ


class Streams:
    """Requests streams and measures their rates. ``wanted_hz``: message id -> wanted rate."""

    def __init__(self, wanted_hz: dict[int, float]) -> None:
        self.wanted_hz = wanted_hz
        self._optional = OPTIONAL
        self.restart()

    def set_firmware(self, firmware: str, wanted_hz: dict[int, float]) -> None:
        """``wanted_hz``: ``streams_of_firmware``, limited to the bandwidth. No effect unless it differs from before."""
        if wanted_hz != self.wanted_hz:
            self.wanted_hz = wanted_hz
            self._optional = OPTIONAL_ON_PX4 if firmware == "px4" else OPTIONAL
            self.restart()

    def restart(self) -> None:
        """Requests all streams again; also used for a new connection."""
        self._counts: dict[int, int] = {}
        self._window_start_ns: int | None = None
        self.rates_hz: dict[int, float] = {}  # measured over the last complete window
        self._rate_resolution_hz = 0.0  # rate of one message in that window
        self._requested_ns: dict[int, int] = {}
        self._request_counts: dict[int, int] = {}  # number of requests since the rate was last sufficient
        self._received: set[int] = set()
        self._use_data_streams = False
        self._rejected_results: set[int] = set()

    def on_message(self, message_id: int) -> None:
        if message_id in self.wanted_hz:
            self._counts[message_id] = self._counts.get(message_id, 0) + 1
            self._received.add(message_id)

    def on_command_ack(self, result: int) -> None:
        """Result of a COMMAND_ACK for SET_MESSAGE_INTERVAL. The ACK does not name the message."""
        if result == mavlink.MAV_RESULT_UNSUPPORTED:
            self._use_data_streams = True
        elif result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
            self._rejected_results.add(result)

    def requests(self, sysid: int, compid: int, now_ns: int) -> Iterator[Any]:
        """-> MAVLink messages that request the streams which are due."""
        self._measure(now_ns)
        groups: dict[int, float] = {}
        for message_id, rate_hz in self.wanted_hz.items():
            if not self._due(message_id, now_ns):
                continue
            self._requested_ns[message_id] = now_ns
            self._request_counts[message_id] = self._request_counts.get(message_id, 0) + 1
            yield mavlink.MAVLink_command_long_message(
                sysid, compid, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, float(message_id), 1e6 / rate_hz, *(0.0,) * 5
            )
            no_effect = self._request_counts[message_id] > MAX_INTERVAL_REQUESTS and message_id not in self._optional
            if (self._use_data_streams or no_effect) and message_id in DATA_STREAM_GROUPS:
                groups[DATA_STREAM_GROUPS[message_id]] = max(rate_hz, groups.get(DATA_STREAM_GROUPS[message_id], 0.0))
        for group, rate_hz in groups.items():
            yield mavlink.MAVLink_request_data_stream_message(sysid, compid, group, round(rate_hz), 1)

    def problem(self) -> str:
        """-> text naming the streams that are too slow, with rates; empty if there is none."""
        slow = [
            f"{mavlink.mavlink_map[i].msgname} {self.rates_hz[i]:.1f} of {wanted:g} Hz"
            for i, wanted in self.wanted_hz.items()
            if i not in self._optional and self._is_slow(i)
        ]
        notes = [f"too slow: {', '.join(slow)}"] if slow else []
        if slow and self._rejected_results:
            notes.append(f"message rates refused (MAV_RESULT {', '.join(map(str, sorted(self._rejected_results)))})")
        return "; ".join(notes)

    def _measure(self, now_ns: int) -> None:
        if self._window_start_ns is None:
            self._window_start_ns = now_ns
        elapsed_ns = now_ns - self._window_start_ns
        if elapsed_ns < WINDOW_NS:
            return
        self.rates_hz = {i: self._counts.get(i, 0) * 1e9 / elapsed_ns for i in self.wanted_hz}
        self._counts.clear()
        self._window_start_ns = now_ns
        self._rate_resolution_hz = 1e9 / elapsed_ns
        for message_id in self.rates_hz:
            if not self._is_slow(message_id):
                self._request_counts[message_id] = 0

    def _due(self, message_id: int, now_ns: int) -> bool:
        """True if the stream is to be requested now. The first request is sent even if the message is received already:
        its rate was then chosen by another system."""
        requested_ns = self._requested_ns.get(message_id)
        if requested_ns is None:
            return True
        request_count = self._request_counts.get(message_id, 0)
        known = message_id in self._received or message_id not in MAX_UNANSWERED_REQUESTS
        if not known and request_count >= MAX_UNANSWERED_REQUESTS[message_id]:
            return False
        wait_ns = WINDOW_NS if known and request_count < MAX_QUICK_REQUESTS else SLOW_REQUEST_PERIOD_NS
        if now_ns - requested_ns < wait_ns or message_id not in self.rates_hz:
            return False
        return self._is_slow(message_id)

    def _is_slow(self, message_id: int) -> bool:
        """True if the rate of the last window is too low. One message is added: at 1 Hz one more message may have
        arrived just before or after the window."""
        rate_hz = self.rates_hz.get(message_id)
        return rate_hz is not None and rate_hz + self._rate_resolution_hz < MIN_RATE_SHARE * self.wanted_hz[message_id]
