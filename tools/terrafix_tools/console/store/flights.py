"""Flights in the database. Every function takes the connection of a transaction of ``Database``."""

import json
import re
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise

import sqlalchemy as sa
from sqlalchemy.dialects.sqlite import insert

from terrafix_tools.console.areas import map_name
from terrafix_tools.console.compute.observed import FrameOutcome
from terrafix_tools.console.events import Event, FlightCompleted, StateChanged, name_of
from terrafix_tools.console.payloads import (
    Accepted,
    Flight,
    FlightKind,
    FlightMap,
    FlightState,
    Fragment,
    FrameResult,
    Hint,
    Images,
    InputRequest,
    MapState,
    NewFlight,
    RouteArea,
    UserFix,
    WholeVerdict,
)
from terrafix_tools.console.problems import Refusal
from terrafix_tools.console.store.schema import events, flights, fragments, headings, hints, images, results

EVENT_PAGE = 500  # events that are read at once [spec: about 200 kB]
REFINED_KEYS = ("gps", "altitude", "ellipse", "orientation", "covariance", "m_per_unit")  # of a result
_DIGITS = re.compile(r"([0-9]+)")


@dataclass(frozen=True)
class StoredImage:
    """An uploaded image. ``stored``: its file below the folder of the flight; ``state``: VehicleState in JSON."""

    frame_id: int
    name: str
    stored: str
    bytes: int
    sha256: str
    t_ns: int
    state: str | None
    attempts: int = 0


@dataclass(frozen=True)
class StoredEvent:
    event_id: int
    name: str
    data: str  # JSON


def order_of(name: str) -> tuple[list[str | int], str]:
    """Key of a name by which IMG_9 comes before IMG_10."""
    return [int(part) if i % 2 else part for i, part in enumerate(_DIGITS.split(name))], name


def create(db: sa.Connection, new: NewFlight) -> Flight:
    """A new flight; its map is made if it has an area."""
    flight_id = str(uuid.uuid4())
    row = {
        "id": flight_id,
        "name": new.name or flight_id,
        "kind": FlightKind.BATCH.value,
        "state": FlightState.PROCESSING.value,
        "created_at": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "spec": new.model_dump_json(),
        "map_name": new.map if new.map is not None else map_name(flight_id),
        "map_state": (MapState.READY if new.map is not None else MapState.PREPARING).value,
        "map_detail": "",
        "completing": False,
        "error": "",
    }
    db.execute(flights.insert().values(row))
    return flight_of(db, flight_id)


def create_live(db: sa.Connection, flight_id: str, *, name: str, map_name: str, created_at: str) -> None:
    """A flight of a Terrafix on this computer; nothing if it is there already."""
    row = {
        "id": flight_id,
        "name": name,
        "kind": FlightKind.LIVE.value,
        "state": FlightState.PROCESSING.value,
        "created_at": created_at,
        "spec": "{}",
        "map_name": map_name,
        "map_state": MapState.READY.value,
        "map_detail": "",
        "completing": False,
        "error": "",
    }
    db.execute(insert(flights).values(row).on_conflict_do_nothing())


def unfinished_live(db: sa.Connection) -> set[str]:
    """Ids of the live flights whose end is not stored."""
    of = flights.c.kind == FlightKind.LIVE.value, flights.c.state != FlightState.COMPLETED.value
    return set(db.execute(sa.select(flights.c.id).where(*of)).scalars())


def complete(db: sa.Connection, flight_id: str, completed: FlightCompleted) -> None:
    """The flight is over: its last events, and its state."""
    previous = FlightState(row_of(db, flight_id).state)
    changed = StateChanged(state=FlightState.COMPLETED, previous=previous)
    add_events(db, flight_id, "completed", [completed, changed])
    update(db, flight_id, state=FlightState.COMPLETED.value, request=None)


def maps_to_make(db: sa.Connection) -> list[tuple[str, RouteArea]]:
    """The flights whose maps are not made yet."""
    rows = db.execute(sa.select(flights.c.id, flights.c.spec).where(flights.c.map_state == MapState.PREPARING.value))
    specs = [(row.id, NewFlight.model_validate_json(row.spec).area) for row in rows]
    return [(flight_id, area) for flight_id, area in specs if area is not None]


def count(db: sa.Connection) -> int:
    return int(db.execute(sa.select(sa.func.count()).select_from(flights)).scalar_one())


