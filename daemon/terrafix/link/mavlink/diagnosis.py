"""Diagnosis of a connection without an autopilot: a text with cause and remedy, from the received traffic."""

from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

FIRMWARE_NAMES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot", mavlink.MAV_AUTOPILOT_PX4: "px4"}
MIN_TRAFFIC_BYTES = 64  # fewer bytes may be noise of an open cable [tuned]
SERIAL_PROTOCOL_ADVICE = "its SERIALn_PROTOCOL must be 2 (MAVLink 2)"


@dataclass
class ReceivedTraffic:
    """Counts of the traffic on one connection."""

    bytes: int = 0
    packets: int = 0
    refused: int = 0  # packets unsigned or wrongly signed, while signing is on
    heartbeats: dict[tuple[int, int], int] = field(default_factory=dict)  # (system, component) -> MAV_AUTOPILOT

    def add(self, message: Any) -> None:
        if message.get_type() == "HEARTBEAT":
            self.heartbeats[message.get_srcSystem(), message.get_srcComponent()] = message.autopilot

    def autopilots(self) -> dict[int, str]:
        """-> system id -> firmware name, of all autopilots that sent a heartbeat."""
        return {
            sysid: FIRMWARE_NAMES.get(kind, f"autopilot {kind}")
            for (sysid, compid), kind in sorted(self.heartbeats.items())
            if kind != mavlink.MAV_AUTOPILOT_INVALID and compid == mavlink.MAV_COMP_ID_AUTOPILOT1
        }


def autopilot_on_ground_link(autopilots: dict[str, list[int]]) -> str:
    """-> text if an autopilot was received on a ground link; empty otherwise.

    ``autopilots``: device of the ground link -> system ids of the autopilots received there."""
    for device, sysids in autopilots.items():
        return (
            f"the autopilot (system {sysids[0]}) is heard on {device}, which is in link.ground_devices; "
            "the one that leads to it belongs into link.device"
        )
    return ""


def no_autopilot_reason(traffic: ReceivedTraffic, device: str, baud: int, wanted_sysid: int) -> str:
    """-> text with the cause and a remedy; empty when the autopilot (``wanted_sysid``, or any for 0) was received."""
    serial = device.startswith("/")
    autopilots = traffic.autopilots()
    if autopilots and (not wanted_sysid or wanted_sysid in autopilots):
        return ""
    if autopilots:
        there = ", ".join(map(str, autopilots))
        return (
            f"the autopilot on {device} has system id {there}, not {wanted_sysid}; "
            "correct link.autopilot_sysid, or the autopilot's SYSID_THISMAV"
        )
    if traffic.refused:
        return (
            f"{traffic.refused} packets on {device} are not signed with link.signing_key; "
            "give the autopilot the same key, or empty link.signing_key"
        )
    if traffic.heartbeats:
        others = ", ".join(f"system {s} component {c}" for s, c in sorted(traffic.heartbeats))
        return f"no autopilot on {device}, only {others}; is this the autopilot's link, and is it forwarded?"
    if traffic.bytes >= MIN_TRAFFIC_BYTES and not traffic.packets:
        what = f"link.baud is {baud}: is that the speed of SERIALn_BAUD? And " if serial else ""
        return f"bytes but no MAVLink on {device}; {what}{SERIAL_PROTOCOL_ADVICE}"
    if traffic.packets:
        return f"MAVLink but no heartbeat on {device}; is the autopilot still starting?"
    if serial:
        advice = f"are RX and TX crossed, is it powered, is it this port? And {SERIAL_PROTOCOL_ADVICE}"
        return f"nothing heard on {device}; {advice}"
    return f"nothing heard on {device}; is this the address and port that the autopilot or router sends to?"
