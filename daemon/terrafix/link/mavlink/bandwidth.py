"""What a serial line can carry, and message rates that fit into it. UDP and TCP have no limit here.

A byte is ten bits on the line (8N1). Not all of the line towards us is planned, since the autopilot also sends what
others have asked for, and its answers."""

from pymavlink.dialects.v20 import ardupilotmega as mavlink

BITS_PER_BYTE = 10
FRAME_BYTES = 12  # MAVLink 2 header and checksum
SIGNATURE_BYTES = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN
SHARE_IN, SHARE_OUT = 0.7, 0.9  # of the line, for what is planned
FULL = 0.95  # share of the line from which a second of it counts as full
STEPS = 40  # in which rates are lowered together
LEAST_HZ = {  # below this a stream is of no use; what is not named may go down to 1 Hz
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 10.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 2.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: 2.0,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 10.0,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 10.0,
}
# What goes out besides the position, messages a second: heartbeat, TIMESYNC (ours, and answers), named values
BESIDES_HZ = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 2.0,
    mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT: 4.0,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT: 0.2,
}
POSITION = {  # of the outputs, the message that is sent at the rate of the position
    "gps_input": mavlink.MAVLINK_MSG_ID_GPS_INPUT,
    "odometry": mavlink.MAVLINK_MSG_ID_ODOMETRY,
    "vision_position": mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
    "global_position": mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_SENSOR,
}


class LinkBandwidth:
    """One line. ``baud`` None: no serial line."""

    def __init__(self, baud: int | None, *, signed: bool) -> None:
        self._capacity = None if baud is None else baud / BITS_PER_BYTE  # bytes a second, each way
        self._baud, self._signed = baud, signed
        self._seen: tuple[int, int, int] | None = None  # (time ns, bytes in, bytes out)
        self._full = ""

    def bytes_a_second(self, rates_hz: dict[int, float]) -> float:
        """With every message as long as it can be: MAVLink 2 leaves out zeros at the end."""
        extra = FRAME_BYTES + (SIGNATURE_BYTES if self._signed else 0)
        return sum(rate * (mavlink.mavlink_map[i].unpacker.size + extra) for i, rate in rates_hz.items())

    def fitting(self, wanted_hz: dict[int, float]) -> dict[int, float]:
        """The rates to ask for: as wanted where they fit, else lowered together, none below its least."""
        if self._capacity is None:
            return dict(wanted_hz)
        rates = dict(wanted_hz)
        for step in range(1, STEPS):
            if self.bytes_a_second(rates) <= SHARE_IN * self._capacity:
                break
            share = 1.0 - step / STEPS
            rates = {i: max(min(rate, LEAST_HZ.get(i, 1.0)), rate * share) for i, rate in wanted_hz.items()}
        return rates

    def too_slow(self, rates_hz: dict[int, float], outputs: tuple[str, ...], position_hz: float) -> str:
        """What cannot fit even so; empty when all does."""
        if self._capacity is None:
            return ""
        out_hz = BESIDES_HZ | {POSITION[name]: position_hz for name in outputs if name in POSITION}
        needs = {"in": self.bytes_a_second(rates_hz) / SHARE_IN, "out": self.bytes_a_second(out_hz) / SHARE_OUT}
        over = [f"{what} needs {round(need * BITS_PER_BYTE)}" for what, need in needs.items() if need > self._capacity]
        return f"{self._baud} baud is too slow ({', '.join(over)})" if over else ""

    def load(self, now_ns: int, bytes_in: int, bytes_out: int) -> str:
        """With the bytes so far, once a second: whether the line is full; empty when it is not."""
        if self._capacity is None:
            return ""
        if self._seen is not None and now_ns > self._seen[0]:
            seconds = (now_ns - self._seen[0]) * 1e-9
            shares = ((bytes_in - self._seen[1]) / seconds, (bytes_out - self._seen[2]) / seconds)
            full = [
                f"{what} {rate / self._capacity:.0%}"
                for what, rate in zip(("in", "out"), shares, strict=True)
                if rate > FULL * self._capacity
            ]
            self._full = f"the line is full ({', '.join(full)} of {self._baud} baud)" if full else ""
        self._seen = (now_ns, bytes_in, bytes_out)
        return self._full
