"""What is said between the processes: every message, with units, frames and who says it.

Conventions that hold everywhere
--------------------------------
* ``t_ns`` is the time of the *measurement* on the one monotonic clock, in nanoseconds.
* World frame ``w``: local east, north, up (ENU) in metres around the flight's origin (``Origin``);
  up is height above mean sea level (AMSL).
* Body frame ``b``: forward, right, down (FRD). Camera frame ``c``: OpenCV (x right, y down, z into the scene).
* ``q_a_b`` is a unit quaternion (w, x, y, z) that takes b coordinates into a.
* Covariances 6x6 are row-major, order (east, north, up, rotation about east, north, up), m^2 and rad^2.
* A field that is ``None`` is not known; absence is a state, not an error.
"""

from enum import StrEnum

import msgspec

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Mat2 = tuple[float, float, float, float]
Mat6 = tuple[float, ...]
ImuSample = tuple[int, float, float, float, float, float, float]


class SourceLabel(StrEnum):
    """Where a position comes from (AC-12)."""

    SATELLITE_ANCHORED = "satellite_anchored"  # a map match entered within the last keyframes
    VISUAL_PROPAGATED = "visual_propagated"  # odometry since the last map match
    DEAD_RECKONED = "dead_reckoned"  # neither map nor odometry: growing covariance only


class CovarianceMode(StrEnum):
    """How the 6x6 covariance was computed (ON-2)."""

    MARGINALS = "marginals"
    JACOBIAN = "jacobian"


class ThermalBand(StrEnum):
    NORMAL = "normal"
    HOT = "hot"  # throttling or close to it: the cheap covariance is used
    CRITICAL = "critical"


class Verdict(StrEnum):
    """The answer to every measurement; anything but ACCEPTED names the reason of the rejection."""

    ACCEPTED = "accepted"
    BAD_IMAGE = "bad_image"  # unreadable, truncated, wrong size
    STALLED = "stalled"  # the camera repeats an earlier picture while the vehicle moves
    NO_FEATURES = "no_features"  # nothing to track
    FEW_INLIERS = "few_inliers"
    NO_PREDICTION = "no_prediction"  # nobody knows where to look
    OUTSIDE_MAP = "outside_map"
    TOO_LOW = "too_low"  # the footprint is too small to be matched
    AMBIGUOUS = "ambiguous"  # more than one place fits
    WEAK_PEAK = "weak_peak"
    PNP_FAILED = "pnp_failed"
    HIGH_REPROJECTION = "high_reprojection"
    DEGENERATE = "degenerate"
    INNOVATION = "innovation"  # disagrees with the estimate by more than both claim
    STALE = "stale"
    UNCONFIRMED = "unconfirmed"  # of a fragment that nothing has joined to the flight yet
    IMPLAUSIBLE = "implausible"  # jump, speed or height that cannot be
    MODEL_FAILED = "model_failed"  # the learned model gave no usable answer; ModelEvent has the reason
    LOST = "lost"  # what is seen is not where the vehicle was believed to be; its place is searched


class SearchStep(StrEnum):
    """How far the search for the vehicle's place has gone (PB-8)."""

    NORMAL = "normal"
    SKIP = "skip"  # this frame says nothing; the next one is tried
    NEW_FRAGMENT = "new_fragment"  # nothing joins this frame to the one before
    MERGE = "merge"  # the map joins what was flown since then to what came before, or a search has found the place
    WIDEN = "widen"  # lost: around the last place, 1 to 25 tiles
    WHOLE_MAP = "whole_map"
    ASK = "ask"  # the whole map was searched: a coarse position from the operator would help


