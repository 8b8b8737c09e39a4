"""Bodies of the requests and answers of the console: the contract of docs/console.md, and its OpenAPI file."""

from enum import StrEnum
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

MAX_NAME = 100  # characters of a name [spec: docs/console.md]
MIN_IMAGE_PX, MAX_IMAGE_PX = (640, 480), (6252, 4168)  # width, height [spec: RS-11 of the service contract]
MAX_WAYPOINTS = 500  # of an area [spec: docs/console.md]
MAX_PIXELS = 50  # of one object [spec: docs/console.md]

Latitude = Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
Longitude = Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)]
Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
FrameId = Annotated[int, Field(ge=0, le=2**53 - 1)]


class Strict(BaseModel):
    """Body of a request: an unknown field is an error."""

    model_config = ConfigDict(extra="forbid")


class Gps(BaseModel):
    """WGS84, degrees."""

    lat: Latitude
    lon: Longitude


class Ellipse(BaseModel):
    """The ellipse that contains the position with 95 %: half axes [m], bearing of the longer one from true north."""

    semi_major_m: float
    semi_minor_m: float
    bearing_deg: float


class CameraPose(BaseModel):
    """A camera, beside its position. ``frame_uid``: unique over all flights. The others are refined; None: not refined.
    ``orientation``: quaternion w, x, y, z in east, north, up; ``covariance``: 36 numbers, row by row, of position [m],
    then rotation [rad] about east, north, up; ``m_per_unit``: metres of a unit of odometry in the submap of the
    frame."""

    frame_uid: str = ""
    orientation: list[float] | None = None
    covariance: list[float] | None = None
    m_per_unit: float | None = None


class FlightState(StrEnum):
    PROCESSING = "processing"
    RECOVERING = "recovering"  # lost: a search is active
    BLOCKED = "blocked"  # a user fix or a coarse hint is needed, or the map of the flight could not be made
    COMPLETED = "completed"


class FlightKind(StrEnum):
    BATCH = "batch"  # images come over HTTP
    LIVE = "live"  # a Terrafix that runs on this computer


class Camera(Strict):
    """Pinhole camera, in pixels of the uploaded images. Give ``fx`` (``fy`` equal to it by default) or
    ``focal_mm`` and ``sensor_width_mm``."""

    width: Annotated[int, Field(ge=MIN_IMAGE_PX[0], le=MAX_IMAGE_PX[0])]
    height: Annotated[int, Field(ge=MIN_IMAGE_PX[1], le=MAX_IMAGE_PX[1])]
    fx: Positive | None = None
    fy: Positive | None = None
    cx: Number | None = None
    cy: Number | None = None
    focal_mm: Positive | None = None
    sensor_width_mm: Positive | None = None
    distortion: Annotated[list[Number], Field(max_length=14)] = []
    focal_sigma: Annotated[float, Field(gt=0, le=0.5)] | None = None

    @model_validator(mode="after")
    def _has_one_focal_length(self) -> "Camera":
        in_mm = self.focal_mm is not None and self.sensor_width_mm is not None
        if (self.fx is None) == (not in_mm):
            raise ValueError("give fx, or focal_mm and sensor_width_mm")
        return self


class Mount(Strict):
    """Camera in the body, as [mount] of a flight folder: straight down with the image top forward by default."""

    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = -90.0
    roll_deg: Degrees = 0.0
    tolerance_deg: Annotated[float, Field(gt=0, le=90)] = 5.0


class Start(Strict):
    """Where the flight starts, with its 1-sigma per horizontal axis."""

    lat: Latitude
    lon: Longitude
    sigma_m: Annotated[float, Field(gt=0, le=100_000)] = 10.0
    ground_amsl_m: Annotated[float, Field(ge=-500, le=9000)] | None = None


class Telemetry(Strict):
    """1-sigma of the headings, heights and attitudes of the images, as [telemetry] of a flight folder.
    ``attitude_sigma_deg`` None: that of what states them, photos or a table."""

    yaw_sigma_deg: Annotated[float, Field(gt=0, le=360)] = 5.0
    agl_sigma_m: Annotated[float, Field(gt=0, le=10_000)] = 5.0
    attitude_sigma_deg: Annotated[float, Field(gt=0, le=180)] | None = None


class Waypoint(Strict):
    lat: Latitude
    lon: Longitude


class RouteArea(Strict):
    """The route of the flight, whose corridor is fetched from the map sources of the service in the background."""

    waypoints: Annotated[list[Waypoint], Field(min_length=2, max_length=MAX_WAYPOINTS)]
    corridor_m: Annotated[float, Field(ge=100, le=20_000)] = 1000.0  # to either side of the route


