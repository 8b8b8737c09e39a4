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


@app.command()
def calibrate(
    sources: Annotated[list[str], typer.Argument(help="Images, a folder of images, a video, /dev/videoN or a stream.")],
    board: BoardOption,
    out: OutOption = OUT,
    model: Annotated[
        str, typer.Option(help="pinhole (k1 k2 p1 p2 k3), rational (wide, with k4 k5 k6) or fisheye (k1 to k4).")
    ] = "pinhole",
    name: Annotated[str, typer.Option(help="Name of the camera in the description.")] = "",
) -> None:
    """Calibrate a lens from images of a board, and write its description and a picture (.png) of the residuals."""
    from terrafix.core.errors import UsageError
    from terrafix_tools.camera.board import parse_board
    from terrafix_tools.camera.calibrating import calibrate as fitted
    from terrafix_tools.camera.describe import describe
    from terrafix_tools.camera.frames import board_views
    from terrafix_tools.camera.report import draw, fit_lines

    if model not in ("pinhole", "rational", "fisheye"):
        raise UsageError(f"--model {model}: pinhole, rational or fisheye")
    printed = parse_board(board)
    views, size, looked_at = board_views(sources, printed)
    fit = fitted(views, size, printed, model)
    lines = list(fit_lines(fit, looked_at, views))
    for line in describe(out, fit.camera(), name, [f"Calibrated with {board}.", *lines]):
        typer.echo(line)
    picture = out.with_suffix(".png")
    draw(fit, views, picture)
    typer.echo(f"{picture}: where corners were seen, and how far off")


@app.command()
def board(
    board: BoardOption = "charuco:8x6:30mm",
    out: Annotated[Path, typer.Option(help="Page to write: .pdf or .png.")] = Path("board.pdf"),
    paper: Annotated[str, typer.Option(help="a4, a3, a2 or letter.")] = "a4",
) -> None:
    """Write a calibration board to print at true scale."""
    from terrafix_tools.camera.board import parse_board, print_board

    typer.echo(print_board(parse_board(board), out, paper))


@app.command()
def check(record: Annotated[Path, typer.Argument(help="Flight record, or folder of a replay or run.")]) -> None:
    """What a flight says about its lens, mount and the times of its images."""
    from terrafix_tools.camera.checking import camera_check

    for line in camera_check(record):
        typer.echo(line)


@app.command()
def show(
    source: Annotated[str, typer.Argument(help="/dev/videoN, a stream, a video, photos, a flight folder.")],
    camera: Annotated[Path | None, typer.Option(help="Camera description; default: [source] camera.")] = None,
    config: Annotated[list[Path] | None, typer.Option("--config", help="TOML file; its [source] is used.")] = None,
    out: Annotated[Path, typer.Option(help="Image to write.")] = Path("frame.jpg"),
) -> None:
    """Write one frame as it flies, and print size, rate, time stamps and what is used."""
    from msgspec import structs

    from terrafix.core.config import load
    from terrafix.vision.sources import open_configured
    from terrafix_tools.camera.showing import shown

    section = load(config or []).source
    opened = open_configured(structs.replace(section, camera=str(camera)) if camera else section, source)
    for line in shown(opened, out):
        typer.echo(line)


@app.command()
def init(
    out: OutOption = OUT,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the frames, pixels.")] = "",
    focal: Annotated[str, typer.Option(help="914px, 70deg across the image, or 4.5mm/6.3mm (lens/sensor width).")] = "",
    tilt: Annotated[str, typer.Option(help="Degrees from straight down, towards the image top.")] = "",
    top: Annotated[str, typer.Option(help="Where the image top points: nose, tail, left, right.")] = "",
    tolerance: Annotated[str, typer.Option(help="1-sigma of the mount, degrees.")] = "",
) -> None:
    """Describe a camera that is not calibrated: five questions, or their options."""
    from terrafix_tools.camera.answers import Answers, asked, camera_of_answers
    from terrafix_tools.camera.describe import describe

    answers = asked(Answers(size, focal, tilt, top, tolerance))
    notes = ["Not calibrated: the focal length is nominal; `terrafix camera calibrate` measures it."]
    for line in describe(out, camera_of_answers(answers), "", notes):
        typer.echo(line)
