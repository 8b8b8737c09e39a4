"""A client of the console: what a program that uploads photos or asks for positions calls.

client = ConsoleClient("http://127.0.0.1:8700")
flight = client.create(NewFlight(camera=Camera(width=1600, height=900, fx=1164.4), map="town", start=...))
client.upload(flight.flight_id, sorted(Path("photos").glob("*.jpg")))
client.complete(flight.flight_id)
for event in client.events(flight.flight_id):
    print(event.event_id, event.name, event.data)
"""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import urllib3
from pydantic import BaseModel

from terrafix.core.errors import LinkError, SourceError, UsageError
from terrafix_tools.console.payloads import (
    Accepted,
    Flight,
    Flights,
    Hint,
    NewFlight,
    ObjectGps,
    ObjectPixel,
    Results,
    Steered,
    UserFix,
)

DEFAULT_URL = "http://127.0.0.1:8700"
BATCH = (10, 50)  # images of one upload [spec: RS-11 of the service contract]
CONNECT_S, ANSWER_S = 5.0, 120.0  # time-outs
SILENCE_S = 45.0  # of an event stream, which sends a comment every 15 s
RETRY_S = 1.0  # before a stream that was cut is opened again
RETRIES = 5  # in a row without an event

T = TypeVar("T", bound=BaseModel)


@dataclass(frozen=True)
class ReceivedEvent:
    """``event_id`` 0: an event that is not stored."""

    event_id: int
    name: str
    data: dict[str, Any]


class ConsoleClient:
    """Methods raise LinkError: no connection; UsageError: the console refuses, with its reason."""

    def __init__(self, url: str = DEFAULT_URL, token: str = "", ca: Path | None = None) -> None:
        """``ca``: certificate of the console, if no authority of this computer has signed it."""
        self.url = url.rstrip("/")
        self._headers = {"authorization": f"Bearer {token}"} if token else {}
        timeout = urllib3.Timeout(connect=CONNECT_S, read=ANSWER_S)
        self._http = urllib3.PoolManager(
            timeout=timeout, retries=False, headers=self._headers, ca_certs=None if ca is None else str(ca)
        )

    def create(self, new: NewFlight) -> Flight:
        return self._post("/flights", new, Flight)

    def flights(self) -> list[Flight]:
        return self._get("/flights", Flights).flights

    def flight(self, flight_id: str) -> Flight:
        return self._get(f"/flights/{flight_id}", Flight)

    def upload(
        self, flight_id: str, images: Sequence[tuple[str, Path]], telemetry: dict[str, str] | None = None
    ) -> Iterator[Accepted]:
        """Uploads images as (name, file) in batches of equal size, and yields the answer to each. ``telemetry``: row of
        each name, with the header below "". Raises SourceError: fewer than ten images, or one cannot be read."""
        for batch in batches(images):
            fields: list[tuple[str, Any]] = [("images", (name, _read(path))) for name, path in batch]
            if telemetry is not None:
                rows = [telemetry[""], *(telemetry[name] for name, _ in batch)]
                fields.append(("telemetry", ("telemetry.csv", "\n".join(rows) + "\n")))
            answer = self._request("POST", f"/flights/{flight_id}/images/batch", fields=fields)
            yield Accepted.model_validate_json(answer)

    def results(self, flight_id: str, *, refined: bool = False, first: int = 0) -> Results:
        return self._get(f"/flights/{flight_id}/results?refined={str(refined).lower()}&from={first}", Results)

    def user_fix(self, flight_id: str, fix: UserFix) -> Steered:
        return self._post(f"/flights/{flight_id}/user-fix", fix, Steered)

    def hint(self, flight_id: str, hint: Hint) -> Steered:
        return self._post(f"/flights/{flight_id}/hint", hint, Steered)

    def locate(self, flight_id: str, frame_id: int, pixel: ObjectPixel) -> ObjectGps:
        return self._post(f"/flights/{flight_id}/frames/{frame_id}/object-to-gps", pixel, ObjectGps)

    def complete(self, flight_id: str) -> Flight:
        return Flight.model_validate_json(self._request("POST", f"/flights/{flight_id}/complete"))

    def delete(self, flight_id: str) -> None:
        """With its images, results, events and recordings."""
        self._request("DELETE", f"/flights/{flight_id}")

    def events(self, flight_id: str, after: int = 0) -> Iterator[ReceivedEvent]:
        """The events after an id, then those to come, until ``flight_completed`` and its change of state. A connection
        that is cut is opened again; nothing is lost or doubled."""
        failures = 0
        while True:
            try:
                for event in self._stream(flight_id, after):
                    after, failures = max(after, event.event_id), 0
                    yield event
                    if event.name == "state_changed" and event.data["state"] == "completed":
                        return
            except LinkError:
                failures += 1
                if failures > RETRIES:
                    raise
            time.sleep(RETRY_S)

    def _stream(self, flight_id: str, after: int) -> Iterator[ReceivedEvent]:
        headers = {**self._headers, "last-event-id": str(after)}
        timeout = urllib3.Timeout(connect=CONNECT_S, read=SILENCE_S)
        url = f"{self.url}/flights/{flight_id}/events"
        try:
            answer = self._http.request("GET", url, headers=headers, preload_content=False, timeout=timeout)
            if answer.status != 200:
                raise _refused(answer.status, answer.data)
            try:
                yield from parse_events(answer.stream(amt=None, decode_content=True))
            finally:
                answer.close()
        except urllib3.exceptions.HTTPError as error:
            raise LinkError(f"{self.url}: the event stream was cut ({_reason(error)})") from None

    def _get(self, path: str, kind: type[T]) -> T:
        return kind.model_validate_json(self._request("GET", path))

    def _post(self, path: str, body: BaseModel, kind: type[T]) -> T:
        headers = {**self._headers, "content-type": "application/json"}
        return kind.model_validate_json(
            self._request("POST", path, body=body.model_dump_json(exclude_none=True).encode(), headers=headers)
        )

    def _request(self, method: str, path: str, **options: Any) -> bytes:
        try:
            answer = self._http.request(method, self.url + path, **options)
        except urllib3.exceptions.HTTPError as error:
            raise LinkError(
                f"{self.url}: no console answers ({_reason(error)}); is 'terrafix serve' running?"
            ) from None
        if answer.status >= 300:
            raise _refused(answer.status, answer.data)
        return bytes(answer.data)


