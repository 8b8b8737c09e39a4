"""Names of the vertical datums and units; separate from their conversion, so that --help is fast."""

from enum import StrEnum


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
