"""The uploaded images of a flight as a source, which waits for the next batch until the flight is completed."""

from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

from terrafix.messages import Frame, PositionHint, VehicleState
from terrafix.vision.sources import Shot
from terrafix.vision.sources.contract import SourceBase
from terrafix.vision.sources.description import ATTITUDE_SIGMA_DEG
from terrafix.vision.sources.images import read_image
from terrafix.vision.sources.photos import STATED_TILT_SIGMA_DEG
from terrafix_tools.console.compute.description import origin, stored_camera
from terrafix_tools.console.payloads import Hint, NewFlight, UserFix
from terrafix_tools.console.store import flights
from terrafix_tools.console.store.database import Database
from terrafix_tools.console.store.flights import StoredImage

PAGE = 50  # images whose rows are read at once
MAX_ATTEMPTS = 2  # processes that may die at an image before it is left out [spec: one death may be chance]
POISONED = "the processes that read this image have died"

Steer = Callable[[int, Hint | UserFix, int], PositionHint | None]


class Upload(msgspec.Struct, frozen=True, tag=True):
    """An uploaded image, its telemetry and the hints that were given before it. ``path``: "" if it is not to be
    read."""

    frame: Frame
    path: str
    state: VehicleState | None
    hints: tuple[PositionHint, ...]

    def read(self, width: int, height: int) -> Shot:
        """``width``, ``height``: of the file, pixels."""
        pixels, error = read_image(Path(self.path), width, height) if self.path else (None, self.frame.error)
        states = () if self.state is None else (self.state,)
        return Shot(msgspec.structs.replace(self.frame, error=error), states, pixels, others=self.hints)


class UploadedImages(SourceBase):
    """A Source. ``wait`` blocks until something may have changed; ``begins`` gets each frame before it is read;
    ``steer(hint_id, given, t_ns)`` makes the message of a hint, None: it cannot be used."""

    def __init__(
        self,
        database: Database,
        flight_id: str,
        folder: Path,
        *,
        wait: Callable[[], None],
        begins: Callable[[int], None],
        steer: Steer,
    ) -> None:
        self._database, self._flight_id, self._folder = database, flight_id, folder
        self._wait, self._begins, self._steer = wait, begins, steer
        self.first_frame = 0  # those before were computed by an earlier process
        with database.read() as db:
            self.new = NewFlight.model_validate_json(flights.row_of(db, flight_id).spec)
            states = [self._state(image) for image in flights.images_of(db, flight_id, 0, 1)]
        by_photos = any(state is not None and state.source == "exif" for state in states)
        stated = origin(self.new, STATED_TILT_SIGMA_DEG if by_photos else ATTITUDE_SIGMA_DEG)
        self._origin = msgspec.structs.replace(stated, flight_id=flight_id)
        self.stored = stored_camera(self.new)

    def name(self) -> str:
        return self.new.name or self._flight_id

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        for upload in self.uploads():
            if upload.frame.t_ns >= from_s * 1e9:
                yield upload.read(self.stored.width, self.stored.height)

    def uploads(self) -> Iterator[Upload]:
        """The images in their order, unread."""
        frame_id = self.first_frame
        while True:
            with self._database.read() as db:
                page = flights.images_of(db, self._flight_id, frame_id, PAGE)
                completing = bool(flights.row_of(db, self._flight_id).completing)
            for image in page:
                self._begins(image.frame_id)
                yield self._upload(image)
            frame_id += len(page)
            if not page and completing:
                return
            if not page:
                self._wait()

    def _upload(self, image: StoredImage) -> Upload:
        camera, poisoned = self._origin.camera, image.attempts >= MAX_ATTEMPTS
        frame = Frame(
            t_ns=image.t_ns,
            frame_id=image.frame_id,
            file=image.name,
            width=camera.width,
            height=camera.height,
            error=POISONED if poisoned else "",
        )
        path = "" if poisoned else str(self._folder / image.stored)
        return Upload(frame, path, self._state(image), self._hints(image))

    @staticmethod
    def _state(image: StoredImage) -> VehicleState | None:
        return None if image.state is None else msgspec.json.decode(image.state, type=VehicleState)

    def _hints(self, image: StoredImage) -> tuple[PositionHint, ...]:
        with self._database.read() as db:
            if not flights.has_hints_before(db, self._flight_id, image.frame_id):
                return ()
        with self._database.write() as db:
            given = flights.hints_before(db, self._flight_id, image.frame_id)
        made = (self._steer(hint_id, hint, image.t_ns) for hint_id, hint in given)
        return tuple(message for message in made if message is not None)
