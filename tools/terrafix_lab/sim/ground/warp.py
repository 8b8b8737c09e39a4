"""Fast mapping from the local frame of a flight to the pixels of a raster in any projected CRS."""

from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from rasterio.transform import Affine

from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame, local_crs

GRID = 24  # points per side of the fit
MAX_DISTANCE_M = 100_000.0  # largest distance of the ground from the flight's origin
MAX_ERROR_PX = 0.02  # largest error of the polynomial; two map projections differ by a cubic to a millimetre over 50 km


@dataclass(frozen=True)
class Warp:
    """Cubic polynomials of east and north around the centre of the raster; pixel centres at integers."""

    centre_m: tuple[float, float]
    scale_m: float
    coefficients: np.ndarray  # (10, 2)

    def __call__(self, e_m: np.ndarray, n_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Maps local points of any shape to (column, row), float64, of the same shape."""
        e_m, n_m = np.asarray(e_m, np.float64), np.asarray(n_m, np.float64)
        terms = _terms((e_m - self.centre_m[0]) / self.scale_m, (n_m - self.centre_m[1]) / self.scale_m)
        px = np.tensordot(self.coefficients, terms, axes=(0, 0))
        return px[0], px[1]


def _terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    one = np.ones_like(x)
    return np.stack([one, x, y, x * x, x * y, y * y, x * x * x, x * x * y, x * y * y, y * y * y])


def fit(crs_from_px: Affine, shape: tuple[int, int], crs: CRS, frame: LocalFrame, name: str = "the image") -> Warp:
    """Fits the warp of a raster of (rows, columns). Raises MapError: too far away or too large for one frame."""
    rows, columns = shape
    back = Transformer.from_crs(crs, local_crs(frame.lat_deg, frame.lon_deg), always_xy=True)
    x, y = (
        axis.ravel() for axis in np.meshgrid(np.linspace(0, columns, 2 * GRID + 1), np.linspace(0, rows, 2 * GRID + 1))
    )
    e_m, n_m = back.transform(
        crs_from_px.a * x + crs_from_px.b * y + crs_from_px.c, crs_from_px.d * x + crs_from_px.e * y + crs_from_px.f
    )
    if not (np.isfinite(e_m).all() and np.isfinite(n_m).all() and np.hypot(e_m, n_m).min() < MAX_DISTANCE_M):
        raise MapError(f"{name}: is not near the flight; check its coordinate system and the start")
    centre = float((e_m.min() + e_m.max()) / 2), float((n_m.min() + n_m.max()) / 2)
    scale_m = float(max(np.ptp(e_m), np.ptp(n_m))) / 2
    terms = _terms((e_m - centre[0]) / scale_m, (n_m - centre[1]) / scale_m).T
    px = np.column_stack([x - 0.5, y - 0.5])  # an affine of rasterio refers to the corner of a pixel
    fitted = np.arange(len(x)) % 2 == 0  # the other points measure the error
    coefficients = np.linalg.lstsq(terms[fitted], px[fitted], rcond=None)[0]
    error_px = float(np.abs(terms @ coefficients - px).max())
    if error_px > MAX_ERROR_PX:
        raise MapError(
            f"{name}: is too large or too far from the flight for one local frame ({error_px:.2g} px off); cut it"
        )
    return Warp(centre, scale_m, coefficients)
