"""A simulated ArduPilot on the ground with one wrong parameter, for `terrafix preflight --simulate`."""

import random
import socket
import threading
import time
from types import TracebackType
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import UsageError
from terrafix.core.installed_files import installed_files
from terrafix_tools.preflight.simulated import GROUND_DEFAULTS, GroundAutopilot

POLL_S = 0.002
DATAGRAM_MAX = 4096
# Values with which an autopilot comes, or which a common mistake leaves; each makes preflight complain.
_OF_ALL = {
    "EK3_SRC1_POSXY": 0.0,  # the EKF takes no position
    "EK3_SRC1_VELXY": 0.0,
    "EK3_GPS_CHECK": 31.0,  # demands a heading that GPS_INPUT does not have
    "EK3_VEL_I_GATE": 300.0,
}
_ALONE = _OF_ALL | {"GPS1_TYPE": 1.0}  # looks for a receiver on a serial port
WRONG = {  # by the file of config/vehicles
    "copter": _ALONE,
    "plane": _ALONE | {"AHRS_OPTIONS": 0.0},
    "second-gps": _OF_ALL | {"GPS2_TYPE": 1.0, "GPS_AUTO_SWITCH": 1.0},
}
MISSION = ((mavlink.MAV_CMD_NAV_WAYPOINT, 48.01, 11.0, 100.0),)


class Practice:
    """Context manager: the autopilot listens on ``device`` while it is open. ``vehicle``: a key of WRONG; ``wrong``:
    its wrong parameter; "": one by chance. Raises UsageError."""

    def __init__(self, vehicle: str, wrong: str = "") -> None:
        if vehicle not in WRONG:
            raise UsageError(
                f"--simulate {vehicle}: choose one of {', '.join(WRONG)}; parameters of others are not known"
            )
        preset = (installed_files() / "config" / "vehicles" / f"{vehicle}.param").read_text(encoding="utf-8")
        lines = (line.split(",") for line in preset.splitlines() if line and not line.startswith("#"))
        self._right = GROUND_DEFAULTS | {name: float(value) for name, value in lines}
        self.wrong = wrong or random.choice(sorted(WRONG[vehicle]))
        kind = mavlink.MAV_TYPE_FIXED_WING if vehicle == "plane" else mavlink.MAV_TYPE_QUADROTOR
        self.about = "ArduPlane" if vehicle == "plane" else "ArduCopter"
        self._autopilot = GroundAutopilot(
            self._right | {self.wrong: WRONG[vehicle][self.wrong]}, kind=kind, mission=MISSION
        )
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="practice-autopilot", daemon=True)

    def __enter__(self) -> "Practice":
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(POLL_S)
        self.device = f"udpout:127.0.0.1:{self._socket.getsockname()[1]}"
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    @property
    def values(self) -> dict[str, float]:
        return self._autopilot.values

    @property
    def is_found(self) -> bool:
        """The wrong parameter was set right."""
        return self.values[self.wrong] == self._right[self.wrong]

    def _serve(self) -> None:
        peer: Any = None
        sent_s: dict[int, float] = {}
        while not self._stopping.is_set():
            try:
                packet, peer = self._socket.recvfrom(DATAGRAM_MAX)
                self._autopilot.write(packet)
            except (TimeoutError, ConnectionError, mavlink.MAVError):
                pass
            now_s = time.monotonic()
            for message_id, interval_s in self._autopilot.intervals_s.items():
                if now_s >= sent_s.get(message_id, 0.0) + interval_s:
                    sent_s[message_id] = now_s
                    self._autopilot.send(_empty(message_id))
            for chunk, _ in self._autopilot.read():
                if peer is not None:
                    self._socket.sendto(chunk, peer)


def _empty(message_id: int) -> Any:
    """A message of that type with zeros."""
    kind = mavlink.mavlink_map[message_id]
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    return kind(*([0] * lengths[name] if lengths[name] else 0 for name in kind.fieldnames))