def parse_events(chunks: Iterator[bytes]) -> Iterator[ReceivedEvent]:
    """Server-sent events of a stream, as far as the console uses them (HTML, 9.2)."""
    rest, event_id, name, data = b"", 0, "", ""
    for chunk in chunks:
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            key, _, value = line.decode().partition(": ")
            match key:
                case "id":
                    event_id = int(value)
                case "event":
                    name = value
                case "data":
                    data = value
                case "" if not line and name:
                    yield ReceivedEvent(event_id, name, json.loads(data))
                    event_id, name, data = 0, "", ""
                case _:
                    pass  # a comment


def batches(images: Sequence[tuple[str, Path]]) -> Iterator[Sequence[tuple[str, Path]]]:
    """Parts of equal size, as few as possible. Raises SourceError: fewer images than the least batch has."""
    least, most = BATCH
    if len(images) < least:
        raise SourceError(f"{len(images)} images; a flight has {least} at least")
    count = -(-len(images) // most)
    ends = [round(index * len(images) / count) for index in range(count + 1)]
    for first, end in pairwise(ends):
        yield images[first:end]


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None


def _refused(status: int, body: bytes) -> UsageError:
    try:
        detail = json.loads(body)["detail"]
    except (ValueError, KeyError, TypeError):
        detail = f"HTTP status {status}"
    return UsageError(f"the console refuses: {detail}")


def _reason(error: Exception) -> str:
    return str(error).rpartition(": ")[2] or type(error).__name__
