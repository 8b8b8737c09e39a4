"""Required values of the autopilot's parameters, with reasons. The facts: docs/autopilot.md."""

from collections.abc import Callable
from dataclasses import dataclass

from terrafix.core.config import LinkSection
from terrafix.link.output.selection import PositionOutputs
from terrafix_tools.preflight.lines import Status

MAV_GPS = 14
GPS, BARO, COMPASS, EXTERNAL_NAV = 3, 1, 1, 6  # EK3_SRCn_*
POSITION_ACCURACY, GPS_ARMING, NO_DCM = 8, 8, 1  # bits of EK3_GPS_CHECK, ARMING_CHECK and _SKIPCHK, AHRS_OPTIONS
ALL_BUT_GPS = 1048566  # ARMING_CHECK
SKIPS_CHECKS = (4, 7)  # from this firmware on ARMING_SKIPCHK has the checks to skip, instead of those to run
FUSE_ALL, SET_PER_CORE = 1, 8  # bits of EK3_SRC_OPTIONS that use other source sets than the active one
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
    status: Status
    reason: str
    applies: Callable[[Context, Values], bool] = lambda _c, _v: True


def _one_of(*allowed: float) -> Callable[[float], bool]:
    return lambda value: value in allowed


def _constant(value: float) -> Callable[[float, Context], float | None]:
    return lambda _value, _context: value


def _plane(context: Context, _values: Values) -> bool:
    return context.plane


def _copter(context: Context, _values: Values) -> bool:
    return not context.plane


def _both_are_ours(context: Context, values: Values) -> bool:
    return values.get(f"GPS{context.other}_TYPE") == MAV_GPS


def _other_sets_have_velocity(_context: Context, values: Values) -> bool:
    """A source set besides the first has another velocity than GPS."""
    return any(values.get(f"EK3_SRC{k}_VELXY", 0.0) not in (0.0, GPS) for k in (2, 3))


def _has_receiver(context: Context, values: Values) -> bool:
    """There is also a real receiver."""
    return values.get(f"GPS{context.other}_TYPE", 0.0) > 0


NO_FIX_ON_THE_GROUND = (
    "arming requires a 3D fix of every GPS, all within 50 m; that of Terrafix is coarse or missing on the ground"
)
ANTENNA = "GPS_INPUT is the position of the vehicle; the filter would subtract this lever arm once more"

