"""A told height that cannot be: a range finder without an echo, a barometer's glitch, a zero that stands for nothing.

A graph believes heights as it believes the rest; one of 300 m in a flight at 80 m takes all of it along, and what is
seen is then another way. So such a height counts as one that nobody told."""

SIGMAS = 8.0  # of barometer, graph and motion together: gusts, steps of a filter and rising ground pass
REPEATED = 10  # refused in a row without a map fix since the first of them: the flight may be what is wrong
TWICE = 2  # ... and where there never was one: what came before may be what nobody could know yet


class ToldHeights:
    def __init__(self) -> None:
        self._is_first = False  # only one was believed since the flight began
        self._refused = 0
        self._fixed_s: float | None = None

    def begun(self) -> None:
        """With the height of its first frame."""
        self._is_first, self._refused = True, 0

    @property
    def begins(self) -> bool:
        """What was refused last tells a flight without any map fix anew: the heights before it may be wrong as well."""
        return self._is_first or self._refused >= TWICE

    def refuses(self, off_m: float, sigma_m: float, fixed_s: float | None) -> bool:
        """``off_m`` from where it is expected, to ``sigma_m``; ``fixed_s``: time of the last map fix."""
        if abs(off_m) <= SIGMAS * sigma_m:
            self._is_first, self._refused = False, 0
            return False
        if not self._refused or fixed_s != self._fixed_s:
            self._refused, self._fixed_s = 0, fixed_s
        self._refused += 1
        return self._refused <= REPEATED