def row_of(db: sa.Connection, flight_id: str) -> "sa.Row":
    """Raises Refusal (404)."""
    row = db.execute(sa.select(flights).where(flights.c.id == flight_id)).one_or_none()
    if row is None:
        raise Refusal(404, f"there is no flight {flight_id[:40]!r}; GET /flights lists them")
    return row


def flight_of(db: sa.Connection, flight_id: str) -> Flight:
    return _flight(db, row_of(db, flight_id))


def all_flights(db: sa.Connection) -> list[Flight]:
    """The newest first."""
    rows = db.execute(sa.select(flights).order_by(flights.c.created_at.desc(), flights.c.id)).all()
    return [_flight(db, row) for row in rows]


def _flight(db: sa.Connection, row: "sa.Row") -> Flight:
    uploaded = _count(db, images, row.id)
    found = db.execute(
        sa.select(fragments).where(fragments.c.flight_id == row.id).order_by(fragments.c.fragment_id)
    ).all()
    spec = json.loads(row.spec)
    return Flight(
        flight_id=row.id,
        name=row.name,
        kind=FlightKind(row.kind),
        state=FlightState(row.state),
        created_at=row.created_at,
        completing=row.completing,
        map=FlightMap(name=row.map_name, state=MapState(row.map_state), detail=row.map_detail),
        start=spec.get("start"),
        images=Images(
            uploaded=uploaded,
            processed=_count(db, results, row.id),
            expected=spec.get("images"),
            last_name=last_name(db, row.id),
        ),
        fragments=[Fragment(**{k: v for k, v in f._mapping.items() if k != "flight_id"}) for f in found],
        request=None if row.request is None else InputRequest.model_validate_json(row.request),
        verdict=_verdict(db, row.id) if row.state == FlightState.COMPLETED.value else None,
        events_url=f"/flights/{row.id}/events",
        last_event_id=last_event_id(db, row.id),
        error=row.error,
    )


def _verdict(db: sa.Connection, flight_id: str) -> WholeVerdict | None:
    """On a completed flight; None: it was completed by an earlier version, or while no service saw it."""
    query = sa.select(events.c.data).where(events.c.flight_id == flight_id, events.c.key == "completed 0")
    data = db.execute(query).scalar_one_or_none()
    given = None if data is None else json.loads(data).get("verdict")
    return None if given is None else WholeVerdict.model_validate(given)


def _count(db: sa.Connection, table: sa.Table, flight_id: str) -> int:
    query = sa.select(sa.func.count()).select_from(table).where(table.c.flight_id == flight_id)
    return int(db.execute(query).scalar_one())


def update(db: sa.Connection, flight_id: str, **values: object) -> None:
    db.execute(flights.update().where(flights.c.id == flight_id).values(**values))


def delete(db: sa.Connection, flight_id: str) -> None:
    """With all that belongs to it (ON DELETE CASCADE)."""
    row_of(db, flight_id)
    db.execute(flights.delete().where(flights.c.id == flight_id))


# --- images ---------------------------------------------------------------------------------------


def image_count(db: sa.Connection, flight_id: str) -> int:
    return _count(db, images, flight_id)


def images_of(db: sa.Connection, flight_id: str, first: int, most: int = 1000) -> list[StoredImage]:
    """The images from frame ``first`` on."""
    query = sa.select(images).where(images.c.flight_id == flight_id, images.c.frame_id >= first)
    rows = db.execute(query.order_by(images.c.frame_id).limit(most)).all()
    return [StoredImage(**{k: v for k, v in row._mapping.items() if k != "flight_id"}) for row in rows]


def image_of(db: sa.Connection, flight_id: str, frame_id: int) -> StoredImage:
    """Raises Refusal (404)."""
    found = images_of(db, flight_id, frame_id, 1)
    if not found or found[0].frame_id != frame_id:
        raise Refusal(404, f"flight {flight_id} has no frame {frame_id}")
    return found[0]


def repeated_batch(db: sa.Connection, flight_id: str, sums: list[tuple[str, str]]) -> list[int] | None:
    """The frames of a batch of (name, sha256) that was uploaded before; None: it is new. Raises Refusal (409): a part
    of it was, or other images by these names."""
    names = [name for name, _ in sums]
    rows = db.execute(
        sa.select(images.c.frame_id, images.c.name, images.c.sha256).where(
            images.c.flight_id == flight_id, images.c.name.in_(names)
        )
    ).all()
    if not rows:
        return None
    stored = {row.name: (row.frame_id, row.sha256) for row in rows}
    for name, digest in sums:
        if name not in stored or stored[name][1] != digest:
            what = "was not uploaded before, others of its batch were" if name not in stored else "is another image"
            raise Refusal(409, f"{name}: {what}; a batch is repeated as a whole, or not at all")
    return [stored[name][0] for name in names]


