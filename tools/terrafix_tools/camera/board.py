"""Calibration boards: ChArUco and chessboard, by a short name; found in images, and drawn to print at true scale."""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image as Picture
from PIL import ImageDraw

from terrafix.core.errors import OutputError, UsageError

MARKER_SHARE = 0.75  # of the side of a square; OpenCV's sample boards have 0.5 to 0.8
DICTIONARY = "5X5_250"  # 250 markers: any board that fits on a printer
SQUARE_PX = 280  # of a square when it is drawn: a multiple of the seven cells of a marker with its border
MARGIN_MM = 8.0  # printers leave 4 to 6 mm
PAPERS_MM = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "a2": (594.0, 420.0), "letter": (279.4, 215.9)}
NAME = re.compile(
    r"(charuco|chessboard):(\d{1,2})x(\d{1,2}):([\d.]+)mm(?::([\d.]+)mm)?(?::(?:DICT_)?(\w+))?", re.IGNORECASE
)


@dataclass(frozen=True)
class Board:
    """``columns`` x ``rows``: squares of a ChArUco board, inner corners of a chessboard; lengths in millimetres."""

    kind: str  # "charuco", "chessboard"
    columns: int
    rows: int
    square_mm: float
    marker_mm: float = 0.0
    dictionary: str = DICTIONARY

    @property
    def squares(self) -> tuple[int, int]:
        more = 1 if self.kind == "chessboard" else 0
        return self.columns + more, self.rows + more

    @cached_property
    def corners_mm(self) -> np.ndarray:
        """Inner corners (N, 3), z 0, in the order of their numbers."""
        if self.kind == "charuco":
            return np.asarray(self._charuco.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return self.square_mm * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    @cached_property
    def _charuco(self) -> Any:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, self.marker_mm, markers)

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._charuco)

    def find(self, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image (H, W) -> numbers (N,) of the corners that are seen, and their pixels (N, 2)."""
        if self.kind == "charuco":
            px, ids, _, _ = self._detector.detectBoard(grey)
            if ids is not None and len(ids):
                return np.asarray(ids).reshape(-1), np.asarray(px, dtype=np.float64).reshape(-1, 2)
        else:
            found, px = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), flags=cv2.CALIB_CB_ACCURACY)
            if found:
                return np.arange(self.columns * self.rows), np.asarray(px, dtype=np.float64).reshape(-1, 2)
        return np.empty(0, dtype=int), np.empty((0, 2))

    def picture(self) -> np.ndarray:
        """(H, W) uint8, SQUARE_PX for each square, no border."""
        across, down = self.squares
        size = across * SQUARE_PX, down * SQUARE_PX
        if self.kind == "charuco":
            return np.asarray(self._charuco.generateImage(size, marginSize=0, borderBits=1))
        x, y = np.meshgrid(np.arange(across), np.arange(down))
        return np.kron(255 * ((x + y) % 2), np.ones((SQUARE_PX, SQUARE_PX))).astype(np.uint8)


def parse_board(text: str) -> Board:
    """'charuco:8x6:30mm[:22mm][:5X5_250]' or 'chessboard:9x6:25mm' -> the board. Raises UsageError."""
    found = NAME.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"--board {text}: write charuco:COLUMNSxROWS:SQUAREmm (squares), such as charuco:8x6:30mm, or "
            "chessboard:COLUMNSxROWS:SQUAREmm (inner corners), such as chessboard:9x6:25mm"
        )
    kind, columns, rows, square, marker, dictionary = found.groups()
    square_mm = float(square)
    marker_mm = float(marker) if marker else MARKER_SHARE * square_mm
    name = (dictionary or DICTIONARY).upper()
    if min(int(columns), int(rows)) < 3 or not 0.0 < marker_mm < square_mm:
        raise UsageError(f"--board {text}: at least 3x3, squares above 0 mm, and markers smaller than squares")
    if not hasattr(cv2.aruco, f"DICT_{name}"):
        raise UsageError(f"--board {text}: no dictionary DICT_{name} of ArUco; {DICTIONARY} is the default")
    return Board(kind.lower(), int(columns), int(rows), square_mm, marker_mm, name)


def print_board(board: Board, out: Path, paper: str) -> str:
    """Writes a page of ``paper`` at true scale as PDF or PNG; -> one line about it. Raises UsageError, OutputError."""
    if out.suffix.lower() not in (".pdf", ".png"):
        raise UsageError(f"--out {out}: a board is written as .pdf or .png")
    if paper not in PAPERS_MM:
        raise UsageError(f"--paper {paper}: known are {', '.join(PAPERS_MM)}")
    across_mm, down_mm = (count * board.square_mm for count in board.squares)
    width_mm, height_mm = PAPERS_MM[paper]
    if across_mm > width_mm - 2 * MARGIN_MM or down_mm > height_mm - 2 * MARGIN_MM:
        largest = min((width_mm - 2 * MARGIN_MM) / board.squares[0], (height_mm - 2 * MARGIN_MM) / board.squares[1])
        raise UsageError(
            f"{across_mm:g} x {down_mm:g} mm do not fit on {paper}; take squares of {int(largest)} mm, or another "
            "--paper"
        )
    px_per_mm = SQUARE_PX / board.square_mm
    page = Picture.new("L", (round(width_mm * px_per_mm), round(height_mm * px_per_mm)), 255)
    picture = Picture.fromarray(board.picture())
    left, top = (page.width - picture.width) // 2, (page.height - picture.height) // 2
    page.paste(picture, (left, top))
    note = (
        f"{board.kind} {board.columns}x{board.rows}, squares {board.square_mm:g} mm; print at 100 %, measure a square"
    )
    ImageDraw.Draw(page).text((left, top + picture.height + px_per_mm), note, fill=0, font_size=4 * px_per_mm)
    dpi = 25.4 * px_per_mm
    try:
        if out.suffix.lower() == ".pdf":
            page.save(out, resolution=dpi)
        else:
            page.save(out, dpi=(dpi, dpi))
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    return f"{out}: {paper}, {across_mm:g} x {down_mm:g} mm; print without scaling, and glue it on a flat plate"