class Message(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    """Base of all messages."""

    t_ns: int


# --- from the source of a flight -----------------------------------------------------------------


class Camera(msgspec.Struct, frozen=True, kw_only=True):
    """Pinhole camera of the stored frames (pixels) and its mount in the body (degrees)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV order: k1 k2 p1 p2 k3 ...
    focal_sigma: float = 0.1  # 1-sigma of the focal length, a share of it
    mount_yaw_deg: float = 0.0
    mount_pitch_deg: float = -90.0  # straight down, image top forward
    mount_roll_deg: float = 0.0
    mount_tolerance_deg: float = 5.0  # 1-sigma of the real tilt around the nominal one


class Origin(Message, frozen=True, kw_only=True):
    """Said once by whoever opens the source: camera, frame of reference and start of the flight."""

    camera: Camera
    lat_deg: float
    lon_deg: float
    ground_amsl_m: float | None  # AMSL height of the ground at the origin
    start_sigma_m: float  # 1-sigma of the start coordinate, per horizontal axis; of the size of the map: not known
    yaw_sigma_deg: float
    agl_sigma_m: float
    attitude_sigma_deg: float  # roll and pitch, when they are reported


class Frame(Message, frozen=True, kw_only=True):
    """A camera frame exists; its pixels are in the frame store under ``frame_id``."""

    frame_id: int
    file: str  # name in the source ("" for a live camera)
    width: int
    height: int
    error: str = ""  # not empty: there are no pixels, and this says why


class VehicleState(Message, frozen=True, kw_only=True):
    """Attitude, height and velocity as an autopilot reports them, at ``t_ns``.

    ``yaw_rad`` clockwise from true north; ``agl_m`` above ground (or take-off); never GNSS position."""

    source: str  # "frames.csv", "mavlink", "exif"
    yaw_rad: float | None = None
    pitch_rad: float | None = None
    roll_rad: float | None = None
    agl_m: float | None = None
    velocity_enu_mps: Vec3 | None = None
    armed: bool | None = None  # motors may turn; a vehicle that is not armed stands
    airspeed_mps: float | None = None  # as a sensor reads it, never computed from wind or GNSS


class Imu(Message, frozen=True, kw_only=True):
    """Inertial readings of the autopilot, a few at a time, oldest first; ``t_ns`` is that of the newest.

    ``samples``: (ns before ``t_ns``; specific force forward, right, down [m/s^2]; angular velocity about the same
    axes [rad/s]). Level and at rest the specific force is (0, 0, -9.81)."""

    source: str  # "mavlink"
    samples: list[ImuSample]


class SourceEnded(Message, frozen=True, kw_only=True):
    """The source has no more frames."""

    frames: int


# --- vision ---------------------------------------------------------------------------------------


class Odometry(Message, frozen=True, kw_only=True):
    """Motion of frame ``frame_id`` against keyframe ``keyframe_id``, as matched rays.

    ``pairs``: (x_kf, y_kf, x, y) in undistorted normalised image coordinates (tan of the angle) of
    features on the ground seen in both, RANSAC inliers, spread over the image. Metric scale comes
    later, from the height that the estimator knows.

    ``triples``: (x_before, y_before, x_kf, y_kf, x, y), of features that the keyframe before, ``before_id``, saw as
    well; of frames that become a keyframe. They say how long the way to this frame is in units of the way before,
    whatever the ground is like."""

    frame_id: int
    keyframe_id: int
    verdict: Verdict
    pairs: list[tuple[float, float, float, float]] = []
    sigma_norm: float = 0.0  # 1-sigma of one coordinate, normalised units
    inliers: int = 0
    tracked: int = 0
    becomes_keyframe: bool = False  # following frames refer to this frame
    before_id: int = -1  # -1: there are no triples
    triples: list[tuple[float, float, float, float, float, float]] = []
    triples_sigma_norm: float = 0.0  # 1-sigma of one coordinate of these, normalised units
    static: bool = (
        False  # the same view as in the frame before, to 0.006 degrees: the vehicle stands, or the camera is frozen
    )


# --- estimator to anchor --------------------------------------------------------------------------


class Prediction(Message, frozen=True, kw_only=True):
    """Where the estimator believes that the camera was at frame ``frame_id``, before any map match of it."""

    frame_id: int
    p_c_in_w_m: Vec3
    q_w_c: Quat
    cov: Mat6  # of the camera pose
    agl_m: float  # height of the camera above the ground beneath it
    agl_sigma_m: float
    step_m: Vec2  # camera motion (east, north) since the previous Prediction, by odometry alone
    step_cov_m2: Mat2  # its covariance (ee, en, ne, nn)
    lens: float = 0.0  # what the lens bends beyond its description, as far as that is sure (core.camera.straightened)
    start_ns: int = 0  # t_ns of what told the place anew (a Start, a Coasted); 0: nothing did


# --- anchor ---------------------------------------------------------------------------------------


class MapMatch(Message, frozen=True, kw_only=True):
    """A frame against the map: 2D-3D matches, the camera pose that they give, and how sure the belief is."""

    frame_id: int
    verdict: Verdict
    matcher: str  # "gradient", "xfeat"
    coarse: bool = False  # position of the belief's mode alone: no 2D-3D matches agreed
    matches: list[tuple[float, float, float, float, float, float]] = []  # x, y (normalised); e, n, u (m); weight
    p_c_in_w_m: Vec3 | None = None
    q_w_c: Quat | None = None
    cov: Mat6 | None = None
    lens: float = 0.0  # the frame was seen through this (as in Prediction)
    inliers: int = 0
    reprojection_px: float = 0.0
    margin: float = 0.0  # best peak over the best rival, in standard deviations of the surface
    mode_mass: float = 0.0  # share of the belief that sits in the winning mode, 0..1
    mode_e_m: float = 0.0  # centre of the winning mode
    mode_n_m: float = 0.0
    # The heaviest modes of the belief: east, north [m], share of the mass, variance within the mode per axis [m^2]
    modes: list[tuple[float, float, float, float]] = []
    belief_m: Vec2 = (0.0, 0.0)  # mean of the whole belief, east and north
    belief_cov_m2: Mat2 = (0.0, 0.0, 0.0, 0.0)  # of the whole belief, all modes
    ground: Vec3 | None = (
        None  # plane of the ground below, from the map's DEM: AMSL at p_c_in_w_m, slope east, slope north
    )
    relief_m: float = 0.0  # what the ground that is seen departs from that plane, root mean square
    map_sigma_m: float = 0.0  # error of the map itself, 1-sigma per horizontal axis: common to all matches
    step: SearchStep = SearchStep.NORMAL
    lost_sigma_m: float = 0.0  # that the place may be wrong: 1-sigma per horizontal axis, on top of what is predicted
    found: bool = False  # by a search: what was believed of the position before counts for nothing


class SearchState(Message, frozen=True, kw_only=True):
    """Said on every change: how far the search for the vehicle's place has gone; ``normal`` when there is none."""

    step: SearchStep


class PositionHint(Message, frozen=True, kw_only=True):
    """A coarse position from a person, or after a restart in flight from the autopilot: where a search begins.

    ``radius_m``: it is so near, in 95 of 100 cases; at ``t_ns``, when the hint was given."""

    lat_deg: float
    lon_deg: float
    radius_m: float
    source: str  # "ground station 255", "command line", "autopilot"


class Coasted(Message, frozen=True, kw_only=True):
    """How the autopilot's filter has moved by its own sensors alone, in ``coast_s`` from our last 3D fix to ``t_ns``.

    Position and velocity with their 1-sigma per axis are those of the fix. ``gain_mps``: by how much the filter's
    velocity changed since; ``way_m``: how much farther (east, north) it has come by that than by its velocity then."""

    coast_s: float
    lat_deg: float
    lon_deg: float
    velocity_enu_mps: Vec3
    position_sigma_m: float
    velocity_sigma_mps: float
    way_m: tuple[float, float]
    gain_mps: Vec3


class HintVerdict(Message, frozen=True, kw_only=True):
    """What became of a PositionHint, said with the first frame after it.

    ACCEPTED: a search begins there, or it agrees with the position that the map holds; INNOVATION: it does not agree,
    and changes nothing; OUTSIDE_MAP."""

    hint_t_ns: int  # t_ns of the hint
    verdict: Verdict
    distance_m: float | None  # from the position that was believed; None: none was
    sigma_m: float | None  # what that one claimed, 1-sigma per horizontal axis
    text: str  # for the operator, at most 40 characters


class Start(Message, frozen=True, kw_only=True):
    """Where the flight begins, if its Origin does not say so: the answer to a GnssStart, with the ground of the map.

    ``t_ns`` is that of the GnssStart. OUTSIDE_MAP: not taken. Without a place (None) the start is not known."""

    verdict: Verdict
    lat_deg: float | None
    lon_deg: float | None
    sigma_m: float | None  # 1-sigma per horizontal axis
    ground_amsl_m: float | None  # AMSL height of the ground there; None: the map does not tell


class ModelChange(StrEnum):
    OPENED = "opened"
    PROVIDER = "provider"  # the one that ran it failed; the next one does from now on
    FAILED = "failed"  # no usable answer to this frame
    GIVEN_UP = "given_up"  # matching goes on without weights


class ModelEvent(Message, frozen=True, kw_only=True):
    """What became of the learned model that map matching uses: said at the start, and on every change."""

    model: str  # "xfeat"
    change: ModelChange
    provider: str  # "TensorRT", "CUDA", "CPU"; empty: none
    detail: str  # checksum and why better providers were passed over; or the reason of the change


# --- estimator ------------------------------------------------------------------------------------


class NavEstimate(Message, frozen=True, kw_only=True):
    """The product: where the vehicle was at ``t_ns`` and how well that is known (AC-12, ON-1)."""

    frame_id: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    agl_m: float
    velocity_enu_mps: Vec3
    velocity_sigma_mps: float
    q_w_b: Quat
    cov: Mat6  # of the body pose
    map_sigma_m: float = 0.0  # of it, per horizontal axis: the error of the map itself, as that states it
    source_label: SourceLabel
    covariance_mode: CovarianceMode
    last_anchor_age_ms: int  # -1: never anchored
    emitted_at_ns: int  # when it was said; in a replay, the time of the frame that it answers


class CalibrationFault(Message, frozen=True, kw_only=True):
    """A monitor has found, or finds no more, that what describes the flight is wrong: said on every change.

    ``quantity``: "scale" (height or focal length), "mount yaw", "heading", "mirrored picture", "registration" (the map
    is found nowhere, and why is not known)."""

    quantity: str
    factor: float | None  # scale: told height over the true one; angles: told less true, degrees; None: not known
    detail: str  # what it was found from
    active: bool


class LearntLens(msgspec.Struct, frozen=True, kw_only=True):
    """k1, k2, p1, p2, the focal length (relative, less one) and the middle of the picture (right and down of where its
    description has it), in normalised coordinates; the inverse of their covariance."""

    value: tuple[float, ...]  # 7
    information: tuple[float, ...]  # 7x7, row-major


class SlowErrors(Message, frozen=True, kw_only=True):
    """Once a second: what was learnt by now of what is off for a whole flight: mount, compass, barometer, lens."""

    frame_id: int
    # Tilt of the mount about the camera's x and y [rad], heading [rad], height [m], first radial coefficient [-],
    # logarithm of heights told over heights seen [-]
    error: tuple[float, float, float, float, float, float]
    cov: tuple[float, ...]  # 6x6, row-major
    lens: LearntLens | None = None  # of a camera that nobody has calibrated; estimator/measurements/principal_point.py


class RefinedPose(msgspec.Struct, frozen=True, kw_only=True):
    frame_id: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    sigma_e_m: float
    sigma_n_m: float


class Refinement(Message, frozen=True, kw_only=True):
    """Better positions of past frames, after later anchors (AC-8)."""

    poses: list[RefinedPose]


class MeasurementVerdict(Message, frozen=True, kw_only=True):
    """What was done with one measurement (law: every measurement gets one)."""

    frame_id: int  # -1: of no frame
    # "odometry", "map", "attitude", "height", "start", "reset" (of the graph); of the link "estimate", "telemetry",
    # "wall clock"
    measurement: str
    verdict: Verdict
    detail: str = ""
    mahalanobis2: float | None = None


# --- link -----------------------------------------------------------------------------------------


class GpsInput(Message, frozen=True, kw_only=True):
    """What was sent to the autopilot as MAVLink GPS_INPUT (232); units of this record are SI."""

    fix_type: int
    time_week: int
    time_week_ms: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    hdop: float
    vdop: float
    vn_mps: float
    ve_mps: float
    vd_mps: float
    speed_accuracy_mps: float
    horiz_accuracy_m: float
    vert_accuracy_m: float
    satellites_visible: int
    estimate_age_ms: float  # age of the estimate that this was carried forward from; -1: none
    caution: int = 0  # rung of the caution ladder: 1, 2, 3 from 5, 15, 35 s without a map fix
    unanchored_s: float | None = None  # seconds since the last map fix; None: nothing was believed yet
    map_offset_m: tuple[float, float] = (0.0, 0.0)  # east, north: error of the map that was taken out (MapOffset)
    reason: str = ""  # why fix_type is not 3
    resets: int = 0  # jumps of the estimate that were accepted since the link began: reset_counter of ODOMETRY


class LinkStatus(Message, frozen=True, kw_only=True):
    """1 Hz: the state of the MAVLink connection."""

    connected: bool
    autopilot: str  # "ardupilot", "px4", "none", ...
    sysid: int
    sent: int
    received: int
    bad: int  # bytes that belonged to no packet
    refused: int = 0  # packets without the signature that is asked for
    time_offset_ms: float | None
    detail: str = ""


class GnssReading(Message, frozen=True, kw_only=True):
    """What a GNSS receiver of the autopilot says, at its arrival; to be judged, and never to navigate by in flight."""

    receiver: int  # 0 is the autopilot's GPS1
    fix_type: int  # GPS_FIX_TYPE: 3 is 3D
    lat_deg: float | None  # None: no position
    lon_deg: float | None
    horizontal_m: float | None  # 1-sigma that it claims
    speed_mps: float | None
    satellites: int | None


class GnssStart(Message, frozen=True, kw_only=True):
    """Where a receiver says that the vehicle stands before take-off, until it is armed; repeated once a second.

    ``t_ns`` is that of the reading, and of its repetitions. Without a place (None) the one before is withdrawn."""

    lat_deg: float | None
    lon_deg: float | None
    sigma_m: float | None  # 1-sigma per horizontal axis
    receiver: int  # 0 is the autopilot's GPS1


class GnssState(StrEnum):
    UNKNOWN = "unknown"  # nothing to compare with yet
    TRUSTED = "trusted"  # has agreed with the map for long enough
    LOST = "lost"  # no fix, silent, or useless by its own word
    SPOOFED = "spoofed"  # says a position that cannot be
    DISPUTED = "disputed"  # disagrees, but just when our own estimate moved


class GnssVerdict(Message, frozen=True, kw_only=True):
    """What is thought of a GNSS receiver: on every change, and once a second."""

    receiver: int
    state: GnssState
    distance_m: float | None  # from our estimate
    sigmas: float | None  # the same in standard deviations, when both claims are honest
    reason: str = ""


class MapOffset(Message, frozen=True, kw_only=True):
    """How far off the map is, as a receiver that is trusted shows it; on every change. ``t_ns``: of what was learnt."""

    map_sigma_m: float  # which map: what it states of itself, 1-sigma per horizontal axis
    lat_deg: float  # where it was learnt last
    lon_deg: float
    # Error of the map east and north [m], of the receiver [m], age of its readings less what is assumed [s]
    state: tuple[float, ...]
    cov: tuple[float, ...]  # 5x5, row-major


class PositionSource(Message, frozen=True, kw_only=True):
    """The autopilot is to fly on us (``vision``), or on its GNSS ``receiver`` again."""

    vision: bool
    receiver: int


class FilterStatus(Message, frozen=True, kw_only=True):
    """What the autopilot's filter says of itself (EKF_STATUS_REPORT, PX4: ESTIMATOR_STATUS): whether our position
    arrives in it."""

    flags: int  # EKF_STATUS_FLAGS
    position_ratio: float  # horizontal innovation by its gate: 1 is the limit
    velocity_ratio: float


class WallClock(Message, frozen=True, kw_only=True):
    """Said by the link's edge: Unix time at ``t_ns``, for the GPS week. ``unix_ns`` None: no clock is plausible."""

    unix_ns: int | None
    source: str  # "system", "autopilot", "none"


class StatusText(Message, frozen=True, kw_only=True):
    """A line for the pilot's screen, sent as MAVLink STATUSTEXT (253)."""

    severity: int  # MAV_SEVERITY: 2 critical, 4 warning, 5 notice, 6 info
    text: str  # at most 50 characters


# --- health and the shell -------------------------------------------------------------------------


class TemperatureZone(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    temperature_c: float


class ThermalReading(Message, frozen=True, kw_only=True):
    """1 Hz: what the sensors of the computer say, unjudged; Health is made of it."""

    zones: list[TemperatureZone]
    throttling: list[str]  # cooling devices that slow a processor down right now
    disk_free_mb: int | None


class Health(Message, frozen=True, kw_only=True):
    """1 Hz: temperature, throttle and disk."""

    band: ThermalBand
    temperature_c: float | None  # hottest zone; None: no zone readable
    throttled: bool
    disk_free_mb: int | None
    cause: str  # why the band is what it is


class ProcessEvent(Message, frozen=True, kw_only=True):
    """Said by the supervisor: a process started, died, was restarted or gave up."""

    process: str
    event: str  # "started", "died", "stuck", "restarted", "gave_up", "stopped"
    detail: str = ""


class Dropped(Message, frozen=True, kw_only=True):
    """Said by the shell: a queue overflowed and messages were lost."""

    process: str
    message: str
    count: int


AnyMessage = (
    Origin
    | Frame
    | VehicleState
    | Imu
    | SourceEnded
    | Odometry
    | Prediction
    | MapMatch
    | ModelEvent
    | SearchState
    | PositionHint
    | Coasted
    | HintVerdict
    | Start
    | NavEstimate
    | CalibrationFault
    | SlowErrors
    | Refinement
    | MeasurementVerdict
    | GpsInput
    | LinkStatus
    | GnssReading
    | GnssStart
    | GnssVerdict
    | MapOffset
    | PositionSource
    | FilterStatus
    | WallClock
    | StatusText
    | ThermalReading
    | Health
    | ProcessEvent
    | Dropped
)
