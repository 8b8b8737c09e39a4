"""Names of the surfaces that heights count from; apart from what converts them, so that --help is fast."""

from enum import StrEnum


class Datum(StrEnum):
    """What heights count from."""

    EGM96 = "egm96"  # mean sea level of receivers, autopilots and SRTM
    EGM2008 = "egm2008"  # Copernicus GLO-30
    ELLIPSOID = "ellipsoid"  # WGS84; photogrammetry with RTK often
