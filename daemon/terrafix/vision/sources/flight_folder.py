"""Flight folder: flight.toml, frames.csv, frames/ and optionally a telemetry log (docs/flight-folder.md).

It may also contain truth.csv, which is not read here."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from terrafix.core.errors import SourceError
from terrafix.messages import Fact, Frame, GimbalAttitude, Imu, VehicleState
from terrafix.vision.sources.contract import Shot, SourceBase, TelemetryCursor
from terrafix.vision.sources.description import camera_of, origin_of, read_description, telemetry_log
from terrafix.vision.sources.exposed import exposed_times
from terrafix.vision.sources.facts import camera_facts, log_facts, mount_fact, rate_facts, start_fact, telemetry_facts
from terrafix.vision.sources.images import WRONG_SIZE, downscaled_camera, read_image
from terrafix.vision.sources.plausible import check_heights
from terrafix.vision.sources.table import Row, read_table


class FlightFolder(SourceBase):
    """Validates everything except the pixels when it is opened, so that errors are found before the flight."""

    def __init__(self, folder: Path, start: tuple[float, float] | None = None) -> None:
        self.folder = folder
        self._start_given = start is not None
        toml = folder / "flight.toml"
        self._description = read_description(toml)
        self._stored = camera_of(toml, self._description)
        self._origin = origin_of(self._description, downscaled_camera(self._stored), start)
        self._rows = read_table(folder / "frames.csv", "frames.csv", with_file=True)
        heights_m = [row.state.agl_m for row in self._rows if row.state is not None and row.state.agl_m is not None]
        check_heights(folder / "frames.csv", heights_m)
        self._check_files()
        self._check_size()
        stated, self._stated_in = [row.state for row in self._rows if row.state is not None], "frames.csv"
        table = folder / "telemetry.csv"
        if table.is_file():
            stated += [row.state for row in read_table(table, table.name, with_file=False) if row.state is not None]
            stated.sort(key=lambda state: state.t_ns)
            self._stated_in += f" and {table.name}"
        self._stated = stated
        times_ns = [row.t_ns for row in self._rows]
        self._log = telemetry_log(folder / "telemetry", self._description, stated, [t_ns * 1e-9 for t_ns in times_ns])
        self._exposure_facts: list[Fact] = []
        if self._log is not None and self._log.exposures:
            times_ns, self._exposure_facts = exposed_times(times_ns, self._log.exposures, self._log.path.name)
            self._rows = [replace(row, t_ns=t_ns) for row, t_ns in zip(self._rows, times_ns, strict=True)]
        self._states = self._telemetry()
        self._imu: list[Imu] = [] if self._log is None else self._log.imu
        self._gimbal: list[GimbalAttitude] = [] if self._log is None else self._log.gimbal

    def length(self) -> int | None:
        return len(self._rows)

    def name(self) -> str:
        return self._description.name or self.folder.name

    def map_hint(self) -> Path | None:
        return (self.folder / self._description.map).resolve() if self._description.map else None

    def facts(self) -> list[Fact]:
        times_s = [row.t_ns / 1e9 for row in self._rows]
        found = [
            *camera_facts(self._stored, "[camera] of flight.toml"),
            mount_fact(self._stored, "[mount] of flight.toml"),
            start_fact(self._origin, "--start" if self._start_given else "[start] of flight.toml"),
            *rate_facts(times_s, "frames"),
        ]
        if self._stated or self._log is None:
            found += telemetry_facts(self._stated, self._stated_in, self._origin)
        if self._log is not None:
            found += telemetry_facts(self._log.states, self._log.path.name, self._origin)
            found += [*log_facts(self._log), *self._exposure_facts]
        outside = sum(not -1e9 <= state.t_ns <= self._rows[-1].t_ns for state in self._states)
        if outside and outside == len(self._states):
            found.append(Fact("left out", "all telemetry: none of it lies within the times of the frames"))
        return found

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        from_ns = round(from_s * 1e9)
        camera, stored = self._origin.camera, self._stored
        states_of, imu_of = TelemetryCursor(self._states, from_ns), TelemetryCursor(self._imu, from_ns)
        gimbal_of = TelemetryCursor(self._gimbal, from_ns)
        for frame_id, row in enumerate(self._rows):
            states, imu, held = states_of(row.t_ns), imu_of(row.t_ns), gimbal_of(row.t_ns)
            if row.t_ns < from_ns:
                continue
            image, error = read_image(self.folder / "frames" / row.file, stored.width, stored.height)
            frame = Frame(
                t_ns=row.t_ns,
                frame_id=frame_id,
                file=row.file,
                width=camera.width,
                height=camera.height,
                error=error,
            )
            yield Shot(frame, states, image, imu, held)

    def _check_files(self) -> None:
        table, frames = self.folder / "frames.csv", self.folder / "frames"
        if not frames.is_dir():
            raise SourceError(f"{frames}: no such folder; the images that frames.csv names belong in it")
        inside = frames.resolve()  # frames/ itself may be a link, to a larger disk
        for row in self._rows:
            parts = PurePosixPath(row.file.replace("\\", "/"))
            if parts.is_absolute() or ".." in parts.parts:
                raise SourceError(f"{table} row {row.number}: '{row.file}' leaves frames/; name files inside it")
            if not os.path.isfile(frames / row.file):
                raise SourceError(
                    f"{table} row {row.number}: frames/{row.file} does not exist{_count_missing(frames, self._rows)}; "
                    "add the image or remove the row"
                )
            if not _is_inside(frames / row.file, frames, inside):
                raise SourceError(
                    f"{table} row {row.number}: frames/{row.file} is a link that leaves frames/; copy the image there"
                )

    def _check_size(self) -> None:
        """Raises SourceError when the first, middle and last frame have another size than [camera].

        A single frame of another size is only a bad frame."""
        stored = self._stored
        for row in (self._rows[0], self._rows[len(self._rows) // 2], self._rows[-1]):
            _, error = read_image(self.folder / "frames" / row.file, stored.width, stored.height)
            if not error.startswith(WRONG_SIZE):
                return
        raise SourceError(
            f"{self.folder}: the frames have the {error}; write [camera] of flight.toml in pixels of the stored frames"
        )

    def _telemetry(self) -> list[VehicleState]:
        """States of tables and log in time order. A log may start before or after the first frame."""
        return sorted([*self._stated, *(self._log.states if self._log else ())], key=lambda state: state.t_ns)


def _is_inside(file: Path, frames: Path, real_frames: Path) -> bool:
    """Whether no link leads from ``file`` out of ``frames``, whose path without links is ``real_frames``. A file that
    lies in it and is no link needs no look at the folders above, of which a flight of an hour has 7000."""
    is_plain = file.parent == frames and not file.is_symlink()
    return is_plain or file.resolve().is_relative_to(real_frames)


def _count_missing(frames: Path, rows: list[Row]) -> str:
    missing = sum(not os.path.isfile(frames / row.file) for row in rows)
    return f" (and {missing - 1} more)" if missing > 1 else ""
