"""Outputs on serial devices besides MAVLink: NMEA 0183 and MSP."""

from collections.abc import Callable

from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.link.mavlink.transport import REOPEN_PERIOD_NS, Transport, open_at_start, open_transport
from terrafix.link.output import msp, nmea
from terrafix.messages import GpsInput


class SerialOutput:
    """``send`` for every GpsInput. A lost device is opened again; what cannot be sent is dropped. ``problem``: state of
    the device in words, or empty."""

    def __init__(
        self,
        device: str,
        baud: int,
        encode: Callable[[GpsInput], bytes],
        ardupilot_encode: Callable[[GpsInput], bytes] | None = None,
    ) -> None:
        """``ardupilot_encode``: for an autopilot whose heartbeat says ArduPilot; default: ``encode``. Raises LinkError
        when the device cannot be opened."""
        self._device, self._baud, self._encode = device, baud, encode
        self._ardupilot_encode = ardupilot_encode or encode
        self._transport: Transport | None = open_at_start(device, baud)
        self._next_open_ns = 0
        self.problem = ""

    def send(self, gps: GpsInput, now_ns: int, firmware: str = "") -> None:
        """``firmware``: of the autopilot that the link serves ("ardupilot", ...)."""
        if self._transport is None and now_ns >= self._next_open_ns:
            self._reopen(now_ns)
        if self._transport is None:
            return
        try:
            self._transport.read()  # no input is expected; reading detects a closed port and empties the buffer
            self._transport.write((self._ardupilot_encode if firmware == "ardupilot" else self._encode)(gps))
        except OSError as error:
            self.problem = f"{self._device}: connection lost ({error.strerror or error})"
            self.close()

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _reopen(self, now_ns: int) -> None:
        self._next_open_ns = now_ns + REOPEN_PERIOD_NS
        try:
            self._transport = open_transport(self._device, self._baud, wait=False)
            self.problem = ""
        except (OSError, LinkError) as error:
            self.problem = f"{self._device}: cannot be opened again ({error})"


def open_serial_outputs(config: LinkSection) -> list[SerialOutput]:
    """Opens the devices of the configuration. Raises LinkError when one cannot be opened."""
    outputs = (
        (config.nmea_device, config.nmea_baud, nmea.sentences, nmea.sentences),
        (config.msp_device, config.msp_baud, msp.inav_frame, msp.frame),
    )
    return [SerialOutput(device, baud, *encoders) for device, baud, *encoders in outputs if device]
