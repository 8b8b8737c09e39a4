"""Names of the available descriptors; separate from their implementation, so that --help is fast."""

from enum import StrEnum


class Descriptors(StrEnum):
    WEIGHTS_FREE = "weights-free"  # pooled gradients
    NONE = "none"
