"""A calibration in words, and as a picture."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from terrafix.core.errors import OutputError
from terrafix_tools.camera.calibrating import MIN_CORNERS, BoardView, LensFit

ARROW_SHARE = 0.03  # of the image width: length of an arrow as long as the RMS of the residuals


def fit_lines(fit: LensFit, looked_at: int, views: Sequence[BoardView]) -> Iterator[str]:
    """What was used, the residuals, and each parameter with its 1-sigma."""
    per_view = [float(np.sqrt(np.square(r).sum(axis=1).mean())) for r in fit.residuals]
    used = [view.name for view in views if len(view.ids) >= MIN_CORNERS]
    worst = int(np.argmax(per_view))
    yield f"{len(per_view)} views of {looked_at} images, {sum(map(len, fit.residuals))} corners, model {fit.model}"
    yield f"residuals: RMS {fit.rms_px:.3f} px, worst view {used[worst]} with {per_view[worst]:.3f} px"
    about_x, about_y = np.ptp(fit.tilts_deg, axis=0)
    yield f"tilts: over {about_x:.0f} degrees up and down, {about_y:.0f} degrees left and right"
    for name, value, sigma in zip(fit.names, fit.values, fit.sigmas, strict=True):
        yield f"  {name} = {value:.6g} +- {sigma:.2g}"


def draw(fit: LensFit, views: Sequence[BoardView], out: Path) -> None:
    """Writes a PNG: every corner of every view, with its residual as an arrow, enlarged. Raises OutputError."""
    width, height = fit.size
    picture = np.full((height, width, 3), 255, np.uint8)
    for i in (1, 2):
        cv2.line(picture, (i * width // 3, 0), (i * width // 3, height), (225, 225, 225), 1)
        cv2.line(picture, (0, i * height // 3), (width, i * height // 3), (225, 225, 225), 1)
    enlarged = ARROW_SHARE * width / max(fit.rms_px, 1e-9)
    used = [view for view in views if len(view.ids) >= MIN_CORNERS]
    for i, (view, residual) in enumerate(zip(used, fit.residuals, strict=True)):
        hue = cv2.cvtColor(np.array([[[i * 180 // len(used), 220, 170]]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0].tolist()
        for at, off in zip(view.px, residual, strict=True):
            tip = tuple(int(v) for v in np.rint(at + enlarged * off))
            cv2.arrowedLine(picture, tuple(int(v) for v in np.rint(at)), tip, hue, 1, cv2.LINE_AA, tipLength=0.3)
    text = f"RMS {fit.rms_px:.3f} px, arrows x{enlarged:.0f}"
    cv2.putText(picture, text, (8, height - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (60, 60, 60), 1, cv2.LINE_AA)
    if not cv2.imwrite(str(out), picture):
        raise OutputError(f"{out}: cannot be written; choose another --out")
