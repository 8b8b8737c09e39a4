"""The paths of the console (docs/console.md)."""

from typing import Annotated, Any

from fastapi import APIRouter, Body, Header, Query, Request, Response
from fastapi import Path as InPath
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, StreamingResponse

from terrafix import __version__
from terrafix_tools.console.guard import COOKIE, token_of
from terrafix_tools.console.payloads import (
    Accepted,
    ExportChoice,
    Flight,
    FlightConfig,
    Flights,
    Hint,
    MapInfo,
    Maps,
    NewFlight,
    ObjectGps,
    ObjectPixel,
    PhotoFacts,
    Problem,
    Recordings,
    Results,
    ServiceHealth,
    Session,
    Steered,
    Tokens,
    UserFix,
)
from terrafix_tools.console.problems import Refusal
from terrafix_tools.console.service import Service
from terrafix_tools.console.store import flights
from terrafix_tools.export.track import BEST
from terrafix_tools.mission.file import mission_text, track_mission

MAX_PAGE = 1000  # results of one answer [spec: docs/console.md]
PROBLEMS: dict[int | str, dict[str, Any]] = {
    "default": {"model": Problem, "description": "Refused", "content": {"application/problem+json": {}}}
}
IMAGE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {}, "image/png": {}}, "description": "The image"}
}

router = APIRouter(responses=PROBLEMS)

FlightId = Annotated[str, InPath(pattern=r"^[a-z0-9-]{1,40}$")]
FrameId = Annotated[int, InPath(ge=0, le=2**53 - 1)]


def service_of(request: Request) -> Service:
    service = request.app.state.service
    assert isinstance(service, Service)
    return service


# --- service --------------------------------------------------------------------------------------


@router.get("/", include_in_schema=False)
def root() -> Response:
    return RedirectResponse("/page/")


@router.get("/health")
def health(request: Request) -> ServiceHealth:
    """The service and, with --bus, the live Terrafix."""
    return service_of(request).health(__version__)


@router.get("/config")
def config(request: Request) -> dict[str, Any]:
    """The effective configuration, read only: of the service (without tokens) and of the flights."""
    return service_of(request).config()


@router.get("/session")
def session(request: Request) -> Session:
    """The role of the token that was sent."""
    access = service_of(request).access
    return Session(required=access.required, role=access.role_of(token_of(request.headers)))


@router.post("/session")
def log_in(request: Request, response: Response, given: Tokens) -> Session:
    """Checks a token and stores it in a cookie, because a browser sends no header with the event stream."""
    access = service_of(request).access
    role = access.role_of(given.token)
    if role is None:
        raise Refusal(401, "no such token")
    if access.required:
        secure = request.url.scheme == "https"
        response.set_cookie(COOKIE, given.token, httponly=True, samesite="strict", secure=secure)
    return Session(required=access.required, role=role)


@router.delete("/session")
def log_out(request: Request, response: Response) -> Session:
    response.delete_cookie(COOKIE)
    return Session(required=service_of(request).access.required, role=None)


# --- flights --------------------------------------------------------------------------------------


@router.post("/flights", status_code=201)
async def create(request: Request, response: Response, new: NewFlight) -> Flight:
    """Creates a flight. With ``area`` its map is made in the background; images may be uploaded meanwhile."""
    flight = await service_of(request).create(new)
    response.headers["Location"] = f"/flights/{flight.flight_id}"
    return flight


@router.get("/flights")
def list_flights(request: Request) -> Flights:
    """All flights, the newest first; live flights before them."""
    return service_of(request).flights()


@router.get("/flights/{flight_id}")
def flight(request: Request, flight_id: FlightId) -> Flight:
    return service_of(request).flight(flight_id)


@router.delete("/flights/{flight_id}", status_code=204)
async def delete(request: Request, flight_id: FlightId) -> Response:
    """With its images, results, events and recordings."""
    await service_of(request).delete(flight_id)
    return Response(status_code=204)


