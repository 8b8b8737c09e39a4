"""The telemetry.tlog that a ground station keeps of a simulated flight: what the autopilot said, packet by packet."""

from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import OutputError
from terrafix.core.mavlink.tlog import record
from terrafix_tools.sim.autopilot.autopilot import SimAutopilot
from terrafix_tools.sim.interfaces import Readings

RATES_HZ = {  # as a companion asks for them
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 50.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 10.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 4.0,
    mavlink.MAVLINK_MSG_ID_AIRSPEED: 5.0,
}
T0_US = 1_717_236_000_000_000  # 2024-06-01 10:00 UTC: of t_s 0, UNIX microseconds
COMPANION = 190  # MAV_COMP_ID_MISSIONPLANNER


class TelemetryLog:
    """``step`` with every reading, then ``write``. Records are stamped with our own time, at the moment of measurement;
    what is inside them has the autopilot's."""

    def __init__(self, autopilot: SimAutopilot, t0_us: int) -> None:
        """``t0_us``: UNIX time of the flight's zero, in microseconds."""
        self._autopilot, self._t0_us = autopilot, t0_us
        self._records: list[bytes] = []
        sender = mavlink.MAVLink(None, srcSystem=255, srcComponent=COMPANION)
        for message_id, rate_hz in RATES_HZ.items():
            wish = mavlink.MAVLink_command_long_message(
                1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, 1e6 / rate_hz, 0, 0, 0, 0, 0
            )
            autopilot.receive(bytes(wish.pack(sender)), 0.0)

    def step(self, readings: Readings) -> None:
        self._autopilot.step(readings.t_s, readings)
        packets = self._autopilot.transmit()
        if packets:
            self._records.append(record(self._t0_us + round(readings.t_s * 1e6), packets))

    def write(self, path: Path) -> None:
        """Raises OutputError."""
        try:
            path.write_bytes(b"".join(self._records))
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
