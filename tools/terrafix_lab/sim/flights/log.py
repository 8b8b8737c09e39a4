"""telemetry.tlog of a simulated flight: the autopilot's packets as a ground station records them."""

from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import OutputError
from terrafix.core.mavlink.tlog import record
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.interfaces import Readings

RATES_HZ = {  # rates that a companion requests
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 50.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 10.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 4.0,
    mavlink.MAVLINK_MSG_ID_AIRSPEED: 5.0,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: 5.0,
}
T0_US = 1_717_236_000_000_000  # 2024-06-01 10:00 UTC, UNIX microseconds of t_s 0
COMPANION = 190  # MAV_COMP_ID_MISSIONPLANNER


class TelemetryLog:
    """Records an autopilot: ``step`` with every reading, then ``write``. Record times are on our clock at the time of
    measurement; message times are on the autopilot's clock.
    """

    def __init__(self, autopilot: SimAutopilot, t0_us: int) -> None:
        """``t0_us``: UNIX time of the flight's zero, in microseconds."""
        self._autopilot, self._t0_us = autopilot, t0_us
        self._records: list[tuple[int, bytes]] = []
        sender = mavlink.MAVLink(None, srcSystem=255, srcComponent=COMPANION)
        for message_id, rate_hz in RATES_HZ.items():
            request = mavlink.MAVLink_command_long_message(
                1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, 1e6 / rate_hz, 0, 0, 0, 0, 0
            )
            autopilot.receive(bytes(request.pack(sender)), 0.0)

    def step(self, readings: Readings) -> None:
        self._autopilot.step(readings.t_s, readings)
        packets = self._autopilot.transmit()
        if packets:
            self._records.append((self._t0_us + round(readings.t_s * 1e6), packets))

    def write(self, path: Path) -> None:
        """Writes the file. Raises OutputError."""
        try:
            path.write_bytes(b"".join(record(*one) for one in self._records))
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