class NewFlight(Strict):
    """``map``: name of a map of the service, or ``area``. ``height_m``: above ground, and ``yaw_deg``: heading, for
    images that state none; for all with ``override``. ``images``: how many the flight has; when they are computed it
    completes by itself, or asks for a position. Without ``start`` the first position is searched on the whole map."""

    name: Annotated[str, Field(max_length=MAX_NAME)] = ""
    camera: Camera
    mount: Mount = Mount()
    telemetry: Telemetry = Telemetry()
    start: Start | None = None
    map: Annotated[str, Field(min_length=1, max_length=MAX_NAME)] | None = None
    area: RouteArea | None = None
    height_m: Annotated[float, Field(gt=0, le=20_000)] | None = None
    yaw_deg: Degrees | None = None
    override: bool = False
    images: Annotated[int, Field(ge=1, le=20_000)] | None = None

    @model_validator(mode="after")
    def _has_one_map(self) -> "NewFlight":
        if (self.map is None) == (self.area is None):
            raise ValueError("give either map or area")
        return self


class PhotoFact(BaseModel):
    """``topic``: lens, mount, start, height, clock, ...; ``text``: what, and from where."""

    topic: str
    text: str


class PhotoFacts(BaseModel):
    """What photos state of a flight, with a flight.toml beside them, as `terrafix replay` takes it. ``camera`` None: no
    photo states its focal length, ``problem`` says why. ``height_m``, ``yaw_deg``: of the first photo."""

    width: int
    height: int
    camera: Camera | None
    mount: Mount
    telemetry: Telemetry
    start: Start | None
    height_m: float | None
    yaw_deg: float | None
    name: str
    map: str  # stem of the one that flight.toml names
    facts: list[PhotoFact]
    problem: str = ""


class MapState(StrEnum):
    READY = "ready"
    PREPARING = "preparing"  # the corridor is being fetched
    FAILED = "failed"


class FlightMap(BaseModel):
    name: str
    state: MapState
    detail: str = ""  # why it failed


class Images(BaseModel):
    """``expected``: how many the flight has, as far as its creation said it; ``last_name``: of the newest image."""

    uploaded: int
    processed: int
    expected: int | None = None
    last_name: str | None = None


class FragmentState(StrEnum):
    UNANCHORED = "unanchored"  # by dead reckoning alone
    MATCHING = "matching"  # ... and a search is active, or it has enough frames to be matched as a whole
    ANCHORED = "anchored"  # a map match of its own is accepted
    MERGED = "merged"  # tied to the flight before it


class Fragment(BaseModel):
    """Frames that odometry connects to each other (a chunk)."""

    fragment_id: int
    first_frame: int
    last_frame: int
    frames: int
    joined: bool  # tied to the flight by something other than dead reckoning
    merged_at_frame: int | None = None
    state: FragmentState = FragmentState.UNANCHORED


class InputRequest(BaseModel):
    """A request for a user fix that is open."""

    request_id: str
    frame_id: int


class WholeVerdict(BaseModel):
    """On a completed flight, as summary.json has it. ``trusted_s``: from and to, seconds; ``trusted_files``: first and
    last image of each of these spans; ``reasons``: why the rest cannot be trusted; ``cause``: the likely one."""

    verdict: str  # "trust it", "trust it in part", "do not trust it"
    trusted_s: list[tuple[float, float]]
    trusted_files: list[tuple[str, str]]
    trusted_share: float
    reasons: list[str]
    cause: str = ""


class Flight(BaseModel):
    """``start``: that of its creation, or of the source of a live flight. ``verdict``: None before its end."""

    flight_id: str
    name: str
    kind: FlightKind
    state: FlightState
    created_at: str  # UTC, ISO 8601
    completing: bool  # completion was requested
    map: FlightMap
    start: Start | None
    images: Images
    fragments: list[Fragment]
    request: InputRequest | None
    verdict: WholeVerdict | None = None
    events_url: str
    last_event_id: int
    error: str = ""  # why the flight cannot be processed


class FlightConfig(BaseModel):
    """``flight``: as it was created, with defaults; empty for a live one, whose record has all of it. ``config``: the
    effective configuration."""

    flight_id: str
    map: str
    flight: dict[str, Any]
    config: dict[str, Any]


class Flights(BaseModel):
    flights: list[Flight]


class Accepted(BaseModel):
    """Images of a batch with the frames that they became. ``repeated``: the batch was uploaded before."""

    frames: list[int]
    repeated: bool


