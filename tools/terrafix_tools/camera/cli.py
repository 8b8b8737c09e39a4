"""`terrafix camera ...`: the description of a camera, from a calibration, a board, a few answers; and its check."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Describe, calibrate and check a camera.")

OutOption = Annotated[Path, typer.Option("--out", help="Camera description to write (TOML).")]
SizeOption = Annotated[str, typer.Option(help="WIDTHxHEIGHT of the frames that are flown; default: as calibrated.")]
BoardOption = Annotated[
    str,
    typer.Option(
        "--board", help="charuco:8x6:30mm (squares, side of a square) or chessboard:9x6:25mm (inner corners)."
    ),
]
OUT = Path("camera.toml")


@app.callback()
def options() -> None:
    """Describe, calibrate and check a camera."""


@app.command("import")
def import_(
    file: Annotated[
        Path,
        typer.Argument(
            help="ROS camera_info, Kalibr camchain, OpenCV FileStorage, COLMAP cameras.txt or .bin, cameras.json of "
            "ODM or OpenSfM, Metashape XML, or a photo with DewarpData of DJI."
        ),
    ],
    out: OutOption = OUT,
    camera: Annotated[str, typer.Option(help="Which camera of a file that has several.")] = "",
    size: SizeOption = "",
    fisheye: Annotated[bool, typer.Option("--fisheye", help="OpenCV's four coefficients are of cv2.fisheye.")] = False,
) -> None:
    """Write the camera description of a calibration that another program has made."""
    from terrafix_tools.camera.describe import describe, parse_size, resized
    from terrafix_tools.camera.importing import Wanted, read_calibration

    found = read_calibration(file, Wanted(camera, parse_size(size), fisheye))
    stored = resized(file, found.camera, parse_size(size))
    for line in describe(out, stored, found.name, [f"From {file.name}, {found.program}.", *found.notes]):
        typer.echo(line)
