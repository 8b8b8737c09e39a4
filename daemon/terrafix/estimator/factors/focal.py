"""The focal length as a variable of a graph that is solved after landing."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FocalKey:
    """Key of a variable (1,): logarithm of the true focal length over the described one. ``at``: value by which the
    image coordinates of a factor are normalised."""

    key: int
    at: float