def _form(images: dict[str, Any], **files: str) -> dict[str, Any]:
    """Body of a multipart request: ``images``, with what is said of them, and further ``files`` by name."""
    binary = {"type": "string", "format": "binary"}
    listed = {"type": "array", "maxItems": 50, "items": binary, **images}
    others = {name: {**binary, "description": text} for name, text in files.items()}
    schema = {"type": "object", "required": ["images"], "properties": {"images": listed, **others}}
    return {"requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}}


UPLOAD_BODY = _form(
    {"minItems": 10, "description": "JPEG or PNG, in the order of their names"},
    telemetry="CSV as frames.csv of a flight folder, one row for each image",
)
PHOTOS_BODY = _form({"description": "the first 256 kB of each photo"}, description="flight.toml")


@router.post("/flights/{flight_id}/images/batch", status_code=202, openapi_extra=UPLOAD_BODY)
async def upload(request: Request, flight_id: FlightId) -> Accepted:
    """10 to 50 images, all of them or none. The same batch again gives the same answer."""
    return await service_of(request).upload(request, flight_id)


@router.post("/photos", openapi_extra=PHOTOS_BODY)
async def photos(request: Request) -> PhotoFacts:
    """What photos state of their flight, and where each number comes from: for the form of a new flight."""
    return await service_of(request).photo_facts(request)


@router.post("/flights/{flight_id}/copy", status_code=201)
async def copy(request: Request, flight_id: FlightId, new: NewFlight) -> Flight:
    """A new flight with the images and hints of this one, computed with other settings, or the same again."""
    return await service_of(request).copy(flight_id, new)


@router.post("/flights/{flight_id}/retry", status_code=202)
async def retry(request: Request, flight_id: FlightId, _nothing: Annotated[None, Body()] = None) -> Flight:
    """A flight with an ``error`` goes on: map and images are read again."""
    return await service_of(request).retry(flight_id)


@router.get("/flights/{flight_id}/config")
def flight_config(request: Request, flight_id: FlightId) -> FlightConfig:
    """What a flight was created with, and the configuration that computes it."""
    return service_of(request).flight_config(flight_id)


@router.get("/flights/{flight_id}/results")
def results(
    request: Request,
    flight_id: FlightId,
    refined: Annotated[bool, Query()] = False,
    first: Annotated[int, Query(alias="from", ge=0, le=2**53 - 1)] = 0,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = MAX_PAGE,
) -> Results:
    """Results by frame; with ``refined`` the newest position of each, as later frames have moved it."""
    with service_of(request).database.read() as db:
        flights.row_of(db, flight_id)
        found = flights.results_of(db, flight_id, refined=refined, first=first, most=limit + 1)
    more = found[limit].frame_id if len(found) > limit else None
    return Results(flight_id=flight_id, refined=refined, results=found[:limit], next_from=more)


@router.get("/flights/{flight_id}/waypoints", response_class=PlainTextResponse)
def waypoints(request: Request, flight_id: FlightId) -> PlainTextResponse:
    """The newest position of each frame as a waypoint file (QGC WPL 110), for a ground station."""
    with service_of(request).database.read() as db:
        flights.row_of(db, flight_id)
        found = flights.results_of(db, flight_id, refined=True, first=0, most=-1)
    places = [(result.gps.lat, result.gps.lon, result.altitude) for result in found if result.gps is not None]
    if not places:
        raise Refusal(409, "no frame of this flight has a position yet")
    name = f"{flight_id}.waypoints"
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return PlainTextResponse(mission_text(track_mission(name, places)), headers=headers)


@router.post("/flights/{flight_id}/user-fix", status_code=202)
async def user_fix(request: Request, flight_id: FlightId, fix: UserFix) -> Steered:
    """What a pixel of a frame shows lies there, to 5 m or ``sigma_m``. A measurement of the position, if the gate
    accepts it; the search begins there, if the position is lost or unconfirmed."""
    return await service_of(request).steer(flight_id, fix)


@router.post("/flights/{flight_id}/hint", status_code=202)
async def hint(request: Request, flight_id: FlightId, given: Hint) -> Steered:
    """The vehicle is within this circle, with 95 %."""
    return await service_of(request).steer(flight_id, given)


@router.post("/flights/{flight_id}/frames/{frame_id}/object-to-gps")
async def object_to_gps(request: Request, flight_id: FlightId, frame_id: FrameId, pixel: ObjectPixel) -> ObjectGps:
    """The position of what a pixel of a frame shows."""
    return await service_of(request).locate(flight_id, frame_id, pixel)


@router.get("/flights/{flight_id}/frames/{frame_id}/image", response_class=Response, responses=IMAGE)
def frame_image(request: Request, flight_id: FlightId, frame_id: FrameId) -> Response:
    """The image of a frame, as it was uploaded; of a live flight while it is in memory."""
    return service_of(request).frame_image(flight_id, frame_id)


@router.post("/flights/{flight_id}/complete", status_code=202)
async def complete(request: Request, flight_id: FlightId, _nothing: Annotated[None, Body()] = None) -> Flight:
    """No more images follow: the flight is refined as a whole, then ``flight_completed`` is sent."""
    return await service_of(request).complete(flight_id)


EVENT_STREAM: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {}}, "description": "Server-sent events; docs/console.md has their data"}
}


