"""Whether one sender or two speak with one system and component id, by the sequence numbers of its packets.

A sender counts its packets on a link from 0 to 255 and over again (MAVLink serialization guide). Packets get lost and
come late; but two series of numbers that both go on are two senders. What goes on with the series that was there first
is taken, the rest is not."""

from dataclasses import dataclass

NS_PER_S = 1_000_000_000
LOST = 16  # in a row: where one in five is lost at random, so many are once in 10^11 packets
LATE = 32  # so far behind the newest a packet may be late, or doubled on its way
LOST_BESIDE_ANOTHER = 4  # while there are two senders; numbers of the other one pass by a few at a time
PROOF = 5  # packets of another series; also what a gap that is longer than LOST costs
STALE_NS = NS_PER_S  # after such a pause the next packet begins a series
TWO_NS = 10 * NS_PER_S  # after the last proof of a second sender there may still be one


@dataclass
class _Series:
    newest: int
    heard_ns: int
    length: int = 1
    beside: int = 0  # packets of the first series since this one began

    def goes_on(self, number: int, now_ns: int, lost: int) -> bool:
        return now_ns - self.heard_ns <= STALE_NS and 1 <= (number - self.newest) % 256 <= lost + 1

    def take(self, number: int, now_ns: int) -> None:
        self.newest, self.heard_ns, self.length = number, now_ns, self.length + 1


class Sequence:
    """``refuses`` each packet of one system and component, in order of arrival."""

    def __init__(self) -> None:
        self._first: _Series | None = None
        self._other: _Series | None = None
        self._two_ns: int | None = None  # newest proof of a second sender

    def refuses(self, number: int, now_ns: int) -> str:
        """``number``: 0 to 255. -> why the packet is not taken; empty: it is."""
        first, two = self._first, self._two_ns is not None and now_ns - self._two_ns < TWO_NS
        if first is None or now_ns - first.heard_ns > STALE_NS:
            self._first, self._other = _Series(number, now_ns), None
            return ""
        if first.goes_on(number, now_ns, LOST_BESIDE_ANOTHER if two else LOST):
            first.take(number, now_ns)
            if self._other is not None:
                self._other.beside += 1
            return ""
        if not two and (first.newest - number) % 256 <= LATE:
            return ""
        return self._take_other(first, number, now_ns)

    def _take_other(self, first: _Series, number: int, now_ns: int) -> str:
        other = self._other
        if other is not None and other.goes_on(number, now_ns, LOST):
            other.take(number, now_ns)
        else:
            other = self._other = _Series(number, now_ns)
        if (
            other.length >= PROOF and other.beside == 0
        ):  # the first one has ended: packets were lost, or it has rebooted
            self._first, self._other = other, None
            return ""
        if other.length >= PROOF and other.beside >= PROOF:
            self._two_ns = now_ns
        return f"number {number} after {first.newest}"
