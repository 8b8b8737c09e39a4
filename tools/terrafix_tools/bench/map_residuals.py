"""What the reprojection error of map matches is made of: python -m terrafix_tools.bench.map_residuals FOLDER

FOLDER: the output of a replay. Every part is the mean length of what is left of the error of the matched points when
one cause is taken out; the causes overlap, so the parts do not add up."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.anchor.matching.frame_matcher import FIX_GSD_PER_AGL
from terrafix.core.camera import distort_division
from terrafix.core.pnp import solve, solved
from terrafix.messages import MapMatch, Origin, Verdict
from terrafix.recorder.reader import read_flight
from terrafix_tools.accept.measuring.map_distortion import Residuals, left_by_local_model, mean_px, residuals
from terrafix_tools.finalise.batch_smoother import smooth
from terrafix_tools.finalise.lens import Lens
from terrafix_tools.finalise.run import flights_of
from terrafix_tools.standalone import run_standalone

MIN_AFFINE_POINTS = 8  # of a frame, for the six numbers of an affine displacement
UNIFORM_LENGTH = 0.3826  # mean distance of a point in a unit square from its centre


def measure(folder: Path) -> list[tuple[str, float]]:
    """-> what is taken out, and the mean length that is left, pixels of the stored frames."""
    messages = [message for _, _, message in read_flight(folder)]
    focal_px = next(m for m in messages if isinstance(m, Origin)).camera.fx
    received = [m for m in messages if isinstance(m, MapMatch) and m.verdict is Verdict.ACCEPTED and m.matches]
    found, single, of_single = list[Residuals](), list[MapMatch](), list[Residuals]()
    for match in received:
        placed = solved(match)
        if placed.pose is None:
            continue
        found.append(residuals(placed, focal_px))
        if match.pnp is not None:
            single.append(match)
            of_single.append(found[-1])
    lens = smooth(flights_of(folder)[0]).lens
    off_m = [f.off_m for f in found]
    height_m = float(np.mean([f.height_m for f in found]))
    cell_px = FIX_GSD_PER_AGL["gradient"] * focal_px
    return [
        ("nothing: all accepted matches", mean_px(found, off_m)),
        ("nothing: those whose pose PnP computes", mean_px(of_single, [f.off_m for f in of_single])),
        ("... lens of finalise (same points, PnP again)", _through(lens, single, focal_px)),
        ("affine displacement of the map in each frame", mean_px(found, [_less_affine(f) for f in found])),
        ("local distortion of the map, by other frames", mean_px(found, left_by_local_model(found))),
        ("relief: part along the ray beyond that across it", mean_px(found, [_less_relief(f) for f in found])),
        ("a cell of the matched patches, side", cell_px),
        ("... mean length of a uniform error within a cell", UNIFORM_LENGTH * cell_px),
        ("mean height, m", height_m),
    ]


def _through(lens: Lens, matches: Sequence[MapMatch], focal_px: float) -> float:
    """Mean length with poses by PnP through another lens, in pixels of the same frame."""
    lengths = []
    for match in matches:
        rows = np.array(match.matches)
        assert match.pnp is not None
        described = distort_division(rows[:, :2], match.radial_k1) if match.radial_k1 else rows[:, :2]
        fit = solve(rows[:, 2:5], lens.rays(described), rows[:, 5], match.pnp).fit
        if fit is not None:
            lengths.append(float(fit.residuals.mean()) * focal_px * float(np.exp(lens.log_focal)))
    return float(np.mean(lengths))


def _less_affine(frame: Residuals) -> np.ndarray:
    """(N, 2) less an affine function of the place; with the degrees of freedom that it takes counted."""
    n = len(frame.map_m)
    if n < MIN_AFFINE_POINTS:
        return frame.off_m
    design = np.column_stack([np.ones(n), frame.map_m - frame.map_m.mean(axis=0)])
    left = frame.off_m - design @ np.linalg.lstsq(design, frame.off_m, rcond=None)[0]
    return np.asarray(left * np.sqrt(n / (n - design.shape[1])))


def _less_relief(frame: Residuals) -> np.ndarray:
    """(N, 2) with the component away from the camera as small as the one across: height displaces a point along its
    ray alone."""
    along = np.sum(frame.off_m * frame.outward, axis=1)
    across = frame.off_m - along[:, None] * frame.outward
    share = min(1.0, float(np.sqrt(np.mean(across**2) * 2.0 / max(float(np.mean(along**2)), 1e-12))))
    return np.asarray(across + share * along[:, None] * frame.outward)


def main(folder: Annotated[Path, typer.Argument(help="Output of a replay.")]) -> None:
    table = Table(title="Map matches: mean error when a cause is taken out", title_justify="left")
    table.add_column("taken out")
    table.add_column("px", justify="right")
    for name, px in measure(folder):
        table.add_row(name, f"{px:.2f}")
    Console().print(table)


if __name__ == "__main__":
    run_standalone("bench.map_residuals", main)
