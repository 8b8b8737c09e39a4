"""A told height or heading that cannot be: a range finder without an echo, a zero that stands for nothing, a compass
that turns over beside a power line.

A graph believes what is told as it believes the rest; one height of 300 m in a flight at 80 m takes all of it along,
and what is seen is then another way. So such a word counts as one that nobody said."""

SIGMAS = 8.0  # of sensor, graph and motion together: gusts, steps of a filter, rising ground and soft iron pass
REPEATED = 10  # refused in a row without a map fix since the first of them: the flight may be what is wrong
TWICE = 2  # ... and where there never was one, and FEW were believed: these may be what nobody could know yet
FEW = 10


class InnovationGate:
    def __init__(self) -> None:
        self._believed = 0  # since the flight began
        self._refused = 0
        self._fixed_s: float | None = None

    def begun(self) -> None:
        """With the word of its first frame."""
        self._believed, self._refused = 1, 0

    @property
    def begins(self) -> bool:
        """What was refused last tells a flight without any map fix anew: those before it may be wrong as well."""
        return self._believed == 1 or (self._refused >= TWICE and self._believed <= FEW)

    def refuses(self, off: float, sigma: float, fixed_s: float | None) -> bool:
        """``off`` from what is expected, to ``sigma``; ``fixed_s``: time of the last map fix."""
        if abs(off) <= SIGMAS * sigma:
            self._believed, self._refused = self._believed + 1, 0
            return False
        if not self._refused or fixed_s != self._fixed_s:
            self._refused, self._fixed_s = 0, fixed_s
        self._refused += 1
        return self._refused <= REPEATED
