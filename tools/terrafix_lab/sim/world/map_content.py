"""What the map of a generated place shows."""

from enum import StrEnum


class MapContent(StrEnum):
    IMAGERY = "imagery"
    VECTORS = "vectors"
    BOTH = "both"