def last_name(db: sa.Connection, flight_id: str) -> str | None:
    """Of the newest image."""
    query = sa.select(images.c.name).where(images.c.flight_id == flight_id)
    return db.execute(query.order_by(images.c.frame_id.desc()).limit(1)).scalar_one_or_none()


def check_order(last: str | None, names: list[str]) -> None:
    """Raises Refusal: names are not in their order, after that of the newest image. Gaps between numbers are normal."""
    for before, name in pairwise([last, *names]):
        if before is not None and name is not None and not order_of(before) < order_of(name):
            raise Refusal(409, f"{name} does not come after {before}; images come in the order of their names")


def add_images(db: sa.Connection, flight_id: str, batch: Iterable[StoredImage]) -> Accepted:
    rows = [{"flight_id": flight_id, **vars(image)} for image in batch]
    db.execute(images.insert(), rows)
    return Accepted(frames=[row["frame_id"] for row in rows], repeated=False)


def count_attempt(db: sa.Connection, flight_id: str, frame_id: int) -> None:
    """One more process has died at this image."""
    db.execute(
        images.update()
        .where(images.c.flight_id == flight_id, images.c.frame_id == frame_id)
        .values(attempts=images.c.attempts + 1)
    )


def retry(db: sa.Connection, flight_id: str) -> Flight:
    """A flight that could not go on goes on: its map is fetched again, its images are read again."""
    row = row_of(db, flight_id)
    if not row.error:
        raise Refusal(409, "nothing has failed; POST /flights/{id}/copy computes a flight again")
    db.execute(images.update().where(images.c.flight_id == flight_id).values(attempts=0))
    failed = row.map_state == MapState.FAILED.value
    update(
        db,
        flight_id,
        error="",
        state=FlightState.PROCESSING.value,
        map_state=MapState.PREPARING.value if failed else row.map_state,
    )
    changed = StateChanged(state=FlightState.PROCESSING, previous=FlightState(row.state))
    add_events(db, flight_id, f"retry {last_event_id(db, flight_id)}", [changed])
    return flight_of(db, flight_id)


# --- results --------------------------------------------------------------------------------------


def results_of(db: sa.Connection, flight_id: str, *, refined: bool, first: int, most: int) -> list[FrameResult]:
    """From frame ``first`` on; with ``refined`` the newest position of each frame."""
    query = sa.select(results).where(results.c.flight_id == flight_id, results.c.frame_id >= first)
    found = []
    for row in db.execute(query.order_by(results.c.frame_id).limit(most)):
        result = FrameResult.model_validate_json(row.immediate)
        if refined and row.refined is not None:
            newer = json.loads(row.refined)
            changed = {key: newer[key] for key in REFINED_KEYS if key in newer}  # one of an earlier version has fewer
            changed |= {"refined": True, "refined_by": newer["source"]}
            result = FrameResult.model_validate({**result.model_dump(), **changed})
        found.append(result)
    return found


def result_count(db: sa.Connection, flight_id: str) -> int:
    return _count(db, results, flight_id)


def has_result(db: sa.Connection, flight_id: str, frame_id: int) -> bool:
    of_frame = results.c.flight_id == flight_id, results.c.frame_id == frame_id
    return db.execute(sa.select(results.c.frame_id).where(*of_frame)).first() is not None


def store_outcome(db: sa.Connection, flight_id: str, step: str, outcome: FrameOutcome) -> None:
    """Everything that one step of a flight adds. ``step``: its name, once in a flight."""
    if outcome.result is not None:
        _put(db, results, flight_id, frame_id=outcome.result.frame_id, immediate=outcome.result.model_dump_json())
        if outcome.heading is not None:
            heading_deg, sigma_deg = outcome.heading
            _put(
                db, headings, flight_id, frame_id=outcome.result.frame_id, heading_deg=heading_deg, sigma_deg=sigma_deg
            )
    if outcome.fragment is not None:
        _put(db, fragments, flight_id, **outcome.fragment.model_dump())
    for refined in outcome.refined:
        of_frame = results.c.flight_id == flight_id, results.c.frame_id == refined.frame_id
        db.execute(results.update().where(*of_frame).values(refined=refined.model_dump_json()))
    add_events(db, flight_id, step, outcome.events)
    request = None if outcome.request is None else outcome.request.model_dump_json()
    update(db, flight_id, state=outcome.state.value, request=request)


