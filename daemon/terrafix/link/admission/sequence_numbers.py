"""Detects a second sender with the same system and component id, by the sequence numbers of the packets.

A sender counts its packets on a link modulo 256 (MAVLink serialization guide). Packets may be lost or late. Two series
of numbers that both continue belong to two senders. Packets that continue the first series are accepted, all others are
rejected."""

from dataclasses import dataclass

from terrafix.core.clock import NS_PER_S

# Consecutive lost packets within a series. At a random loss of one in five: once in 10^11 packets. [tuned]
MAX_LOST = 16
MAX_LATE = 32  # a packet this many numbers behind the newest counts as late or duplicated [tuned]
# As MAX_LOST while there are two senders: numbers of the second one cross those of the first a few at a time. [tuned]
MAX_LOST_TWO_SENDERS = 4
# Packets that establish another series; a gap longer than MAX_LOST therefore costs as many. [tuned]
MIN_SERIES_PACKETS = 5
SERIES_TIMEOUT_NS = NS_PER_S  # after such a pause the next packet starts a new series [tuned]
SECOND_SENDER_TIMEOUT_NS = 10 * NS_PER_S  # a second sender is assumed for so long after its last detection [tuned]


@dataclass
class _Series:
    """Packets whose sequence numbers continue each other."""

    newest: int
    received_ns: int
    length: int = 1
    interleaved: int = 0  # packets of the primary series since this one began

    def continues_with(self, number: int, now_ns: int, max_lost: int) -> bool:
        return now_ns - self.received_ns <= SERIES_TIMEOUT_NS and 1 <= (number - self.newest) % 256 <= max_lost + 1

    def append(self, number: int, now_ns: int) -> None:
        self.newest, self.received_ns, self.length = number, now_ns, self.length + 1


class SequenceCheck:
    """Checks each packet of one system and component, in order of arrival."""

    def __init__(self) -> None:
        self._primary: _Series | None = None
        self._secondary: _Series | None = None
        self._second_sender_ns: int | None = None  # newest detection of a second sender

    def rejection_reason(self, number: int, now_ns: int) -> str:
        """``number``: 0 to 255. -> reason for the rejection; empty if the packet is accepted."""
        primary, detected_ns = self._primary, self._second_sender_ns
        two_senders = detected_ns is not None and now_ns - detected_ns < SECOND_SENDER_TIMEOUT_NS
        if primary is None or now_ns - primary.received_ns > SERIES_TIMEOUT_NS:
            self._primary, self._secondary = _Series(number, now_ns), None
            return ""
        if primary.continues_with(number, now_ns, MAX_LOST_TWO_SENDERS if two_senders else MAX_LOST):
            primary.append(number, now_ns)
            if self._secondary is not None:
                self._secondary.interleaved += 1
            return ""
        if not two_senders and (primary.newest - number) % 256 <= MAX_LATE:
            return ""
        return self._check_secondary(primary, number, now_ns)

    def _check_secondary(self, primary: _Series, number: int, now_ns: int) -> str:
        """As ``rejection_reason``, for a packet that does not continue the primary series."""
        secondary = self._secondary
        if secondary is not None and secondary.continues_with(number, now_ns, MAX_LOST):
            secondary.append(number, now_ns)
        else:
            secondary = self._secondary = _Series(number, now_ns)
        if secondary.length >= MIN_SERIES_PACKETS and secondary.interleaved == 0:
            # The primary series has ended: packets were lost, or the autopilot has rebooted.
            self._primary, self._secondary = secondary, None
            return ""
        if secondary.length >= MIN_SERIES_PACKETS and secondary.interleaved >= MIN_SERIES_PACKETS:
            self._second_sender_ns = now_ns
        return f"number {number} after {primary.newest}"