GPS_INPUT_RULES = (
    Rule("GPS{n}_TYPE", _one_of(MAV_GPS), _constant(MAV_GPS), Status.FAIL, "only type 14 accepts GPS_INPUT"),
    Rule(
        "GPS{m}_TYPE",
        lambda v: v != MAV_GPS,
        lambda _v, c: 0.0 if c.other == 2 else None,
        Status.FAIL,
        "both are GPS_INPUT and only one is sent: the other never has a fix, and arming waits for it",
        _both_are_ours,
    ),
    *(Rule(f"GPS{{n}}_POS_{axis}", _one_of(0), _constant(0), Status.WARN, ANTENNA) for axis in "XYZ"),
    Rule(
        "GPS{n}_DELAY_MS",
        lambda v: DELAY_MS[0] <= v <= DELAY_MS[1],
        lambda _v, c: float(c.delay_ms),
        Status.FAIL,
        "positions are for the moment of sending; 0 means 200 ms old, 4 m at 20 m/s",
    ),
    Rule(
        "GPS_AUTO_SWITCH",
        _one_of(0, 4),
        _constant(4),
        Status.WARN,
        "4 flies on the receiver while it has a 3D fix, and on Terrafix when not; 1 and 2 choose by number or blend",
        _has_receiver,
    ),
    Rule(
        "GPS_PRIMARY",
        _one_of(0, 1),
        lambda _v, c: float(c.other - 1),
        Status.WARN,
        "the real receiver is the primary one on the ground",
        _has_receiver,
    ),
    Rule("EK3_SRC1_POSXY", _one_of(GPS), _constant(GPS), Status.FAIL, "position comes as GPS"),
    Rule(
        "EK3_SRC1_VELXY",
        _one_of(GPS),
        _constant(GPS),
        Status.FAIL,
        "velocity is sent; without it the filter follows a wrong position within seconds",
    ),
    Rule("EK3_SRC1_VELZ", _one_of(GPS), _constant(GPS), Status.WARN, "vertical velocity is sent"),
    Rule(
        "EK3_SRC_OPTIONS",
        lambda v: not int(v) & (FUSE_ALL | SET_PER_CORE),
        lambda v, _c: float(int(v) & ~(FUSE_ALL | SET_PER_CORE)),
        Status.WARN,
        "bits 0 and 3 fuse the velocity of EK3_SRC2 or EK3_SRC3 as well, which is not GPS",
        _other_sets_have_velocity,
    ),
    Rule(
        "EK3_GPS_CHECK",
        lambda v: not int(v) & POSITION_ACCURACY,
        lambda v, _c: float(int(v) & ~POSITION_ACCURACY),
        Status.FAIL,
        "with bit 3 an honest accuracy above 5 m never aligns the filter, not even in the air",
    ),
    Rule(
        "EK3_CHECK_SCALE",
        lambda v: 100 <= v <= 200,
        _constant(100),
        Status.WARN,
        "with tighter limits the filter does not align",
    ),
    Rule(
        "EK3_VELNE_M_NSE",
        lambda v: 0.8 <= v < 1.0,
        _constant(0.9),
        Status.FAIL,
        "its velocity gate takes this: with 0.3 a copter ended in its failsafe, with 1 or more it does not align",
    ),
    Rule("EK3_VEL_I_GATE", lambda v: v >= 800, _constant(800), Status.WARN, "the same gate, in hundredths of sigma"),
    Rule(
        "EK3_POS_I_GATE", lambda v: 300 <= v <= 1000, _constant(500), Status.WARN, "hundredths of sigma of our accuracy"
    ),
    Rule(
        "EK3_POSNE_M_NSE",
        lambda v: 0.1 <= v <= 1.0,
        _constant(0.5),
        Status.WARN,
        "the least position accuracy that the filter believes: above, our better ones count as this",
    ),
    Rule(
        "EK3_GLITCH_RAD",
        lambda v: 10 <= v <= 100,
        _constant(25),
        Status.WARN,
        "0 clips a wrong position instead of rejecting it, a large one keeps rejecting the right one",
    ),
    Rule(
        "GPS_HDOP_GOOD",
        lambda v: v >= 110,
        _constant(140),
        Status.FAIL,
        "GPS_INPUT has an HDOP of 1.0, which must be below it",
        _copter,
    ),
    Rule(
        "ARMING_CHECK",
        lambda v: v != 1 and not int(v) & GPS_ARMING,
        _constant(ALL_BUT_GPS),
        Status.WARN,
        NO_FIX_ON_THE_GROUND,
        lambda c, v: _has_receiver(c, v) and c.firmware < SKIPS_CHECKS,
    ),
    Rule(
        "ARMING_SKIPCHK",
        lambda v: bool(int(v) & GPS_ARMING),
        lambda v, _c: float(int(v) | GPS_ARMING),
        Status.WARN,
        NO_FIX_ON_THE_GROUND,
        lambda c, v: _has_receiver(c, v) and c.firmware >= SKIPS_CHECKS,
    ),
)
LOCAL_RULES = (
    Rule("VISO_TYPE", _one_of(1), _constant(1), Status.FAIL, "1 (MAVLink) takes ODOMETRY and VISION_POSITION_ESTIMATE"),
    Rule(
        "VISO_DELAY_MS",
        lambda v: v <= 50,
        lambda _v, c: float(c.delay_ms),
        Status.WARN,
        "positions are for the moment of sending",
    ),
)
ALWAYS = (
    Rule("EK3_ENABLE", _one_of(1), _constant(1), Status.FAIL, "the rules apply to EKF3"),
    Rule("AHRS_EKF_TYPE", _one_of(3), _constant(3), Status.FAIL, "the rules apply to EKF3"),
    Rule("EK3_SRC1_POSZ", _one_of(BARO), _constant(BARO), Status.WARN, "our height is no better than the barometer's"),
    Rule(
        "EK3_SRC1_YAW",
        lambda v: v not in (2, 3, EXTERNAL_NAV),
        _constant(COMPASS),
        Status.FAIL,
        "we send no yaw of our own",
    ),
    Rule(
        "AHRS_OPTIONS",
        lambda v: bool(int(v) & NO_DCM),
        lambda v, _c: float(int(v) | NO_DCM),
        Status.WARN,
        "without bit 0 a plane falls back to DCM, which flies on a raw jump after 4 s",
        _plane,
    ),
    Rule(
        "ARSPD_USE",
        lambda v: v > 0,
        lambda _v, _c: None,
        Status.WARN,
        "without airspeed a plane is 170 m off after 2 minutes without position, with it 11 m",
        _plane,
    ),
    Rule(
        "FS_EKF_THRESH",
        lambda v: v > 0,
        _constant(0.8),
        Status.WARN,
        "0 switches the failsafe for a lost position off",
        _copter,
    ),
    Rule(
        "FS_EKF_ACTION",
        lambda v: v > 0,
        _constant(1),
        Status.WARN,
        "0 only reports a lost position, and the mode goes on without one",
        _copter,
    ),
)
