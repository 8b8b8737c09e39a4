"""All messages between the processes, with units, frames and publishers.

Conventions
-----------
* ``t_ns`` is the time of the *measurement* on the shared monotonic clock, in nanoseconds.
* World frame ``w``: local east, north, up (ENU) in metres about the origin of the flight (``Origin``);
  up is height above mean sea level (AMSL).
* Body frame ``b``: forward, right, down (FRD). Camera frame ``c``: OpenCV (x right, y down, z into the scene).
* ``q_a_b`` is a unit quaternion (w, x, y, z) that rotates b coordinates into a.
* Covariances 6x6 are row-major, order (east, north, up, rotation about east, north, up), m^2 and rad^2.
* The value ``None`` means unknown, which is a valid state of a field.
"""

import functools
import operator
from enum import StrEnum
from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET, UnsetType

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Mat2 = tuple[float, float, float, float]
Mat6 = tuple[float, ...]
ImuSample = tuple[int, float, float, float, float, float, float]


class SourceLabel(StrEnum):
    """Source of a position (AC-12)."""

    # A map match (satellite imagery, not GNSS) was fused for a frame at most 1.5 s old.
    SATELLITE_ANCHORED = "satellite_anchored"
    VISUAL_PROPAGATED = "visual_propagated"  # visual odometry since the last map match
    DEAD_RECKONED = "dead_reckoned"  # neither map match nor odometry: prediction with growing covariance
    # No map match was fused in this flight, and no start is known to SEARCH_START_SIGMA_M: the position is the centre
    # of a prior, and no consumer shows or uses it.
    NOT_PLACED = "not_placed"


class CovarianceMode(StrEnum):
    """Method by which the 6x6 covariance was computed (ON-2)."""

    MARGINALS = "marginals"  # of C_k, from iSAM2
    # Propagated from frame to frame while the thermal band is not normal; pose marginals are not computed per frame.
    JACOBIAN = "jacobian"


class ThermalBand(StrEnum):
    NORMAL = "normal"
    HOT = "hot"  # at ``hot_c``, or throttled: propagated covariance (JACOBIAN), fewer map matches
    CRITICAL = "critical"  # at ``critical_c``: also without the learned model; a warning to the pilot


class Verdict(StrEnum):
    """Result of a measurement: ACCEPTED, or the reason of the rejection."""

    ACCEPTED = "accepted"
    BAD_IMAGE = "bad_image"  # unreadable, truncated, wrong size
    NO_GROUND = "no_ground"  # the gimbal holds the camera so flat that it sees no ground to match
    OVERTAKEN = "overtaken"  # left out: the computer was busy until a newer frame was there
    STALLED = "stalled"  # the camera repeats an earlier image while the vehicle moves
    NO_FEATURES = "no_features"  # no features to track
    FEW_INLIERS = "few_inliers"  # too few or too small a share of the matches agree with one motion or camera pose
    NO_PREDICTION = "no_prediction"  # no prior position
    OUTSIDE_MAP = "outside_map"
    TOO_LOW = "too_low"  # the footprint is too small for matching
    # More than one position fits: a mode below 90 % of the mass, or a coarse match where a pose is needed (unknown
    # heading, or an estimate with a large sigma).
    AMBIGUOUS = "ambiguous"
    # The matches do not determine the pose: it is too far from the mode or too much tilted, there is no ground in view,
    # the refinement failed, the geometry is ill-conditioned, or (odometry) the height of the ground is unknown.
    DEGENERATE = "degenerate"
    INNOVATION = "innovation"  # map match, airspeed, dead reckoning, start or estimate beyond its gate
    # Frame or keyframe has left the window of the graph, or is older than the start or the first telemetry after a
    # restart; estimate late or out of order.
    STALE = "stale"
    UNCONFIRMED = "unconfirmed"  # odometry or coarse match of a fragment that is not yet joined to the flight
    IMPLAUSIBLE = "implausible"  # odometry, height or heading beyond its gate; impossible estimate, telemetry or time
    MODEL_FAILED = "model_failed"  # the learned model gave no usable output; ModelEvent has the reason
    THROTTLED = "throttled"  # not matched: the map rate of the thermal band
    LOST = "lost"  # the images contradict the estimated position; relocalisation is active


class SearchStep(StrEnum):
    """Stage of the relocalisation search (PB-8)."""

    NORMAL = "normal"
    SKIP = "skip"  # this frame gives no information; the next one is tried
    NEW_FRAGMENT = "new_fragment"  # odometry does not connect this frame to the previous one
    MERGE = "merge"  # a map match joins the fragment to the earlier trajectory, or a search has found the position
    WIDEN = "widen"  # lost: search around the last position, 1 to 25 tiles
    WHOLE_MAP = "whole_map"
    ASK = "ask"  # the whole map was searched without result: a coarse position from the operator would help


