"""The position in another language to a device of its own, besides MAVLink: NMEA 0183, MSP."""

from collections.abc import Callable

from terrafix.core.config import LinkSection
from terrafix.core.errors import LinkError
from terrafix.link.mavlink.transport import Transport, open_at_start, open_transport
from terrafix.link.output import msp, nmea
from terrafix.messages import GpsInput

REOPEN_NS = 1_000_000_000


class SideOutput:
    """``send`` at every GpsInput; a device that goes away is opened again, and what cannot be sent is dropped."""

    def __init__(self, device: str, baud: int, encode: Callable[[GpsInput], bytes]) -> None:
        """Raises LinkError: the device cannot be opened."""
        self._device, self._baud, self._encode = device, baud, encode
        self._transport: Transport | None = open_at_start(device, baud)
        self._try_ns = 0
        self.problem = ""

    def send(self, gps: GpsInput, now_ns: int) -> None:
        if self._transport is None and now_ns >= self._try_ns:
            self._reopen(now_ns)
        if self._transport is None:
            return
        try:
            self._transport.read()  # nobody speaks here, but a full buffer or a closed port is noticed
            self._transport.write(self._encode(gps))
        except OSError as error:
            self.problem = f"{self._device}: connection lost ({error.strerror or error})"
            self.close()

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _reopen(self, now_ns: int) -> None:
        self._try_ns = now_ns + REOPEN_NS
        try:
            self._transport = open_transport(self._device, self._baud, wait=False)
            self.problem = ""
        except (OSError, LinkError) as error:
            self.problem = f"{self._device}: cannot be opened again ({error})"


def open_side_outputs(config: LinkSection) -> list[SideOutput]:
    """Those of the configuration. Raises LinkError."""
    wanted = (
        (config.nmea_device, config.nmea_baud, nmea.sentences),
        (config.msp_device, config.msp_baud, msp.frame),
    )
    return [SideOutput(device, baud, encode) for device, baud, encode in wanted if device]
