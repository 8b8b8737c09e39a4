"""`terrafix camera calibrate`, `board`, `init`, `show` and `check`, on rendered boards and small files."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from rendered_boards import Booth, poses
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import SourceError, UsageError
from terrafix.vision.sources.description import camera_of, read_description
from terrafix.vision.sources.fisheye import FisheyeCamera
from terrafix_lab.sim.camera.lens import Fisheye, Lens, Pinhole
from terrafix_tools.camera.board import SQUARE_PX, Board, parse_board, print_board
from terrafix_tools.camera.calibrating import BoardView, calibrate
from terrafix_tools.camera.cli import app
from terrafix_tools.camera.frames import board_views

BOARD = parse_board("charuco:8x6:30mm")
LENS = Pinhole(CameraCalibration(480, 360, 390.0, 391.0, 241.3, 177.8, (-0.22, 0.07, 0.0005, -0.0004, -0.01)))
FISHEYE = Fisheye(640, 480, 240.0, 241.0, 322.0, 236.5, (0.01, 0.004, -0.002, 0.0003))
RUN = CliRunner()


def seen(board: Board, lens: Lens, seed: int, *, tilt_deg: float = 35.0, count: int = 20) -> list[BoardView]:
    """Corners with noise, a part of which is common to a view, as of blur, light and a board that is not flat."""
    random = np.random.default_rng(seed)
    middle = np.array([*board.squares, 0]) * board.square_mm / 2
    views = []
    for i, (turn, at_mm) in enumerate(poses(board, lens, count, random, tilt_deg)):
        points = (board.corners_mm - middle) @ turn.T + at_mm
        px = lens.project(points) + random.normal(0.0, 0.05, (len(points), 2))
        px += (
            0.1
            * (random.normal(0.0, 1.0, (2, 3)) @ np.column_stack([board.corners_mm[:, :2] / 240, np.ones(len(px))]).T).T
        )
        inside = ((px > 5) & (px < np.array([lens.width, lens.height]) - 5)).all(axis=1)
        views.append(BoardView(str(i), np.flatnonzero(inside), px[inside]))
    return views


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boards")
    random, booth = np.random.default_rng(3), Booth(BOARD, LENS)
    for i, pose in enumerate(poses(BOARD, LENS, 14, random)):
        cv2.imwrite(str(folder / f"{i:02d}.png"), booth.image(pose, random))
    return folder


def test_a_lens_is_calibrated_from_rendered_boards_and_its_description_flies(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.toml"
    done = RUN.invoke(app, ["calibrate", str(images), "--board", "charuco:8x6:30mm", "--out", str(out)])
    assert done.exit_code == 0, done.output
    camera = camera_of(out, read_description(out))
    assert (camera.width, camera.height) == (480, 360)
    assert camera.fx == pytest.approx(390.0, rel=0.006)
    assert camera.fy == pytest.approx(391.0, rel=0.006)
    assert abs(camera.cx - 241.3) < 1.0 and abs(camera.cy - 177.8) < 1.0
    assert 1e-4 < camera.focal_sigma < 5e-3
    assert abs(camera.fx / 390.0 - 1.0) < 3 * camera.focal_sigma
    assert re.search(r"fx = [\d.]+ \+- [\d.]+", done.output)
    picture = cv2.imread(str(tmp_path / "camera.png"))
    assert picture.shape[:2] == (360, 480) and (picture < 128).any()


# Limits of the RMS: 0.5 and 99.5 % of chi-square with a degree of freedom for each set, fx and fy of which err alike.
@pytest.mark.parametrize(
    ("lens", "model", "sets", "least", "most"),
    [(LENS, "pinhole", 8, 0.41, 1.66), (FISHEYE, "fisheye", 3, 0.15, 2.07)],
)
def test_the_stated_uncertainty_of_the_focal_length_is_true_of_errors_that_a_view_has_in_common(
    lens: Lens, model: str, sets: int, least: float, most: float
) -> None:
    true = np.array([390.0, 391.0] if model == "pinhole" else [240.0, 241.0])
    fits = [calibrate(seen(BOARD, lens, seed), (lens.width, lens.height), BOARD, model) for seed in range(sets)]
    z = np.array([(fit.values[:2] - true) / fit.sigmas[:2] for fit in fits])
    assert least < np.sqrt(np.mean(z**2)) < most
    assert isinstance(fits[0].camera(), FisheyeCamera) == (model == "fisheye")


def upper_left(view: BoardView) -> BoardView:
    kept = (view.px < [300, 220]).all(axis=1)
    return replace(view, ids=view.ids[kept], px=view.px[kept])


@pytest.mark.parametrize(
    ("views", "missing"),
    [
        ([], "10 more images .*found in none; is it the one of --board"),
        (seen(BOARD, LENS, 1)[:6], "4 more images"),
        (seen(BOARD, LENS, 1, tilt_deg=4.0), "tilted up and down"),
        ([upper_left(view) for view in seen(BOARD, LENS, 1)], "parts of the image: upper right, .*lower right"),
    ],
)
def test_a_set_that_does_not_determine_the_lens_is_refused_with_what_is_missing(
    views: list[BoardView], missing: str
) -> None:
    with pytest.raises(SourceError, match=missing) as error:
        calibrate(views, (480, 360), BOARD, "pinhole")
    assert "\n" not in str(error.value)


def test_a_folder_of_images_that_is_not_there_is_named() -> None:
    with pytest.raises(SourceError, match="noboards: no such file or folder"):
        board_views(["noboards"], BOARD)


def test_another_board_than_stated_is_refused() -> None:
    other = replace(BOARD, columns=7, marker_mm=20.0)
    views = [replace(view, ids=view.ids[view.ids < 30], px=view.px[view.ids < 30]) for view in seen(BOARD, LENS, 1)]
    with pytest.raises(SourceError, match="is it the board that --board says"):
        calibrate(views, (480, 360), other, "pinhole")


@pytest.mark.parametrize("name", ["charuco:8x6:30mm", "chessboard:9x6:25mm"])
def test_a_board_is_printed_at_true_scale_and_found_on_its_page(name: str, tmp_path: Path) -> None:
    board = parse_board(name)
    print_board(board, tmp_path / "board.png", "a4")
    with Image.open(tmp_path / "board.png") as page:
        per_mm = page.info["dpi"][0] / 25.4
        assert page.width / per_mm == pytest.approx(297.0, abs=0.2)
        ids, px = board.find(cv2.resize(np.asarray(page.convert("L")), None, fx=0.25, fy=0.25))
    assert len(ids) == len(board.corners_mm)
    order = np.argsort(ids)
    across_mm = np.hypot(*(px[order][1] - px[order][0])) * 4 / per_mm
    assert across_mm == pytest.approx(board.square_mm, rel=2e-3)
    print_board(board, tmp_path / "board.pdf", "a4")
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", (tmp_path / "board.pdf").read_bytes())
    assert box is not None
    assert [float(v) / 72 * 25.4 for v in box.groups()] == pytest.approx([297.0, 210.0], abs=0.2)


@pytest.mark.parametrize(
    ("name", "paper", "out", "problem"),
    [
        ("charuco:8x6", "a4", "b.pdf", "charuco:8x6:30mm"),
        ("charuco:8x6:30mm:31mm", "a4", "b.pdf", "smaller than squares"),
        ("charuco:8x6:30mm:20mm:9X9_1", "a4", "b.pdf", "dictionary"),
        ("charuco:8x6:40mm", "a4", "b.pdf", "squares of 32 mm"),
        ("charuco:8x6:30mm", "a9", "b.pdf", "a4"),
        ("charuco:8x6:30mm", "a4", "b.doc", ".pdf or .png"),
    ],
)
def test_a_board_that_cannot_be_printed_is_refused(
    name: str, paper: str, out: str, problem: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=re.escape(problem)):
        print_board(parse_board(name), tmp_path / out, paper)
    assert not (tmp_path / out).exists()


def test_a_drawn_square_has_its_number_of_pixels() -> None:
    assert BOARD.picture().shape == (6 * SQUARE_PX, 8 * SQUARE_PX)


def test_five_answers_are_a_description(tmp_path: Path) -> None:
    out = tmp_path / "camera.toml"
    words = ["init", "--size", "1280x720", "--focal", "90deg", "--tilt", "10", "--top", "tail", "--tolerance", "3"]
    done = RUN.invoke(app, [*words, "--out", str(out)])
    assert done.exit_code == 0, done.output
    camera = camera_of(out, read_description(out))
    assert camera.fx == pytest.approx(640.0)
    assert (camera.mount_yaw_deg, camera.mount_pitch_deg, camera.mount_tolerance_deg) == (180.0, -80.0, 3.0)
    assert camera.focal_sigma == 0.1


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--focal", "90deg"], "--size is missing"),
        (["--size", "1280x720", "--focal", "wide", "--tilt", "0", "--top", "nose", "--tolerance", "5"], "914px"),
        (["--size", "1280x720", "--focal", "914px", "--tilt", "0", "--top", "up", "--tolerance", "5"], "nose, tail"),
        (["--size", "1280x720", "--focal", "914px", "--tilt", "x", "--top", "nose", "--tolerance", "5"], "degrees"),
    ],
)
def test_an_answer_that_is_missing_or_not_understood_is_one_line(
    words: list[str], problem: str, tmp_path: Path
) -> None:
    done = RUN.invoke(app, ["init", *words, "--out", str(tmp_path / "c.toml")])
    assert isinstance(done.exception, UsageError)
    assert problem in str(done.exception)
    assert not (tmp_path / "c.toml").exists()


def test_one_frame_of_a_source_is_shown_with_what_is_used(images: Path, tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    (flight / "frames").mkdir(parents=True)
    for i in range(3):
        (flight / "frames" / f"{i}.png").write_bytes((images / f"{i:02d}.png").read_bytes())
    (flight / "frames.csv").write_text("file,t_s\n" + "".join(f"{i}.png,{i / 2}\n" for i in range(3)))
    (flight / "flight.toml").write_text("[camera]\nwidth=480\nheight=360\nfx=390\nfy=390\ncx=240\ncy=180\n")
    done = RUN.invoke(app, ["show", str(flight), "--out", str(tmp_path / "frame.png")])
    assert done.exit_code == 0, done.output
    assert cv2.imread(str(tmp_path / "frame.png")).shape == (360, 480, 3)
    assert "rate: 2.0 a second, steps of 500 to 500 ms" in done.output
    assert "focal length 390.0 px" in done.output