class Message(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    """Base class of all messages."""

    t_ns: int


# --- from the source of a flight -----------------------------------------------------------------


class Gimbal(msgspec.Struct, frozen=True, kw_only=True):
    """Gimbal of the camera, which holds it as the mount says: level, image top forward, unless it reports otherwise."""

    required: bool = True  # False: until it reports, the camera counts as fixed to the vehicle
    device: int = 0  # number that it reports (GimbalAttitude); 0: the first that is heard
    stabilised: tuple[str, ...] = ("roll", "pitch")  # axes that are level when nothing is reported


class Camera(msgspec.Struct, frozen=True, kw_only=True):
    """Pinhole intrinsics for the stored frames (pixels) and orientation of the camera in the body (degrees)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV order: k1 k2 p1 p2 k3 ...
    focal_sigma: float = 0.1  # 1-sigma of the focal length, relative
    mount_yaw_deg: float = 0.0
    mount_pitch_deg: float = -90.0  # straight down, image top forward
    mount_roll_deg: float = 0.0
    mount_tolerance_deg: float = 5.0  # 1-sigma of the true tilt about the nominal tilt
    gimbal: Gimbal | UnsetType = UNSET  # the camera is on it; unset: fixed to the vehicle
    # Rolling shutter: time from the exposure of the first row to that of the last; ``t_ns`` of a Frame is that of the
    # middle row. Unset: all rows are exposed at once.
    readout_s: float | UnsetType = UNSET


class Origin(Message, frozen=True, kw_only=True):
    """Camera, reference point of the local frame and initial position; published once when the source is opened."""

    camera: Camera
    lat_deg: float
    lon_deg: float
    ground_amsl_m: float | None  # AMSL height of the ground at the origin
    start_sigma_m: float  # 1-sigma of the initial position per horizontal axis; as large as the map if unknown
    yaw_sigma_deg: float
    agl_sigma_m: float
    attitude_sigma_deg: float  # of reported roll and pitch
    flight_id: str = ""  # UUID; with the number of a frame it names that frame over all flights (core/flight_id.py)


class Fact(NamedTuple):
    # "camera", "mount", "start", "height", "heading", "tilt", "clock", "exposure", "rate", "vehicles", "left out"
    topic: str
    text: str


class SourceFacts(Message, frozen=True, kw_only=True):
    """What the source says of itself when it is opened: where each number comes from, what is assumed, and what is left
    out and why. Published after Origin."""

    facts: tuple[Fact, ...]


OVERTAKEN = "overtaken: a newer frame was there first"  # error of a frame that was left out, not of the camera
TOO_SLOW = "computer too slow"  # for all frames: quantity of a CalibrationFault


# 1-sigma of the time stamp of a frame against its exposure: exposure, readout and transfer of USB cameras [s].
STAMP_SIGMA_S = 0.03  # [tuned]


class Frame(Message, frozen=True, kw_only=True):
    """A new camera frame, whose pixels are in the frame store under ``frame_id``."""

    frame_id: int
    file: str  # name in the source ("" for a live camera)
    width: int
    height: int
    error: str = ""  # not empty: the frame has no pixels; this is the reason
    # A buffer may lie between exposure and ``t_ns``: the stamp is of arrival, or by the sender of a network stream.
    buffered: bool = False
    stamp_sigma_s: float = STAMP_SIGMA_S  # 1-sigma of ``t_ns`` about the exposure, as far as the source knows


class VehicleState(Message, frozen=True, kw_only=True):
    """Attitude, height and velocity as an autopilot reports them, at ``t_ns``.

    ``yaw_rad``: clockwise from true north. ``agl_m``: above ground (or take-off). Contains no GNSS position."""

    source: str  # "frames.csv", "mavlink", "exif"
    yaw_rad: float | None = None
    pitch_rad: float | None = None
    roll_rad: float | None = None
    agl_m: float | None = None
    velocity_enu_mps: Vec3 | None = None
    armed: bool | None = None  # motors are enabled; a vehicle that is not armed is stationary
    airspeed_mps: float | None = None  # reading of an airspeed sensor; not a value computed from wind or GNSS


class Imu(Message, frozen=True, kw_only=True):
    """A batch of IMU samples of the autopilot, oldest first; ``t_ns`` is the time of the newest.

    ``samples``: (ns before ``t_ns``; specific force forward, right, down [m/s^2]; angular velocity about the same
    axes [rad/s]). The specific force at rest and level is (0, 0, -9.81)."""

    source: str  # "mavlink"
    samples: list[ImuSample]


class GimbalAttitude(Message, frozen=True, kw_only=True):
    """Attitude of a gimbal, as it reports it."""

    q: Quat  # from its axes (along the view, right, down) to north, east, down, or to heading, right, down
    from_north: bool  # False: yaw is from the heading of the vehicle
    device: int = 0  # gimbal_device_id, or component id of the gimbal; 0: the message names none


class Exposure(Message, frozen=True, kw_only=True):
    """The autopilot reports that a camera has exposed an image at ``t_ns``."""

    kind: str  # CAMERA_FEEDBACK, CAMERA_IMAGE_CAPTURED, CAMERA_TRIGGER
    number: int  # as its sender counts


class SourceEnded(Message, frozen=True, kw_only=True):
    """The source has no more frames."""

    frames: int


# --- vision ---------------------------------------------------------------------------------------


class KeyframeLink(msgspec.Struct, frozen=True, kw_only=True):
    """Feature matches of a frame with one more keyframe; fields as in Odometry."""

    keyframe_id: int
    two_view: list[tuple[float, float, float, float]]
    sigma_norm: float
    inliers: int
    tracked: int


class Odometry(Message, frozen=True, kw_only=True):
    """Feature matches of frame ``frame_id`` with keyframe ``keyframe_id``, the input of visual odometry.

    ``two_view``: (x_kf, y_kf, x, y) in undistorted normalised image coordinates (tangents of the ray angles) of ground
    features in both frames: RANSAC inliers, spread over the image. The estimator adds the metric scale from its
    height.

    ``three_view``: (x_prev, y_prev, x_kf, y_kf, x, y) of features that are also in the previous keyframe,
    ``previous_keyframe_id``; only of frames that become a keyframe. They determine the ratio of two successive
    baselines independently of the shape of the ground."""

    frame_id: int
    keyframe_id: int
    verdict: Verdict
    two_view: list[tuple[float, float, float, float]] = []
    sigma_norm: float = 0.0  # 1-sigma of one coordinate of ``two_view``, normalised units
    inliers: int = 0
    tracked: int = 0
    becomes_keyframe: bool = False  # the following frames are matched with this frame
    previous_keyframe_id: int = -1  # -1: ``three_view`` is empty
    three_view: list[tuple[float, float, float, float, float, float]] = []
    three_view_sigma_norm: float = 0.0  # 1-sigma of one coordinate of ``three_view``, normalised units
    # The view equals that of the previous frame to 0.006 degrees: the vehicle is stationary, or the camera is frozen.
    static: bool = False
    # Fragment of the frame (frames that odometry connects to each other), numbered from 0 in the order in which they
    # begin; a fragment that is continued keeps its number. -1: none, the frame is registered to no keyframe.
    fragment_id: int = -1
    links: list[
        KeyframeLink
    ] = []  # further keyframes of the fragment; of a frame that is not tracked, but matched anew


class Relocalization(Message, frozen=True, kw_only=True):
    """Frame ``frame_id`` sees the ground of an older keyframe, which the keyframe database of vision has kept.

    A loop closure if both are of one fragment; else it joins two fragments. Vision has verified it by geometry; the
    estimator gates it. ``two_view`` as in Odometry: (x_kf, y_kf, x, y), normalised, RANSAC inliers."""

    frame_id: int
    fragment_id: int  # of the frame
    keyframe_id: int
    keyframe_fragment_id: int
    two_view: list[tuple[float, float, float, float]]
    sigma_norm: float  # 1-sigma of one coordinate of ``two_view``, normalised units
    inliers: int
    tracked: int  # matches, of which ``inliers`` agree with one motion


# --- estimator to anchor --------------------------------------------------------------------------


class ReadoutMotion(msgspec.Struct, frozen=True, kw_only=True):
    """How a camera with a rolling shutter moved at a frame, in its own axes."""

    rate_radps: Vec3
    speed_per_s: Vec3  # velocity over the height above ground


class Prediction(Message, frozen=True, kw_only=True):
    """Predicted camera pose at frame ``frame_id`` (the prior for map matching), without a map match of that frame."""

    frame_id: int
    p_c_in_w_m: Vec3
    q_w_c: Quat
    cov: Mat6  # of the camera pose
    agl_m: float  # height of the camera above the ground below it
    agl_sigma_m: float
    step_m: Vec2  # camera motion (east, north) since the previous Prediction, from odometry alone
    step_cov_m2: Mat2  # covariance of step_m (ee, en, ne, nn)
    # Coefficient [-] of the division model for the distortion that the description of the camera leaves
    # (core.camera.undistort_division); 0: not significant
    radial_k1: float = 0.0
    prior_t_ns: int = 0  # t_ns of the InitialPosition or EkfDeadReckoning that reset the position; 0: no reset
    fragment_id: int = -1  # fragment of the frame (as in Odometry); -1: none
    joined: bool = True  # something other than dead reckoning ties that fragment to the flight; True without a fragment
    readout_motion: ReadoutMotion | UnsetType = UNSET  # of a camera with a rolling shutter, where it is known
    # Position that this camera would have by map matches that contradict the estimate; None: there are none
    alternative_m: Vec2 | None = None


# --- anchor ---------------------------------------------------------------------------------------


class MapPose(msgspec.Struct, frozen=True, kw_only=True):
    """Camera pose of a map match with its covariance."""

    p_c_in_w_m: Vec3
    q_w_c: Quat
    cov: Mat6
    # Position of a mode of the posterior, which earlier frames have selected too; attitude as predicted: there are no
    # consistent 2D-3D matches.
    position_only: bool = False


class PnpInput(msgspec.Struct, frozen=True, kw_only=True):
    """What PnP takes beside the 2D-3D matches of a frame (core/pnp.py). Normalised image coordinates are shares of the
    height above ground."""

    q_w_c: Quat  # predicted rotation of the camera
    agl_m: float  # predicted height above ground
    sigma_floor: float  # smallest 1-sigma of a match, normalised image coordinates
    threshold: float  # largest reprojection error of an inlier, normalised image coordinates
    search_radius: float  # within which each match was searched around its expected place, share of the height
    min_inliers: int  # fewest inliers of a pose


class MatchPlace(msgspec.Struct, frozen=True, kw_only=True):
    """Place about which the pose of a frame was estimated: the strongest mode of the posterior, the mode that the
    patches of the frame alone have selected, or the place that a search has found."""

    e_m: float
    n_m: float
    mass: float  # probability mass of the strongest mode of the posterior, 0..1; 1 after a search


class BeliefMode(msgspec.Struct, frozen=True, kw_only=True):
    """One mode of the posterior over position."""

    e_m: float
    n_m: float
    mass: float  # probability mass, 0..1
    variance_m2: float  # within the mode, per axis


class BeliefSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The posterior over camera positions, east and north, after a frame (point mass filter of the anchor)."""

    mean_m: Vec2  # of the whole posterior
    cov_m2: Mat2  # of the whole posterior, all modes (ee, en, ne, nn)
    modes: list[BeliefMode]  # the strongest ones, the best first
    mode_score: float  # standardised correlation of the frame at the best mode


class GroundPlane(msgspec.Struct, frozen=True, kw_only=True):
    """Plane fitted to the map's DEM below the camera."""

    amsl_m: float  # AMSL height below the predicted camera, or below the place that a search has found
    slope_e: float  # rise per metre towards east
    slope_n: float  # rise per metre towards north
    relief_m: float = 0.0  # RMS deviation of the DEM from the plane


class SearchResult(msgspec.Struct, frozen=True, kw_only=True):
    """What the relocalisation search says of a frame."""

    step: SearchStep = SearchStep.NORMAL
    # 1-sigma per horizontal axis, for the case that the position is wrong; in addition to the predicted covariance.
    sigma_m: float = 0.0
    relocalized: bool = False  # the search has found the pose: the prior position is to be discarded


ON_DRAWN = " on vectors"


class MapMatch(Message, frozen=True, kw_only=True):
    """Result of matching a frame to the map: 2D-3D matches or a camera pose, and the posterior over position.

    With ``pnp`` the estimator computes the pose from all ``matches`` (PoseSolution). Else the matcher has computed it
    (``pose``), from the whole image, from several frames, or from a mode of the posterior; ``matches`` are then those
    that agree with it. ``inliers`` and ``reprojection_px`` are of the matcher's own PnP."""

    frame_id: int
    verdict: Verdict
    # "gradient", or "xfeat" if the model has run for this frame; followed by ON_DRAWN if the map is drawn from roads,
    # water and buildings
    matcher: str
    inliers: int = 0
    refined: bool = False  # matched again from the pose of a first pass; False: passed through as first found
    reprojection_px: float = 0.0
    matches: list[tuple[float, float, float, float, float, float]] = []  # x, y (normalised); e, n, u (m); weight
    radial_k1: float = 0.0  # radial coefficient by which the matches are undistorted (as in Prediction)
    map_sigma_m: float = 0.0  # error of the map itself, 1-sigma per horizontal axis, common to all matches
    pnp: PnpInput | None = None
    pose: MapPose | None = None
    place: MatchPlace | None = None
    belief: BeliefSummary | None = None  # None: the frame was not correlated around the believed position
    ground: GroundPlane | None = None  # None: no DEM
    search: SearchResult = SearchResult()
    # Scale of the image's x axis over that of its y axis, by the map; None: the map does not tell
    aspect_ratio: float | None = None
    # Log likelihood ratio [nats] of this frame: the alternative position of its Prediction over ``place``
    alternative_nats: float | None = None

    @property
    def position_only(self) -> bool:
        """A coarse match: its pose is the position of a mode alone."""
        return self.pose is not None and self.pose.position_only

    @property
    def on_drawn(self) -> bool:
        """Whether the map shows roads, water and buildings instead of imagery."""
        return self.matcher.endswith(ON_DRAWN)


class SearchState(Message, frozen=True, kw_only=True):
    """Stage of the relocalisation search, published on every change; ``normal`` when no search is active."""

    step: SearchStep
    fragment_id: int = -1  # fragment of the frame (as in Odometry); -1: none
    joined: bool = True  # ... is joined to the flight (as in Prediction), with the match of this frame


class SearchPlaces(Message, frozen=True, kw_only=True):
    """What a running search covers and the best places of its last joint correlation, for an operator who can help it;
    published after the MapMatch of the frame, when it differs from the one before.

    ``tiles``: number of tiles around the last position; None: the whole map. ``places``: (latitude, longitude) [deg] of
    the camera; at most five, the best first. ``half_size_m``: half the side of a square into which
    the ground in the image fits, whatever the heading."""

    frame_id: int
    tiles: int | None
    places: list[Vec2]
    half_size_m: float


class PositionHint(Message, frozen=True, kw_only=True):
    """A coarse position prior for the search, from the operator, or from the autopilot after a restart in flight.

    ``radius_m``: 95 % radius about the given position, at ``t_ns``, the time at which the hint was given. A user fix is
    also a measurement: the camera of ``frame_id`` is there, with ``sigma_m`` per axis."""

    lat_deg: float
    lon_deg: float
    radius_m: float
    source: str  # "ground station 255", "command line", "autopilot", "console"
    frame_id: int = -1
    sigma_m: float | None = None  # None: a coarse hint, which the search alone uses


class EkfDeadReckoning(Message, frozen=True, kw_only=True):
    """Dead reckoning of the autopilot's EKF, without aiding, over ``duration_s`` from our last 3D fix to ``t_ns``.

    Position and velocity with their 1-sigma per axis are those of that fix. ``delta_v_mps``: change of the EKF velocity
    since. ``delta_p_m``: displacement (east, north) since, less the EKF velocity at the fix times ``duration_s``."""

    duration_s: float
    lat_deg: float
    lon_deg: float
    velocity_enu_mps: Vec3
    position_sigma_m: float
    velocity_sigma_mps: float
    delta_p_m: tuple[float, float]
    delta_v_mps: Vec3


class HintVerdict(Message, frozen=True, kw_only=True):
    """Result of a PositionHint, published with the first frame after it.

    ACCEPTED: a search starts there, or it agrees with the position of the map lock; INNOVATION: it disagrees with the
    map lock and is ignored; OUTSIDE_MAP."""

    hint_t_ns: int  # t_ns of the hint
    verdict: Verdict
    distance_m: float | None  # from the estimated position; None: there was none
    sigma_m: float | None  # of that estimate, 1-sigma per horizontal axis
    text: str  # for the operator, at most 40 characters


class InitialPosition(Message, frozen=True, kw_only=True):
    """Initial position if Origin has none: the reply to a GnssInitialPosition, with the ground height of the map.

    ``t_ns`` is that of the GnssInitialPosition. OUTSIDE_MAP: rejected. Without coordinates (None) the initial position
    is unknown."""

    verdict: Verdict
    lat_deg: float | None
    lon_deg: float | None
    sigma_m: float | None  # 1-sigma per horizontal axis
    ground_amsl_m: float | None  # AMSL height of the ground there; None: not in the map


class ModelChange(StrEnum):
    OPENED = "opened"
    PROVIDER = "provider"  # the execution provider failed; the next one is used from now on
    FAILED = "failed"  # no usable output for this frame
    GIVEN_UP = "given_up"  # matching, or odometry, continues without the learned model
    SUSPENDED = "suspended"  # matching continues without it while the thermal band is critical
    RESUMED = "resumed"


class ModelEvent(Message, frozen=True, kw_only=True):
    """State of a learned model, published on every change; of that for map matching also at the start."""

    model: str  # "xfeat"
    change: ModelChange
    provider: str  # "TensorRT", "CUDA", "CPU"; empty: none
    detail: str  # checksum and why preferred providers were not used, or the reason of the change


# --- estimator ------------------------------------------------------------------------------------


class NavEstimate(Message, frozen=True, kw_only=True):
    """Estimated position, velocity and attitude of the vehicle at ``t_ns`` with covariance (AC-12, ON-1)."""

    frame_id: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float  # above the ground at the start where ``amsl_known`` is False
    amsl_known: bool = True  # False: neither start nor DEM gives an elevation
    agl_m: float
    velocity_enu_mps: Vec3
    velocity_sigma_mps: float  # 1-sigma in the worst direction
    q_w_b: Quat
    q_w_c: Quat | UnsetType = UNSET  # of a camera on a gimbal; unset: as q_w_b and the mount say
    cov: Mat6  # of the body pose
    map_sigma_m: float = 0.0  # part of cov: stated error of the map itself, 1-sigma per horizontal axis
    source_label: SourceLabel
    covariance_mode: CovarianceMode
    last_anchor_age_ms: int  # age of the last map fix; -1: none yet
    emitted_at_ns: int  # time of publication; in a replay, the time of the frame
    fragment_id: int = -1  # fragment of the frame (as in Odometry); -1: none
    joined: bool = True  # ... is joined to the flight (as in Prediction)
    frame_uid: str = ""  # UUID of the flight and number of the frame; empty: the flight has no id

    @property
    def is_placed(self) -> bool:
        """A place stands behind the position; else its coordinates are neither shown nor used."""
        return self.source_label is not SourceLabel.NOT_PLACED

    @property
    def amsl_m(self) -> float | None:
        """Height above mean sea level [m]; None: no elevation is known."""
        return self.alt_amsl_m if self.amsl_known else None


class PoseMethod(StrEnum):
    """Method by which the camera pose of a map match was computed."""

    IPPE = "ippe"  # PnP of near-planar ground
    SQPNP = "sqpnp"  # PnP of ground with relief
    MATCHER = "matcher"  # by the matcher: all patches together, a search, or a mode of the posterior
    NONE = "none"  # there are no matches


class PoseSolution(Message, frozen=True, kw_only=True):
    """Camera pose of a MapMatch as the estimator computes it, before the gate; one for each MapMatch (ON-1).

    ``verdict``: ACCEPTED, that of PnP, or that of a match without a pose."""

    frame_id: int
    verdict: Verdict
    method: PoseMethod
    inliers: int = 0  # 2D-3D matches that agree with the pose
    residual_px: float | None = None  # RMS of their reprojection errors, pixels of the stored frame; None: no matches
    covariance_mode: CovarianceMode  # of the estimate with this match
    pose: MapPose | None = None


# Why the attitude of a camera on a gimbal is not the reported one: quantities of CalibrationFault
GIMBAL_FAULTS = ("gimbal not reported", "gimbal repeats a report", "gimbal reports its servos")


class CalibrationFault(Message, frozen=True, kw_only=True):
    """A monitor has detected a calibration fault, or its end; published on every change.

    ``quantity``: "scale" (height or focal length), "mount yaw", "heading", "attitude", "aspect ratio", "mirrored
    picture", "registration" (frames match the map nowhere, for an unknown reason); and of images that are refused since
    a moment of the flight "picture upside down", "picture turned", "picture mirrored", "picture frozen", "picture
    contradicts motion", "picture without texture"; "picture not on the map", "focal length" (it changes in flight),
    "camera time" (stamps against the autopilot), "start" (the vehicle stood on what moves). Of the link, of frames and
    telemetry that are left out, a gimbal included: those of LINK_FAULTS in ``link/pilot_text/statustext.py``."""

    quantity: str
    # scale: reported over true height; aspect ratio: scale of the image's x axis over that of y; angles: reported less
    # true, degrees; time: s late; None: unknown
    factor: float | None
    detail: str  # evidence of the fault
    active: bool


class LensEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """Estimated intrinsics in normalised coordinates with information matrix.

    ``value``: k1, k2, p1, p2, relative error of the focal length, offset of the principal point from its calibration
    (right, down). ``information``: inverse of their covariance."""

    value: tuple[float, ...]  # 7
    information: tuple[float, ...]  # 7x7, row-major


class CalibrationEstimate(Message, frozen=True, kw_only=True):
    """Estimated calibration errors that are constant in a flight (mount, compass, barometer, lens): 1 Hz, not while
    hot."""

    frame_id: int
    # Tilt of the mount about the camera's x and y [rad], heading [rad], height [m], first radial coefficient [-],
    # logarithm of the ratio of reported to observed heights [-]
    state: tuple[float, float, float, float, float, float]
    cov: tuple[float, ...]  # 6x6, row-major
    lens: LensEstimate | None = None  # only of an uncalibrated camera; estimator/measurements/principal_point.py


class PoseLink(Message, frozen=True, kw_only=True):
    """Pose of the camera at frame ``frame_id`` relative to frame ``parent_id``, as odometry or a relocalisation has
    measured it, without the map matches of the flight: the input of the smoother."""

    frame_id: int
    parent_id: int
    fragment_id: int  # of the frame (as in Odometry)
    p_in_parent_m: Vec3  # axes of the camera at the parent
    q_parent_c: Quat
    # Tangent order (rotation, then translation, axes of the camera at the frame), without the error of the scale
    cov: Mat6
    scale_sigma: float  # 1-sigma of the length of the translation by an error of the height, as a share
    agl_m: float  # height of the camera above the ground below it
    relocalization: bool = False  # the parent is an older keyframe whose ground the frame sees again
    # Covariance by another place that the vehicle may have been at (ee, en, ne, nn)
    ambiguity_m2: Mat2 = (0.0, 0.0, 0.0, 0.0)


class PoseAnchor(Message, frozen=True, kw_only=True):
    """Pose of the camera at frame ``frame_id`` by a map match that was fused: the input of the smoother."""

    frame_id: int
    fragment_id: int  # of the frame (as in Odometry); -1: none
    p_c_in_w_m: Vec3
    q_w_c: Quat
    cov: Mat6  # tangent order, as in PoseLink; what it shares with other matches over the same ground is in it
    map_sigma_m: float  # error of the map itself, 1-sigma per horizontal axis, common to all matches and not in cov
    covariance_mode: CovarianceMode  # of the estimate with this match
    # Where the optical axis meets the image beside its calibration (right, down; normalised coordinates): the estimated
    # offset of the principal point, and the covariance of this and of the tilt of the mount, common to all matches
    axis: Vec2 = (0.0, 0.0)
    axis_cov: Mat2 = (0.0, 0.0, 0.0, 0.0)


class RefinementSource(StrEnum):
    """What has refined a pose."""

    SMOOTHER = "smoother"  # in flight: pose graph of all fragments, map matches classified anew
    FLIGHT = "flight"  # after the end of the source: the estimator's own graph, linear as each frame left it


class RefinedPose(msgspec.Struct, frozen=True, kw_only=True):
    """Camera at frame ``frame_id``. ``cov_en_m2``: covariance of east and north.

    ``cov``: position [m], then rotation [rad], world axes; its horizontal part is that of the sigmas."""

    frame_id: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float | None  # None: no elevation is known
    sigma_e_m: float
    sigma_n_m: float
    cov_en_m2: float = 0.0
    fragment_id: int = -1  # fragment of the frame (as in Odometry); -1: none, or unknown
    q_w_c: Quat | None = None  # orientation of the camera; None, and ``cov``: of an earlier version
    cov: Mat6 | None = None
    # Metres of a unit of the submap of the frame: of odometry, in metres by the heights of the flight; None: no scale
    # was estimated, and the one that an earlier Refinement states for this frame holds
    m_per_unit: float | None = None


class ClaimBudget(Message, frozen=True, kw_only=True):
    """Terms of the horizontal covariance of a NavEstimate, once a second after the first map match, not while hot."""

    frame_id: int
    # Mean horizontal variance [m^2] of each term: "graph", "map", "illumination", "principal_point", "time_offset",
    # "hypotheses", "calibration". Their sum is that of NavEstimate.cov.
    terms_m2: dict[str, float]


class Refinement(Message, frozen=True, kw_only=True):
    """Smoothed poses of past frames, those that later map fixes, relocalisations and merges have moved (AC-8).

    The newest one of a frame counts."""

    poses: list[RefinedPose]
    source: RefinementSource = RefinementSource.FLIGHT


NO_FRAME_ID = -1  # frame_id of a verdict that belongs to no frame


class MeasurementVerdict(Message, frozen=True, kw_only=True):
    """Result of the checks of one measurement. Every rejection has one (law 3); of heights and headings only those."""

    frame_id: int  # -1: not related to a frame
    # From the estimator "odometry", "link" (odometry with one more keyframe), "map", "relocalization", "attitude" (the
    # reported heading), "height", "airspeed", "dead_reckoning", "start", "reset" (of the graph), "user_fix"; from the
    # link "estimate", "telemetry", "wall clock"
    measurement: str
    verdict: Verdict
    detail: str = ""
    mahalanobis2: float | None = None  # squared Mahalanobis distance of the innovation
    # Measured less predicted. "map": GTSAM Pose3 tangent (rotation [rad], then translation [m], axes of the camera);
    # while the heading is unknown, and of "start", "dead_reckoning": east and north [m]. Others: units of the
    # measurement.
    innovation: tuple[float, ...] = ()
    innovation_variance: tuple[float, ...] = ()  # of each component, measurement and prediction together
    test_ratio: float | None = None  # mahalanobis2 over the limit of its gate: above 1 it is rejected
    fragment_id: int = -1  # "odometry", "map", "relocalization": fragment of the frame (as in Odometry); -1: none
    joined: bool = True  # ... is joined to the flight (as in Prediction), with this measurement


# --- link -----------------------------------------------------------------------------------------


NO_FIX, FIX_2D, FIX_3D = 1, 2, 3  # GPS_FIX_TYPE of MAVLink's common.xml


class GpsInput(Message, frozen=True, kw_only=True):
    """The GPS_INPUT message (MAVLink 232) as sent to the autopilot, in SI units."""

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
    estimate_age_ms: float  # age of the estimate that was propagated to this time; -1: none
    degradation: int = 0  # level: 1, 2, 3 from 5, 15, 35 s without a map fix
    unanchored_s: float | None = None  # seconds since the last map fix; None: no estimate accepted yet
    map_offset_m: tuple[float, float] = (0.0, 0.0)  # east, north: subtracted error of the map (MapOffset)
    no_fix_reason: str = ""  # of a fix_type other than 3
    resets: int = 0  # accepted jumps of the estimate since the start of the link: reset_counter of ODOMETRY


class LinkStatus(Message, frozen=True, kw_only=True):
    """State of the MAVLink connection, at 1 Hz."""

    connected: bool
    autopilot: str  # "ardupilot", "px4", "none", ...
    sysid: int
    sent: int
    received: int
    bad: int  # bytes that are not part of a valid packet
    refused: int = 0  # packets without the required signature
    time_offset_ms: float | None
    detail: str = ""


class ServedVehicle(Message, frozen=True, kw_only=True):
    """Which autopilot the link serves; at every change, and at 1 Hz.

    ``candidates``: not empty: any of these system ids may be the vehicle that carries the camera. Until a CameraVehicle
    says which, no position leaves and no telemetry is used."""

    sysid: int  # 0: none yet
    confirmed: bool  # it turns as the camera does, or link.autopilot_sysid names it
    candidates: list[int] = []


class CandidateAttitude(Message, frozen=True, kw_only=True):
    """Attitude of one of the candidates of ServedVehicle, as in VehicleState."""

    sysid: int
    yaw_rad: float
    pitch_rad: float
    roll_rad: float


class CameraVehicle(Message, frozen=True, kw_only=True):
    """The vehicle that carries the camera: its attitude turns as the images do.

    ``evidence``: log of the likelihood ratio "turns as the images do" over "turns independently", by system id."""

    sysid: int
    evidence: dict[int, float] = {}


class GnssReading(Message, frozen=True, kw_only=True):
    """Position report of a GNSS receiver of the autopilot, at its arrival; monitored only, not fused in flight."""

    receiver: int  # 0 is the autopilot's GPS1
    fix_type: int  # GPS_FIX_TYPE: 3 is 3D
    lat_deg: float | None  # None: no position
    lon_deg: float | None
    horizontal_m: float | None  # 1-sigma that the receiver reports
    speed_mps: float | None
    satellites: int | None


class GnssInitialPosition(Message, frozen=True, kw_only=True):
    """Position of the vehicle before take-off from a GNSS receiver, until arming; repeated once a second.

    ``t_ns`` is that of the reading, also in its repetitions. Without coordinates (None) the previous one is
    withdrawn."""

    lat_deg: float | None
    lon_deg: float | None
    sigma_m: float | None  # 1-sigma per horizontal axis
    receiver: int  # 0 is the autopilot's GPS1


class GnssState(StrEnum):
    UNKNOWN = "unknown"  # no position to compare with yet
    TRUSTED = "trusted"  # has agreed with the map for long enough
    LOST = "lost"  # no fix, no messages, or a reported accuracy too low for use
    SPOOFED = "spoofed"  # reports an impossible position
    DISPUTED = "disputed"  # disagrees, but since a jump of our own estimate


class GnssVerdict(Message, frozen=True, kw_only=True):
    """Assessment of a GNSS receiver, on every change and once a second."""

    receiver: int
    state: GnssState
    distance_m: float | None  # from our estimate
    sigmas: float | None  # the distance in standard deviations of both reported covariances
    reason: str = ""


class MapOffset(Message, frozen=True, kw_only=True):
    """Registration error of the map, estimated from a trusted GNSS receiver, on every change.

    ``t_ns``: time of the estimate."""

    map_sigma_m: float  # identifies the map: its stated error, 1-sigma per horizontal axis
    lat_deg: float  # position of the last update
    lon_deg: float
    # Error of the map east and north [m], of the receiver [m], latency of its readings less the assumed latency [s]
    state: tuple[float, ...]
    cov: tuple[float, ...]  # 5x5, row-major


class PositionSource(Message, frozen=True, kw_only=True):
    """Command to the autopilot to navigate by Terrafix (``vision``), or by what it had before, with its GNSS
    ``receiver``, again."""

    vision: bool
    receiver: int
    fallback: bool = True  # the autopilot may use its receiver while Terrafix sends no 3D fix


class EkfStatus(Message, frozen=True, kw_only=True):
    """Status of the autopilot's EKF (EKF_STATUS_REPORT, PX4: ESTIMATOR_STATUS), which shows whether it fuses our
    position."""

    flags: int  # EKF_STATUS_FLAGS
    position_ratio: float  # horizontal innovation over its gate (test ratio): 1 is the limit
    velocity_ratio: float
    lat_deg: float | None = None  # its own horizontal position, not more than a second old; None: it reports none
    lon_deg: float | None = None


class WallClock(Message, frozen=True, kw_only=True):
    """Unix time at ``t_ns`` from the edge of the link, for the GPS week. ``unix_ns`` None: no clock is plausible."""

    unix_ns: int | None
    source: str  # "system", "autopilot", "none"


class StatusText(Message, frozen=True, kw_only=True):
    """A text for the pilot's display, sent as MAVLink STATUSTEXT (253)."""

    severity: int  # MAV_SEVERITY: 2 critical, 4 warning, 5 notice, 6 info
    text: str  # at most 50 characters


# --- health and the shell -------------------------------------------------------------------------


class TemperatureZone(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    temperature_c: float


class ProcessorClock(msgspec.Struct, frozen=True, kw_only=True):
    """Clock of a group of CPU cores ("policy0") or of another processor (devfreq: "17000000.gpu")."""

    name: str
    mhz: float  # at present; a governor lowers it when the processor is idle
    limit_mhz: float  # highest clock that power mode and thermal governor allow at present
    max_mhz: float  # highest clock of the hardware


class PowerRail(msgspec.Struct, frozen=True, kw_only=True):
    name: str  # label of the channel; "VDD_IN" on a Jetson is the whole module
    power_w: float


class Fan(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    rpm: int


class ThermalReading(Message, frozen=True, kw_only=True):
    """Raw readings of the computer's sensors (temperature, clocks, power, load), at 1 Hz; Health is derived from them.

    A sensor that is absent or cannot be read is not in its list."""

    zones: list[TemperatureZone]
    throttling: list[str]  # cooling devices that currently throttle a processor
    disk_free_mb: int | None
    clocks: list[ProcessorClock] = []
    rails: list[PowerRail] = []
    fans: list[Fan] = []
    power_mode: str | None = None  # of nvpmodel: "2 (15W)", or "2" when its name is not known; None: no Jetson
    # Share since the reading before: of all cores ("all"), and of one core by process of this run ("vision")
    cpu_load: dict[str, float] = {}


class Health(Message, frozen=True, kw_only=True):
    """Temperature, throttling and free disk space of the computer, at 1 Hz."""

    band: ThermalBand
    temperature_c: float | None  # hottest zone; None: no readable zone
    throttled: bool
    disk_free_mb: int | None
    cause: str  # reason of the band
    power_w: float | None = None  # of the whole computer; None: no rail measures it
    clock_limit: float | None = None  # lowest ratio of limit_mhz and max_mhz over the processors; None: not readable
    clock_mhz: float | None = None  # ... and limit_mhz of that processor


class FrameRate(Message, frozen=True, kw_only=True):
    """Frames a second that a source in real time offers, and that are taken from it: at each change, and at 1 Hz."""

    offered_hz: float
    taken_hz: float  # fewer in a hot computer, and in one that is too slow
    every: int  # one of so many is taken, where the computer is too slow for more
    computer_too_slow: bool


class ProcessEvent(Message, frozen=True, kw_only=True):
    """A process started, died, was restarted or given up; published by the supervisor."""

    process: str
    event: str  # "started", "died", "stuck", "restarted", "gave_up", "stopped", "adopted"
    detail: str = ""


class InputOrder(Message, frozen=True, kw_only=True):
    """Messages in the order in which ``process`` handled them, by which its record is replayed to the same outputs.

    The bus delivers each publisher's messages in order, but not those of two publishers, and the recorder receives them
    in an order of its own. Published by the shell of the process before the outputs of the last of them."""

    process: str
    began_ns: int  # time of the start of this instance of the process: another one means that it was restarted
    inputs: list[int]  # CRC-32 of each message in msgpack (terrafix.core.codec)


class Dropped(Message, frozen=True, kw_only=True):
    """Messages lost to a queue overflow; published by the shell of a process."""

    process: str
    message: str
    count: int


class LogLine(Message, frozen=True, kw_only=True):
    """A line of the log of a process that no other message says (core/log_lines.py); published by its shell."""

    process: str
    level: str  # "error", "warning", "info", "debug"
    event: str
    fields: dict[str, str | int | float | bool | None] = {}


ALL_MESSAGES: tuple[type[Message], ...] = tuple(Message.__subclasses__())  # of this module
AnyMessage: Any = functools.reduce(operator.or_, ALL_MESSAGES)  # their union, for decoders
