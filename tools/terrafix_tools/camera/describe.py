"""Writes a camera as a description, reads it back and says what a flight makes of it."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from terrafix.core.errors import SourceError, UsageError
from terrafix.messages import Camera
from terrafix.vision.sources.description import CameraTable, Description, MountTable, camera_of, read_description
from terrafix.vision.sources.facts import camera_facts, mount_fact
from terrafix.vision.sources.fisheye import view_facts
from terrafix_tools.camera.description import write_toml

ASPECT_TOLERANCE = 0.01  # sizes are whole numbers; a cut image has another aspect


def parse_size(text: str) -> tuple[int, int] | None:
    """'1280x720' -> (1280, 720); '' -> None. Raises UsageError."""
    if not text:
        return None
    found = re.fullmatch(r"(\d{2,5})[xX](\d{2,5})", text.strip())
    if found is None:
        raise UsageError(f"--size {text}: write WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(found.group(1)), int(found.group(2))


def resized(file: Path, camera: Camera, size: tuple[int, int] | None) -> Camera:
    """The camera of images that are scaled to ``size``. Raises UsageError: it has another aspect."""
    if size is None or size == (camera.width, camera.height):
        return camera
    by, by_height = size[0] / camera.width, size[1] / camera.height
    if abs(by / by_height - 1.0) > ASPECT_TOLERANCE:
        raise UsageError(
            f"{file}: calibrated at {camera.width}x{camera.height}; {size[0]}x{size[1]} has another aspect, so it is "
            "cut, and how is not known: calibrate in the mode that flies"
        )
    return msgspec.structs.replace(
        camera,
        width=size[0],
        height=size[1],
        fx=camera.fx * by,
        fy=camera.fy * by_height,
        cx=(camera.cx + 0.5) * by - 0.5,
        cy=(camera.cy + 0.5) * by_height - 0.5,
    )


def describe(out: Path, camera: Camera, name: str, notes: Sequence[str]) -> Iterator[str]:
    """Writes ``out``; -> lines of what it says. ``notes``: comments in the file. Raises SourceError: implausible (the
    file is not kept), OutputError."""
    if out.suffix != ".toml":
        raise UsageError(f"--out {out}: a camera description ends in .toml")
    kept = out.read_bytes() if out.is_file() else None
    written = Description(name=name, camera=CameraTable.of(camera), mount=MountTable.of(camera))
    middle = "The middle of the first pixel is 0, 0."
    write_toml(out, written, "\n# ".join([*notes, middle]))
    try:
        read = camera_of(out, read_description(out))
    except SourceError:
        out.unlink() if kept is None else out.write_bytes(kept)
        raise
    yield f"{out}: written"
    yield from (f"  {note}" for note in notes)
    facts = [*camera_facts(read, "this file"), *view_facts(read), mount_fact(read, "this file")]
    yield from (f"  {fact.topic:<6}  {fact.text}" for fact in facts)
