"""The bandwidth of a serial line, and message rates that fit into it. UDP and TCP have no limit here.

A byte is ten bits on the line (8N1). Only a share of the inbound bandwidth is planned, because the autopilot also sends
streams that others requested, and replies. docs/link.md lists the resulting rates."""

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.mavlink.framing import SIGNATURE_BYTES

BITS_PER_BYTE = 10  # 8N1: start bit, eight data bits, stop bit [spec: UART]
FRAME_BYTES = 12  # header (10) and checksum (2) of a packet [spec: MAVLink 2 serialization guide]
# Share of the bandwidth for planned messages; inbound the autopilot also sends what others requested. [tuned]
USABLE_SHARE_IN, USABLE_SHARE_OUT = 0.7, 0.9
SATURATED_SHARE = 0.95  # share of the bandwidth above which one second of traffic counts as full [tuned]
RATE_STEPS = 40  # number of equal steps in which all rates are lowered together [tuned]
# Hz. A slower stream is of no use to the estimator. Messages that are not listed may go down to 1 Hz. [tuned]
MIN_RATE_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 10.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 2.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: 2.0,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 10.0,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 10.0,
}
# Messages per second that are sent besides the position. TIMESYNC: our requests, and replies to the autopilot's.
# NAMED_VALUE_FLOAT: four values at 1 Hz. STATUSTEXT: one in five seconds. [spec: edge.py and named_values.py]
OTHER_OUTPUT_HZ = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 2.0,
    mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT: 4.0,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT: 0.2,
}
POSITION_MESSAGE_IDS = {  # by name of the output: the message that is sent at the position rate
    "gps_input": mavlink.MAVLINK_MSG_ID_GPS_INPUT,
    "odometry": mavlink.MAVLINK_MSG_ID_ODOMETRY,
    "vision_position": mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
    "global_position": mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_SENSOR,
}


class LinkBandwidth:
    """The load of one link. ``baud``: bits/s of a serial line; None: UDP or TCP, without a limit."""

    def __init__(self, baud: int | None, *, signed: bool) -> None:
        self._capacity_bytes_per_s = None if baud is None else baud / BITS_PER_BYTE  # in each direction
        self._baud, self._signed = baud, signed
        self._previous: tuple[int, int, int] | None = None  # (time ns, bytes in, bytes out)
        self._saturation = ""

    def bytes_per_second(self, rates_hz: dict[int, float]) -> float:
        """-> bytes/s of these messages (id -> Hz) at their maximum length; MAVLink 2 truncates trailing zero bytes."""
        extra = FRAME_BYTES + (SIGNATURE_BYTES if self._signed else 0)
        return sum(rate * (mavlink.mavlink_map[i].unpacker.size + extra) for i, rate in rates_hz.items())

    def limit_rates(self, wanted_hz: dict[int, float]) -> dict[int, float]:
        """-> the rates to request [Hz]: ``wanted_hz`` if they fit, else lowered together, none below its minimum."""
        if self._capacity_bytes_per_s is None:
            return dict(wanted_hz)
        rates = dict(wanted_hz)
        for step in range(1, RATE_STEPS):
            if self.bytes_per_second(rates) <= USABLE_SHARE_IN * self._capacity_bytes_per_s:
                break
            share = 1.0 - step / RATE_STEPS
            rates = {i: max(min(rate, MIN_RATE_HZ.get(i, 1.0)), rate * share) for i, rate in wanted_hz.items()}
        return rates

    def capacity_problem(self, rates_hz: dict[int, float], outputs: tuple[str, ...], position_hz: float) -> str:
        """-> text with the directions whose need exceeds the bandwidth [baud]; empty when everything fits.

        ``rates_hz``: message id -> requested rate; ``position_hz``: rate of the ``outputs``."""
        if self._capacity_bytes_per_s is None:
            return ""
        out_hz = OTHER_OUTPUT_HZ | {
            POSITION_MESSAGE_IDS[name]: position_hz for name in outputs if name in POSITION_MESSAGE_IDS
        }
        needs = {
            "in": self.bytes_per_second(rates_hz) / USABLE_SHARE_IN,
            "out": self.bytes_per_second(out_hz) / USABLE_SHARE_OUT,
        }
        over = [
            f"{what} needs {round(need * BITS_PER_BYTE)}"
            for what, need in needs.items()
            if need > self._capacity_bytes_per_s
        ]
        return f"{self._baud} baud is too slow ({', '.join(over)})" if over else ""

    def load_problem(self, now_ns: int, bytes_in: int, bytes_out: int) -> str:
        """-> text if the line was saturated since the last call; empty otherwise. Call it once a second.

        ``bytes_in``, ``bytes_out``: total byte counts so far."""
        if self._capacity_bytes_per_s is None:
            return ""
        if self._previous is not None and now_ns > self._previous[0]:
            seconds = (now_ns - self._previous[0]) * 1e-9
            shares = ((bytes_in - self._previous[1]) / seconds, (bytes_out - self._previous[2]) / seconds)
            full = [
                f"{what} {rate / self._capacity_bytes_per_s:.0%}"
                for what, rate in zip(("in", "out"), shares, strict=True)
                if rate > SATURATED_SHARE * self._capacity_bytes_per_s
            ]
            self._saturation = f"the line is full ({', '.join(full)} of {self._baud} baud)" if full else ""
        self._previous = (now_ns, bytes_in, bytes_out)
        return self._saturation
