"""Exports of a flight (docs/exports.md), made by a process of their own."""

import asyncio
import logging
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from starlette.background import BackgroundTask
from starlette.responses import FileResponse

from terrafix_tools.console.problems import Refusal
from terrafix_tools.console.uploads import Slots

AT_ONCE = 2  # [spec: docs/console.md]
LIMIT_S = 900.0  # longest time of one [spec: docs/console.md]
NAME_LENGTH = 80  # of a flight in the name of a file, whose limit is 255 bytes

log = logging.getLogger("terrafix.console")


class Exports:
    def __init__(self) -> None:
        self._slots = Slots(AT_ONCE, "exports")

    async def make(
        self, out: Path, title: str, kind: str, which: str, photos: Mapping[str, Path] | None
    ) -> FileResponse:
        """``out``: folder with the record of the flight; ``title``: its name; ``photos``: by their names, None: there
        are none. Raises Refusal: nothing to export, too many at once, too slow."""
        flight = re.sub(r"[^\w .+-]+", "-", title).strip(" .-")[:NAME_LENGTH] or "flight"
        work = Path(tempfile.mkdtemp(dir=out.parent, prefix="export-"))
        try:
            with self._slots.one():
                await asyncio.to_thread(_link, work, flight, out, photos)
                refused = await _run(work, "--flight", flight, "--format", kind, "--which", which)
            if refused:
                raise Refusal(409, refused)
            (file,) = (work / "done").iterdir()
        except BaseException:
            shutil.rmtree(work, ignore_errors=True)
            raise
        return FileResponse(file, filename=file.name, background=BackgroundTask(shutil.rmtree, work))


def _link(work: Path, flight: str, out: Path, photos: Mapping[str, Path] | None) -> None:
    (work / flight).symlink_to(out.absolute())
    for name, path in (photos or {}).items():
        (work / "photos").mkdir(exist_ok=True)
        (work / "photos" / name).symlink_to(path.absolute())


async def _run(work: Path, *options: str) -> str:
    """-> why there is no export; else empty. Raises Refusal."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "terrafix_tools.console.compute.exporting", "--parent", str(os.getpid()), *options),
        cwd=work,
        stdout=asyncio.subprocess.PIPE,
        env={"OMP_NUM_THREADS": "1", **os.environ},
    )
    try:
        answer, _ = await asyncio.wait_for(process.communicate(), LIMIT_S)
    except TimeoutError:
        raise Refusal(503, f"the export took more than {LIMIT_S:.0f} s; use 'terrafix log export'") from None
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode != 0:
        log.error("an export failed (exit code %d)", process.returncode)
        raise Refusal(500, "the console has a bug; its log has the traceback")
    return answer.decode().strip()
