"""Parameters of the simulated autopilot: those that decide about GPS, with ArduPilot's defaults, names and meanings."""

from enum import StrEnum

from terrafix.core.errors import UsageError
from terrafix_tools.preflight.simulated import FIRMWARE


class Kind(StrEnum):
    """The simulated firmware."""

    PLANE = "plane"
    COPTER = "copter"


class Gps(StrEnum):
    """GPS configuration of the autopilot."""

    SECOND = "second"  # a real receiver is GPS1, Terrafix is GPS2 (config/vehicles/second-gps.param)
    ALONE = "alone"  # Terrafix is the only GPS (plane.param, copter.param)


PLANE_DEFAULTS = {"EK3_CHECK_SCALE": 150.0}  # defaults that differ in a plane

# config/vehicles, as recommended in docs/link.md; a test compares with the files.
EKF = {
    "EK3_SRC1_POSXY": 3.0,
    "EK3_SRC1_VELXY": 3.0,
    "EK3_SRC1_POSZ": 1.0,
    "EK3_SRC1_VELZ": 3.0,
    "EK3_GPS_CHECK": 23.0,
    "EK3_CHECK_SCALE": 100.0,
}
GPS_INPUT_ALONE = {"GPS1_TYPE": 14.0, "GPS1_DELAY_MS": 5.0} | EKF
BESIDE_A_RECEIVER = EKF | {
    "GPS2_TYPE": 14.0,
    "GPS2_DELAY_MS": 5.0,
    "GPS_AUTO_SWITCH": 4.0,
    "GPS_PRIMARY": 0.0,
    "ARMING_CHECK": 1048566.0,
}
NO_DCM = {"AHRS_OPTIONS": 1.0}  # plane.param


def parameters_of(kind: Kind, changes: dict[str, float] | None = None) -> dict[str, float]:
    """Returns the firmware's defaults with ``changes``. Raises UsageError for a name that is not simulated."""
    defaults = FIRMWARE | (PLANE_DEFAULTS if kind is Kind.PLANE else {})
    unknown = set(changes or {}) - set(defaults)
    if unknown:
        raise UsageError(f"parameter {', '.join(sorted(unknown))}: not simulated; known: {', '.join(defaults)}")
    return defaults | (changes or {})
