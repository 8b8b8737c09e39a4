"""python -m terrafix_tools.console.compute.exporting: one export of a flight as one file, in the folder ``done``.

Works in the current folder: its entry ``--flight``, by the name of the flight, leads to the record, ``photos`` to the
photos. A folder, and the files of a Shapefile, become a zip file. Prints the mistake, if there is one."""

import argparse
import os
import shutil
import signal
import sys
import zipfile
from pathlib import Path

from terrafix.core.errors import TerrafixError
from terrafix.runtime.fork_server import set_parent_death_signal
from terrafix_tools.export.formats import export, format_of

NICE = 10  # as the flights [spec: nice(2)]
MADE, DONE, PHOTOS = Path("made"), Path("done"), Path("photos")


def write(options: argparse.Namespace) -> None:
    MADE.mkdir()
    DONE.mkdir()
    chosen = format_of(MADE, options.format)
    name = chosen.file_name(f"{options.flight}-{options.which}", options.format)
    photos = PHOTOS if PHOTOS.is_dir() else None
    export(Path(options.flight), MADE / name, options.format, options.which, photos)
    files = sorted(path for path in MADE.rglob("*") if path.is_file())
    if files == [MADE / name]:
        files[0].replace(DONE / name)
        return
    stem = name if chosen.is_folder else Path(name).stem
    with zipfile.ZipFile(DONE / f"{stem}.zip", "w", zipfile.ZIP_STORED) as packed:  # photos are compressed already
        for path in files:
            packed.write(path, path.relative_to(MADE))
            path.unlink()
    shutil.rmtree(MADE)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--parent", type=int, required=True)
    for name in ("flight", "format", "which"):
        parser.add_argument(f"--{name}", required=True)
    options = parser.parse_args()
    if not set_parent_death_signal(options.parent, signal.SIGKILL):
        return
    os.nice(NICE)
    try:
        write(options)
    except TerrafixError as error:
        sys.stdout.write(str(error))


if __name__ == "__main__":
    main()
