"""Video file with a description beside it (VIDEO.toml or flight.toml), optionally VIDEO.csv and VIDEO.tlog."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

import cv2

from terrafix.core.errors import SourceError
from terrafix.messages import Fact, Frame, GimbalAttitude, Imu, VehicleState
from terrafix.vision.sources.contract import Shot, SourceBase, TelemetryCursor
from terrafix.vision.sources.description import camera_of, origin_of, read_description, telemetry_log
from terrafix.vision.sources.facts import camera_facts, log_facts, mount_fact, start_fact, telemetry_facts
from terrafix.vision.sources.gpmf import read_gpmf
from terrafix.vision.sources.positions import positions_at
from terrafix.vision.sources.srt import read_srt
from terrafix.vision.sources.table import read_table

FFMPEG_QUIET = "-8"  # AV_LOG_QUIET; a damaged image would otherwise print one line per block


class Video(SourceBase):
    """Takes ``rate_hz`` images per second. Times are those of the container; frame ids count the images taken."""

    def __init__(
        self,
        path: Path,
        start: tuple[float, float] | None = None,
        camera: Path | None = None,
        rate_hz: float = 2.0,
    ) -> None:
        self.path = path
        where = camera or self._find_description()
        self._where, self._start_given = where, start is not None
        self._description = read_description(where)
        self._map_base = where.parent
        self._origin = origin_of(self._description, camera_of(where, self._description), start)
        states = self._stated()
        self._log = telemetry_log(path, self._description, states)
        self._states = sorted([*states, *(self._log.states if self._log else ())], key=lambda state: state.t_ns)
        self._imu: list[Imu] = [] if self._log is None else self._log.imu
        self._gimbal: list[GimbalAttitude] = [] if self._log is None else self._log.gimbal
        self._gopro = read_gpmf(path)
        self._period_s = 1.0 / rate_hz
        capture = self._open()
        self._fps = capture.get(cv2.CAP_PROP_FPS)
        self._frames = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        capture.release()
        expected = self._origin.camera
        if size != (expected.width, expected.height):
            raise SourceError(
                f"{path}: the video is {size[0]}x{size[1]}, [camera] in {where} says "
                f"{expected.width}x{expected.height}; describe the camera in pixels of this video"
            )

    def length(self) -> int | None:
        if not (self._fps > 0 and self._frames > 0):
            return None
        return min(int(self._frames), math.ceil(self._frames / self._fps / self._period_s))

    def name(self) -> str:
        return self._description.name or self.path.stem

    def map_hint(self) -> Path | None:
        return (self._map_base / self._description.map).resolve() if self._description.map else None

    def facts(self) -> list[Fact]:
        described = f"[camera] of {self._where.name}"
        found = [
            *camera_facts(self._origin.camera, described),
            mount_fact(self._origin.camera, f"[mount] of {self._where.name}"),
            start_fact(self._origin, "--start" if self._start_given else f"[start] of {self._where.name}"),
            Fact("clock", "times of the container"),
            Fact("rate", f"{1 / self._period_s:g} images a second of {self._fps:.3g} ([source] rate_hz)"),
            *telemetry_facts(self._states, "the telemetry beside the video", self._origin),
        ]
        if self._log is not None:
            found += log_facts(self._log)
        if self._gopro is not None:
            streams = ", ".join(sorted(self._gopro.streams)) or "nothing"
            text = f"telemetry of {self._gopro.device or 'a GoPro'} in the video ({streams}): positions are truth "
            text += "(terrafix source truth), axes of the others are not stated"
            found.append(Fact("left out", text))
        return found

    def truth(self) -> list[tuple[str, float, float]]:
        """By GoPro's telemetry in the video."""
        if self._gopro is None or not self._gopro.fixes:
            raise SourceError(f"{self.path}: has no positions of a GoPro that could be the truth")
        return positions_at(((shot.frame.file, shot.frame.t_ns) for shot in self.shots()), self._gopro.fixes)

    def shots(self, from_s: float = 0.0) -> Iterator[Shot]:
        capture = self._open()
        try:
            yield from self._shots(capture, from_s)
        finally:
            capture.release()

    def _shots(self, capture: cv2.VideoCapture, from_s: float) -> Iterator[Shot]:
        camera = self._origin.camera
        step_s = 1.0 / self._fps if self._fps > 0 else self._period_s
        from_ns = round(from_s * 1e9)
        states_of, imu_of = TelemetryCursor(self._states, from_ns), TelemetryCursor(self._imu, from_ns)
        gimbal_of = TelemetryCursor(self._gimbal, from_ns)
        frame_id, t_s, due_s = 0, -step_s, 0.0
        while capture.grab():
            container_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            t_s = container_s if container_s > t_s else t_s + step_s  # some containers have no timestamps
            if t_s < due_s - step_s / 2:
                continue
            due_s += self._period_s * max(1, math.ceil((t_s + step_s / 2 - due_s) / self._period_s))
            t_ns = round(t_s * 1e9)
            states, imu, held = states_of(t_ns), imu_of(t_ns), gimbal_of(t_ns)
            if t_s >= from_s:
                decoded, image = capture.retrieve()
                frame = Frame(
                    t_ns=t_ns,
                    frame_id=frame_id,
                    file=f"{self.path.name}@{t_s:.3f}",
                    width=camera.width,
                    height=camera.height,
                    error="" if decoded else "cannot be decoded",
                )
                yield Shot(frame, states, image if decoded else None, imu, held)
            frame_id += 1

    def _find_description(self) -> Path:
        for where in (self.path.with_suffix(".toml"), self.path.with_name("flight.toml")):
            if where.is_file():
                return where
        raise SourceError(
            f"{self.path}: a video does not say which camera took it; 'terrafix camera calibrate', 'import' or 'init' "
            f"writes its description, with --out {self.path.with_suffix('.toml')}"
        )

    def _stated(self) -> list[VehicleState]:
        """What a table beside the video states, in time order."""
        table = self.path.with_suffix(".csv")
        states: list[VehicleState] = []
        if table.is_file():
            rows = read_table(table, table.name, with_file=False)
            states += [row.state for row in rows if row.state is not None]
        for subtitles in (self.path.with_suffix(".SRT"), self.path.with_suffix(".srt")):
            if subtitles.is_file() and not states:  # a table beside it was made on purpose
                states += read_srt(subtitles)
        return states

    def _open(self) -> cv2.VideoCapture:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", FFMPEG_QUIET)
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise SourceError(f"{self.path}: cannot be opened as a video; is it complete, and a format FFmpeg knows?")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # pixels as they are stored
        return capture
