"""What is wrong with a connection, in words: from what was heard on it."""

from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

NAMES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot", mavlink.MAV_AUTOPILOT_PX4: "px4"}
FEW_BYTES = 64  # fewer may be the noise of a cable
SERIAL_PROTOCOL = "its SERIALn_PROTOCOL must be 2 (MAVLink 2)"


@dataclass
class Heard:
    """Fill it with everything that came."""

    bytes: int = 0
    packets: int = 0
    refused: int = 0  # unsigned or wrongly signed, while signing is on
    heartbeats: dict[tuple[int, int], int] = field(default_factory=dict)  # (system, component) -> MAV_AUTOPILOT

    def take(self, message: Any) -> None:
        if message.get_type() == "HEARTBEAT":
            self.heartbeats[message.get_srcSystem(), message.get_srcComponent()] = message.autopilot

    def autopilots(self) -> dict[int, str]:
        """System id -> firmware."""
        return {
            sysid: NAMES.get(kind, f"autopilot {kind}")
            for (sysid, compid), kind in sorted(self.heartbeats.items())
            if kind != mavlink.MAV_AUTOPILOT_INVALID and compid == mavlink.MAV_COMP_ID_AUTOPILOT1
        }


def heard_on_ground(autopilots: dict[str, list[int]]) -> str:
    """``autopilots``: devices of ground links with the system ids that are heard there; empty when there is none."""
    for device, sysids in autopilots.items():
        return (
            f"the autopilot (system {sysids[0]}) is heard on {device}, which is in link.ground_devices; "
            "the one that leads to it belongs into link.device"
        )
    return ""


def why_no_autopilot(heard: Heard, device: str, baud: int, wanted_sysid: int) -> str:
    """Why there is no autopilot to talk to, and what to do; empty when there is one (or the one that is wanted)."""
    serial = device.startswith("/")
    autopilots = heard.autopilots()
    if autopilots and (not wanted_sysid or wanted_sysid in autopilots):
        return ""
    if autopilots:
        there = ", ".join(map(str, autopilots))
        return (
            f"the autopilot on {device} has system id {there}, not {wanted_sysid}; "
            "correct link.autopilot_sysid, or the autopilot's SYSID_THISMAV"
        )
    if heard.refused:
        return (
            f"{heard.refused} packets on {device} are not signed with link.signing_key; "
            "give the autopilot the same key, or empty link.signing_key"
        )
    if heard.heartbeats:
        others = ", ".join(f"system {s} component {c}" for s, c in sorted(heard.heartbeats))
        return f"no autopilot on {device}, only {others}; is this the autopilot's link, and is it forwarded?"
    if heard.bytes >= FEW_BYTES and not heard.packets:
        what = f"link.baud is {baud}: is that the speed of SERIALn_BAUD? And " if serial else ""
        return f"bytes but no MAVLink on {device}; {what}{SERIAL_PROTOCOL}"
    if heard.packets:
        return f"MAVLink but no heartbeat on {device}; is the autopilot still starting?"
    if serial:
        return (
            f"nothing heard on {device}; are RX and TX crossed, is it powered, is it this port? And {SERIAL_PROTOCOL}"
        )
    return f"nothing heard on {device}; is this the address and port that the autopilot or router sends to?"
