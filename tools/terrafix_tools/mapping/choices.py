"""Values of options of `terrafix map build`."""

from enum import StrEnum


class Descriptors(StrEnum):
    """Kind of descriptors that a package holds for the search of the whole map."""

    WEIGHTS_FREE = "weights-free"  # pooled gradients
    NONE = "none"


class Datum(StrEnum):
    """Reference surface of heights."""

    EGM96 = "egm96"  # mean sea level of receivers, autopilots and SRTM
    EGM2008 = "egm2008"  # Copernicus GLO-30
    ELLIPSOID = "ellipsoid"  # WGS84; often from photogrammetry with RTK


class Unit(StrEnum):
    """Unit of heights."""

    METRE = "m"
    FOOT = "ft"
    US_FOOT = "us-ft"