def _put(db: sa.Connection, table: sa.Table, flight_id: str, **values: object) -> None:
    """Inserts a row, or replaces the one with its key."""
    row = insert(table).values(flight_id=flight_id, **values)
    keys = [column.name for column in table.primary_key]
    db.execute(row.on_conflict_do_update(keys, set_={key: row.excluded[key] for key in values if key not in keys}))


# --- hints ----------------------------------------------------------------------------------------


def add_hint(db: sa.Connection, flight_id: str, given: Hint | UserFix) -> int:
    """-> its id: 1, 2, ... in this flight."""
    hint_id = 1 + _count(db, hints, flight_id)
    db.execute(hints.insert().values(flight_id=flight_id, hint_id=hint_id, given=given.model_dump_json()))
    return hint_id


def has_hints_before(db: sa.Connection, flight_id: str, frame_id: int) -> bool:
    """Whether ``hints_before`` has any."""
    return db.execute(_hints_at(flight_id, frame_id)).first() is not None


def _hints_at(flight_id: str, frame_id: int) -> "sa.Select":
    at = sa.or_(hints.c.before_frame == frame_id, hints.c.before_frame.is_(None))
    return sa.select(hints).where(hints.c.flight_id == flight_id, at).order_by(hints.c.hint_id)


def hints_before(db: sa.Connection, flight_id: str, frame_id: int) -> list[tuple[int, Hint | UserFix]]:
    """The hints to be applied before this frame, with their ids: those of an earlier run at the same frame, then those
    that no run has applied yet, which from now on belong there."""
    rows = db.execute(_hints_at(flight_id, frame_id)).all()
    for row in rows:
        if row.before_frame is None:
            db.execute(
                hints.update()
                .where(hints.c.flight_id == flight_id, hints.c.hint_id == row.hint_id)
                .values(before_frame=frame_id)
            )
    return [(row.hint_id, _given(row.given)) for row in rows]


def copy_hints(db: sa.Connection, flight_id: str, to: str) -> None:
    """A copy gets the hints, each before the frame at which it was applied. One that came after the last image is
    applied before the frame of its pixel, or that of the request."""
    flight = row_of(db, flight_id)
    asked = 0 if flight.request is None else InputRequest.model_validate_json(flight.request).frame_id
    for row in db.execute(sa.select(hints).where(hints.c.flight_id == flight_id)).all():
        given = _given(row.given)
        at = row.before_frame
        if at is None:
            at = given.frame_id if isinstance(given, UserFix) else asked
        db.execute(hints.insert().values(flight_id=to, hint_id=row.hint_id, given=row.given, before_frame=at))


def _given(text: str) -> Hint | UserFix:
    return UserFix.model_validate_json(text) if "pixel" in json.loads(text) else Hint.model_validate_json(text)


# --- events ---------------------------------------------------------------------------------------


def last_event_id(db: sa.Connection, flight_id: str) -> int:
    query = sa.select(sa.func.coalesce(sa.func.max(events.c.event_id), 0)).where(events.c.flight_id == flight_id)
    return int(db.execute(query).scalar_one())


def add_events(db: sa.Connection, flight_id: str, step: str, new: Sequence[Event]) -> None:
    """Appends the events of one step of a flight, with the next ids. ``step``: its name, once in a flight; a step whose
    events are there already, from an earlier computation, is left alone."""
    known = sa.select(events.c.event_id).where(events.c.flight_id == flight_id, events.c.key == f"{step} 0")
    if not new or db.execute(known).first() is not None:
        return
    first = last_event_id(db, flight_id) + 1
    rows = [
        {
            "flight_id": flight_id,
            "event_id": first + index,
            "key": f"{step} {index}",
            "name": name_of(type(event)),
            "data": event.model_dump_json(),
        }
        for index, event in enumerate(new)
    ]
    db.execute(events.insert(), rows)


def forget_events(db: sa.Connection, flight_id: str, most: int) -> None:
    """Deletes all events but the newest ``most``."""
    oldest = last_event_id(db, flight_id) - most
    db.execute(events.delete().where(events.c.flight_id == flight_id, events.c.event_id <= oldest))


def events_after(db: sa.Connection, flight_id: str, after: int, most: int = EVENT_PAGE) -> list[StoredEvent]:
    query = sa.select(events.c.event_id, events.c.name, events.c.data).where(
        events.c.flight_id == flight_id, events.c.event_id > after
    )
    return [StoredEvent(*row) for row in db.execute(query.order_by(events.c.event_id).limit(most))]