class FrameResult(CameraPose):
    """Position of one frame. ``gps`` is None until the frame has one; ``confidence``: the probability that the position
    is within 20 m, by its covariance."""

    frame_id: int
    file: str
    t_s: float
    gps: Gps | None = None
    altitude: float | None = None  # m AMSL
    agl_m: float | None = None
    heading: float | None = None  # degrees, clockwise from true north
    heading_sigma: float | None = None  # 1-sigma, degrees
    confidence: float | None = None
    ellipse: Ellipse | None = None
    source: str = ""  # "satellite_anchored", "visual_propagated", "dead_reckoned", "not_placed"
    match: str = ""  # verdict of the map match
    inliers: int = 0
    search: str = "normal"  # step of the search
    fragment_id: int = -1
    joined: bool = True
    error: str = ""  # why the image could not be used
    refined: bool = False  # gps, altitude, ellipse and the pose are the refined ones
    refined_by: str = ""  # "smoother", "flight", "finalised"; as in FrameRefined


class Results(BaseModel):
    """``next_from``: where the next page begins; None: this is the last one."""

    flight_id: str
    refined: bool
    results: list[FrameResult]
    next_from: int | None


class PixelPoint(Strict):
    """u to the right and v down, in pixels of the stored frame, from 0."""

    u: Annotated[float, Field(ge=-0.5, le=65_535)]
    v: Annotated[float, Field(ge=-0.5, le=65_535)]


class UserFix(Strict):
    """A pixel of a frame and the place on the map that it shows, with its 1-sigma per axis."""

    frame_id: FrameId
    pixel: PixelPoint
    lat: Latitude
    lon: Longitude
    sigma_m: Annotated[float, Field(ge=0.1, le=1000)] = 5.0


class Hint(Strict):
    """A place and the radius that contains the vehicle with 95 %."""

    lat: Latitude
    lon: Longitude
    radius_m: Annotated[float, Field(ge=100, le=100_000)] = 5000.0


class Steered(BaseModel):
    """``hint_id`` of what the flight will use; ``detail``: what came of it, as far as it is known at once."""

    hint_id: int
    detail: str


class OtherPixel(Strict):
    """A pixel of another frame."""

    frame_id: FrameId
    pixel_x: Annotated[float, Field(ge=-0.5, le=65_535)]
    pixel_y: Annotated[float, Field(ge=-0.5, le=65_535)]


class ObjectPixel(Strict):
    """``others``: the same object in further frames."""

    pixel_x: Annotated[float, Field(ge=-0.5, le=65_535)]
    pixel_y: Annotated[float, Field(ge=-0.5, le=65_535)]
    others: Annotated[list[OtherPixel], Field(max_length=MAX_PIXELS)] = []


class ObjectGps(BaseModel):
    """``accuracy_meters``: radius that contains the object with 95 %."""

    gps: Gps
    accuracy_meters: float
    altitude: float | None  # m AMSL; None: no height above sea level is known
    surface: str  # "points" (of odometry), "elevation" (of the map), "plane"
    consistent: bool = True  # all pixels show one object


class Tokens(Strict):
    token: Annotated[str, Field(min_length=1, max_length=200)]


class Role(StrEnum):
    VIEWER = "viewer"
    OPERATOR = "operator"


class Session(BaseModel):
    """``required``: whether this service asks for a token; ``role``: None without a valid one."""

    required: bool
    role: Role | None


class MapInfo(BaseModel):
    """``bounds``: west, south, east, north in degrees; ``max_zoom``: of the tiles."""

    name: str
    bounds: tuple[float, float, float, float]
    min_zoom: int
    max_zoom: int
    gsd_m: float
    date: str
    source: str
    licence: str
    has_dem: bool
    tiles_url: str


class Maps(BaseModel):
    maps: list[MapInfo]


class RecordingFile(BaseModel):
    name: str
    bytes: int
    url: str


class Recordings(BaseModel):
    files: list[RecordingFile]


class ExportChoice(BaseModel):
    """What a flight can be exported as, and which positions it has, the best first."""

    formats: list[str]
    which: list[str]


class ServiceHealth(BaseModel):
    """``workers``: flights that are computed now; ``waiting``: flights that wait for one of ``max_workers``."""

    status: str  # "ok", "stopping"
    version: str
    workers: int
    max_workers: int
    waiting: int
    flights: int
    event_clients: int
    disk_free_mb: int
    live: dict[str, Any] | None = None  # the facts of `terrafix status --json`, with --bus


class Problem(BaseModel):
    """RFC 9457, application/problem+json."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    errors: list[dict[str, Any]] = []  # of a body: where and what
