"""Names of the descriptors that a package may keep; apart from what computes them, so that --help is fast."""

from enum import StrEnum


class Descriptors(StrEnum):
    WEIGHTS_FREE = "weights-free"  # pooled gradients
    NONE = "none"