@router.get("/flights/{flight_id}/events", response_class=StreamingResponse, responses=EVENT_STREAM)
async def events(
    request: Request,
    flight_id: FlightId,
    last_event_id: Annotated[str, Header()] = "",
    after: Annotated[int, Query(ge=0, le=2**53 - 1)] = 0,
) -> Response:
    """The events after ``Last-Event-ID`` (or ``after``), then those to come."""
    begin = int(last_event_id) if last_event_id.isdecimal() and len(last_event_id) < 16 else after
    stream = await service_of(request).events(flight_id, begin)
    return StreamingResponse(stream, media_type="text/event-stream", headers={"x-accel-buffering": "no"})


@router.get("/flights/{flight_id}/recordings")
def recordings(request: Request, flight_id: FlightId) -> Recordings:
    """Files of a flight: its record, estimates and summary; complete when the flight is."""
    return service_of(request).recordings(flight_id)


@router.get("/flights/{flight_id}/recordings/{name}", response_class=FileResponse)
def recording(
    request: Request,
    flight_id: FlightId,
    name: Annotated[str, InPath(pattern=r"^[a-z0-9-]+\.(mcap|csv|json)(\.partial)?$")],
) -> Response:
    path = service_of(request).recording(flight_id, name)
    return FileResponse(path, media_type="application/octet-stream", filename=name)


@router.get("/flights/{flight_id}/exports")
def exports(request: Request, flight_id: FlightId) -> ExportChoice:
    return service_of(request).export_choice(flight_id)


@router.get("/flights/{flight_id}/exports/{kind}", response_class=FileResponse)
async def export(
    request: Request,
    flight_id: FlightId,
    kind: Annotated[str, InPath(pattern=r"^[a-z0-9]{1,20}$")],
    which: Annotated[str, Query(pattern=r"^[a-z]{1,20}$")] = BEST,
) -> Response:
    """The positions for another program, as a file; of formats that are several files a zip file."""
    return await service_of(request).export(flight_id, kind, which)


# --- maps -----------------------------------------------------------------------------------------

MapName = Annotated[str, InPath(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
Zoom = Annotated[int, InPath(ge=0, le=24)]
Index = Annotated[int, InPath(ge=0, le=2**24 - 1)]


@router.get("/maps")
def maps(request: Request) -> Maps:
    return Maps(maps=service_of(request).maps.all())


@router.get("/maps/{name}")
def map_info(request: Request, name: MapName) -> MapInfo:
    return service_of(request).maps.info(name)


@router.get("/maps/{name}/tiles/{z}/{x}/{y}.png", response_class=Response, responses=IMAGE)
def tile(request: Request, name: MapName, z: Zoom, x: Index, y: Index) -> Response:
    """256 x 256 pixels in web mercator, from the imagery of the package; transparent where it has none."""
    png = service_of(request).maps.tile(name, z, x, y)
    return Response(png, media_type="image/png", headers={"cache-control": "private, max-age=3600"})
