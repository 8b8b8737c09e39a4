"""Required values of the autopilot's parameters, with reasons. The facts: docs/autopilot.md."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from terrafix.core.config import LinkSection
from terrafix.link.output.selection import PositionOutputs
from terrafix_tools.preflight.lines import CheckStatus

MAV_GPS = 14
GPS, BARO, COMPASS, EXTERNAL_NAV = 3, 1, 1, 6  # EK3_SRCn_*
POSITION_ACCURACY, GPS_ARMING, NO_DCM = 8, 8, 1  # bits of EK3_GPS_CHECK, ARMING_CHECK and _SKIPCHK, AHRS_OPTIONS
FUSE_ALL_VELOCITIES = 1  # bit of EK3_SRC_OPTIONS
ALL_BUT_GPS = 1048566  # ARMING_CHECK
SKIPS_CHECKS = (4, 7)  # from this firmware on ARMING_SKIPCHK has the checks to skip, instead of those to run
DELAY_MS = (1.0, 50.0)


@dataclass(frozen=True)
class Context:
    """Inputs of the rules other than the parameters."""

    link: LinkSection
    plane: bool
    sysid: int
    delay_ms: int  # recommended value of GPSn_DELAY_MS
    firmware: tuple[int, int] = (4, 6)  # major, minor

    @property
    def gps(self) -> int:
        """Our index among the GPS parameters."""
        return self.link.gps_id + 1

    @property
    def other(self) -> int:
        return 2 if self.gps == 1 else 1

    @property
    def outputs(self) -> tuple[str, ...]:
        return PositionOutputs(self.link.outputs, 0).names("ardupilot")


Values = dict[str, float]


@dataclass(frozen=True)
class Rule:
    """``name`` contains {n} for our GPS and {m} for the other one. ``fix``: a valid value; None: the operator has to
    decide.
    """

    name: str
    valid: Callable[[float], bool]
    fix: Callable[[float, Context], float | None]
    status: CheckStatus
    reason: str
    applies: Callable[[Context, Values], bool] = lambda _c, _v: True


ARMS_ON_ALL = "arming requires a 3D fix of every GPS, and Terrafix has none, or a coarse one, on the ground"


def _one_of(*allowed: float) -> Callable[[float], bool]:
    return lambda value: value in allowed


def _constant(value: float) -> Callable[[float, Context], float | None]:
    return lambda _value, _context: value


def _plane(context: Context, _values: Values) -> bool:
    return context.plane


def _copter(context: Context, _values: Values) -> bool:
    return not context.plane


def _has_receiver(context: Context, values: Values) -> bool:
    """There is also a real receiver."""
    return values.get(f"GPS{context.other}_TYPE", 0.0) > 0


def _fuses_other_velocities(_context: Context, values: Values) -> bool:
    """Another source set has a velocity that is not that of GPS."""
    return any(values.get(f"EK3_SRC{k}_VELXY", 0.0) not in (0.0, GPS) for k in (2, 3))


def _antenna(axis: str) -> "Rule":
    return Rule(
        f"GPS{{n}}_POS_{axis}",
        _one_of(0),
        _constant(0),
        CheckStatus.WARN,
        "the position that is sent is that of the vehicle, and the EKF subtracts this offset of an antenna",
    )


def _primary(receiver: int) -> "Rule":
    return Rule(
        "GPS_PRIMARY",
        _one_of(receiver),
        _constant(receiver),
        CheckStatus.WARN,
        f"the receiver, {receiver}, is the primary one; Terrafix is, after a flight that ended on its position",
        lambda c, v: _has_receiver(c, v) and c.other - 1 == receiver,
    )


SOURCE_OPTIONS = Rule(
    "EK3_SRC_OPTIONS",
    lambda v: not int(v) & FUSE_ALL_VELOCITIES,
    lambda v, _c: float(int(v) & ~FUSE_ALL_VELOCITIES),
    CheckStatus.WARN,
    "with bit 0 the velocities of all source sets are fused, that of a spoofed receiver, too",
)
GPS_INPUT_RULES = (
    Rule("GPS{n}_TYPE", _one_of(MAV_GPS), _constant(MAV_GPS), CheckStatus.FAIL, "only type 14 accepts GPS_INPUT"),
    Rule(
        "GPS{m}_TYPE",
        lambda v: v != MAV_GPS,
        lambda _v, c: 0.0 if c.other == 2 else None,
        CheckStatus.FAIL,
        "both GPS are of type 14, and Terrafix sends for one of them; set the type of the receiver, or 0",
        lambda c, v: f"GPS{c.other}_TYPE" in v,
    ),
    Rule(
        "GPS{n}_DELAY_MS",
        lambda v: DELAY_MS[0] <= v <= DELAY_MS[1],
        lambda _v, c: float(c.delay_ms),
        CheckStatus.FAIL,
        "positions are for the moment of sending; 0 means 200 ms old, 4 m at 20 m/s",
    ),
    Rule(
        "GPS_AUTO_SWITCH",
        _one_of(4),
        _constant(4),
        CheckStatus.WARN,
        "4 flies on the receiver while it has a 3D fix, on Terrafix when not; 0 stays with GPS_PRIMARY without a fix, "
        "too, 1 and 2 choose by number or blend",
        _has_receiver,
    ),
    *(_primary(receiver) for receiver in (0, 1)),
    Rule("EK3_SRC1_POSXY", _one_of(GPS), _constant(GPS), CheckStatus.FAIL, "position comes as GPS"),
    Rule(
        "EK3_SRC1_VELXY",
        _one_of(GPS),
        _constant(GPS),
        CheckStatus.FAIL,
        "velocity is sent; without it the filter follows a wrong position within seconds",
    ),
    Rule("EK3_SRC1_VELZ", _one_of(GPS), _constant(GPS), CheckStatus.WARN, "vertical velocity is sent"),
    replace(SOURCE_OPTIONS, applies=_fuses_other_velocities),
    *(_antenna(axis) for axis in "XYZ"),
    Rule(
        "EK3_GPS_CHECK",
        lambda v: not int(v) & POSITION_ACCURACY,
        lambda v, _c: float(int(v) & ~POSITION_ACCURACY),
        CheckStatus.FAIL,
        "with bit 3 an honest accuracy above 5 m never aligns the filter, not even in the air",
    ),
    Rule(
        "EK3_CHECK_SCALE",
        lambda v: 100 <= v <= 200,
        _constant(100),
        CheckStatus.WARN,
        "with tighter limits the filter does not align",
    ),
    Rule(
        "EK3_VELNE_M_NSE",
        lambda v: 0.8 <= v < 1.0,
        _constant(0.9),
        CheckStatus.FAIL,
        "its velocity gate takes this: with 0.3 a copter ended in its failsafe, with 1 or more it does not align",
    ),
    Rule(
        "EK3_VEL_I_GATE", lambda v: v >= 800, _constant(800), CheckStatus.WARN, "the same gate, in hundredths of sigma"
    ),
    Rule(
        "EK3_POS_I_GATE",
        lambda v: 300 <= v <= 1000,
        _constant(500),
        CheckStatus.WARN,
        "hundredths of sigma of our accuracy",
    ),
    Rule(
        "EK3_POSNE_M_NSE",
        lambda v: 0.1 <= v <= 1.0,
        _constant(0.5),
        CheckStatus.WARN,
        "the least accuracy, m, that the EKF takes from us: a larger one makes a good position count less",
    ),
    Rule(
        "EK3_GLITCH_RAD",
        lambda v: 10 <= v <= 100,
        _constant(25),
        CheckStatus.WARN,
        "with 0 a position beyond the gate is clipped instead of rejected, and pulls the EKF; m of its own uncertainty",
    ),
    Rule(
        "GPS_HDOP_GOOD",
        lambda v: v >= 110,
        _constant(140),
        CheckStatus.FAIL,
        "GPS_INPUT has an HDOP of 1.0, which must be below it",
        _copter,
    ),
    Rule(
        "ARMING_CHECK",
        lambda v: v != 1 and not int(v) & GPS_ARMING,
        _constant(ALL_BUT_GPS),
        CheckStatus.WARN,
        ARMS_ON_ALL,
        lambda c, v: _has_receiver(c, v) and c.firmware < SKIPS_CHECKS,
    ),
    Rule(
        "ARMING_SKIPCHK",
        lambda v: bool(int(v) & GPS_ARMING),
        lambda v, _c: float(int(v) | GPS_ARMING),
        CheckStatus.WARN,
        ARMS_ON_ALL,
        lambda c, v: _has_receiver(c, v) and c.firmware >= SKIPS_CHECKS,
    ),
)
LOCAL_RULES = (
    Rule(
        "VISO_TYPE",
        _one_of(1),
        _constant(1),
        CheckStatus.FAIL,
        "1 (MAVLink) takes ODOMETRY and VISION_POSITION_ESTIMATE",
    ),
    Rule(
        "VISO_DELAY_MS",
        lambda v: v <= 50,
        lambda _v, c: float(c.delay_ms),
        CheckStatus.WARN,
        "positions are for the moment of sending",
    ),
    SOURCE_OPTIONS,
)
ALWAYS = (
    Rule("EK3_ENABLE", _one_of(1), _constant(1), CheckStatus.FAIL, "the rules apply to EKF3"),
    Rule("AHRS_EKF_TYPE", _one_of(3), _constant(3), CheckStatus.FAIL, "the rules apply to EKF3"),
    Rule(
        "EK3_SRC1_POSZ",
        _one_of(BARO),
        _constant(BARO),
        CheckStatus.WARN,
        "our height is no better than the barometer's",
    ),
    Rule(
        "EK3_SRC1_YAW",
        lambda v: v not in (2, 3, EXTERNAL_NAV),
        _constant(COMPASS),
        CheckStatus.FAIL,
        "we send no yaw of our own",
    ),
    Rule(
        "AHRS_OPTIONS",
        lambda v: bool(int(v) & NO_DCM),
        lambda v, _c: float(int(v) | NO_DCM),
        CheckStatus.WARN,
        "without bit 0 a plane falls back to DCM, which flies on a raw jump after 4 s",
        _plane,
    ),
    Rule(
        "ARSPD_USE",
        lambda v: v > 0,
        lambda _v, _c: None,
        CheckStatus.WARN,
        "without airspeed a plane is 170 m off after 2 minutes without position, with it 11 m",
        _plane,
    ),
    Rule(
        "FS_EKF_THRESH",
        lambda v: v > 0,
        _constant(0.8),
        CheckStatus.WARN,
        "0 switches the failsafe for a lost position off",
        _copter,
    ),
    Rule(
        "FS_EKF_ACTION",
        lambda v: v > 0,
        _constant(1),
        CheckStatus.WARN,
        "0 only reports a lost position, and the copter drifts on in its mode",
        _copter,
    ),
)
