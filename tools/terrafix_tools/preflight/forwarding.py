"""Check whether the autopilot forwards GPS_INPUT to its other links, and how to disable that.

ArduPilot forwards messages without target to every link on which a system was seen (MAVLink_routing.cpp), unless the
receiving port is private: bit 10 of SERIALn_OPTIONS (AP_SerialManager.cpp, up to 4.6), since 4.7 bit 1 of MAVn_OPTIONS
(GCS_MAVLink_Parameters.cpp), where n counts the ports that speak MAVLink from 1.
"""

from terrafix_tools.preflight.lines import Line, ok, warn
from terrafix_tools.preflight.rules import Context, Values

SERIALS = range(10)
MAVLINK_PROTOCOLS = (1.0, 2.0)
USB = 0  # SERIAL0: not connected in flight
CHANNEL_OPTIONS_SINCE = (4, 7)
NO_FORWARD, NO_FORWARD_4_6 = 2, 1024
WIRE_BYTES = 80  # GPS_INPUT, signed 93


def parameter_names(context: Context) -> list[str]:
    """Parameters that ``forwarding`` needs; a firmware does not reply for those that it does not have."""
    if context.firmware >= CHANNEL_OPTIONS_SINCE:
        return [f"MAV{n}_OPTIONS" for n in range(1, 7)]
    return [f"SERIAL{i}_OPTIONS" for i in SERIALS]


def mavlink_ports(values: Values) -> list[int]:
    """Returns the numbers of the serial ports that speak MAVLink."""
    return [i for i in SERIALS if values.get(f"SERIAL{i}_PROTOCOL") in MAVLINK_PROTOCOLS]


def forwarding(values: Values, context: Context) -> Line:
    ports = mavlink_ports(values)
    private = [i for i in ports if _is_private(i, ports, values)]
    if private:
        port_names = ", ".join(f"SERIAL{i}" for i in private)
        if context.link.ground_devices:
            return ok(
                "forwarding", f"{port_names} does not forward: if it is ours, GPS_INPUT stays off the other links"
            )
        return warn(
            "forwarding",
            f"{port_names} does not forward: if it is ours, our texts and the operator's hints are not forwarded",
            "name a link to the ground in link.ground_devices",
        )
    in_flight = [f"SERIAL{i}" for i in ports if i != USB]
    if len(in_flight) < 2:
        return ok("forwarding", "there is no second MAVLink port that GPS_INPUT could be forwarded to")
    bytes_a_second = round(WIRE_BYTES * context.link.rate_hz)
    option = f"bit 1 ({NO_FORWARD}) of MAVn_OPTIONS, n counts MAVLink ports from 1"
    if context.firmware < CHANNEL_OPTIONS_SINCE:
        option = f"bit 10 ({NO_FORWARD_4_6}) of SERIALn_OPTIONS"
    return warn(
        "forwarding",
        f"GPS_INPUT, {bytes_a_second} bytes a second, is forwarded to the telemetry too ({', '.join(in_flight)})",
        f"set {option}, of our port, and restart it; texts and hints stop too, so name link.ground_devices then",
    )


def _is_private(port: int, ports: list[int], values: Values) -> bool:
    channel = ports.index(port) + 1
    by_channel = int(values.get(f"MAV{channel}_OPTIONS", 0.0)) & NO_FORWARD
    return bool(by_channel or int(values.get(f"SERIAL{port}_OPTIONS", 0.0)) & NO_FORWARD_4_6)
