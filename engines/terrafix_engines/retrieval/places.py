"""Place descriptors: one vector for a disc of ground, the same function for map and frame.

A descriptor is made from a square image, north up, of which only the disc that touches its sides counts: a frame shows
that disc completely at whatever heading. Vectors have length one; their scalar product is the similarity."""

from typing import Protocol

import cv2
import numpy as np

from terrafix_engines.features import open_describer
from terrafix_engines.features.gradient import CHANNELS, GradientDescriber
from terrafix_engines.features.image_input import image_tensor
from terrafix_engines.features.keypoints import unit_rows
from terrafix_engines.features.xfeat import XFeatDescriber
from terrafix_engines.manifest import Manifest, ManifestError, find_manifest
from terrafix_engines.runtime import Model, ModelFileError, ModelRunError
from terrafix_engines.store import models_folder, stored_model

POOLED_GRADIENT = "pooled-gradient"  # the descriptor without weights
BINS = 4  # bins per side of the square: a quarter of the square, the spacing of the map's discs, is one bin
GRADIENT_SIDE_PX = 48  # the pixels of the search on coarse cells, a 52nd of the height, for a disc of 0.9 heights
FEATURE_SIDE_PX = 128  # 16 cells of 8 px of the learned features
RIM_PX = 1.0  # of the disc: the gradient of its outermost pixels would contain the ground beyond


class PlaceDescriber(Protocol):
    """``name``: of descriptor, version and weights; vectors of different names cannot be compared. ``side_px``: side of
    the square images; ``size``: length of the vectors."""

    name: str
    side_px: int
    size: int

    def describe(self, squares: np.ndarray) -> np.ndarray:
        """(N, side_px, side_px, 3) uint8 BGR, north up -> (N, size) float32 unit vectors. Raises ModelRunError."""
        ...


class PooledGradientPlaces:
    """Histograms of oriented gradients (Dalal and Triggs, CVPR 2005) of BINS x BINS bins over the disc, minus the
    mean of each orientation."""

    name = f"{POOLED_GRADIENT}-places-1"  # increment it when the descriptor of the same ground changes
    side_px = GRADIENT_SIDE_PX
    size = CHANNELS * BINS**2

    def __init__(self) -> None:
        self._dense = GradientDescriber()
        self._disc = disc(self.side_px, RIM_PX)

    def describe(self, squares: np.ndarray) -> np.ndarray:
        return np.array([pooled(self._dense.describe(one), self._disc) for one in squares], np.float32)


class PooledFeaturePlaces:
    """Learned dense features (XFeat), pooled in the same way."""

    side_px = FEATURE_SIDE_PX

    def __init__(self, describer: XFeatDescriber) -> None:
        self._dense = describer
        self.name = f"pooled-{describer.name}-places-1-{describer.model.sha256[:12]}"
        self.size = describer.channels * BINS**2
        self._disc = disc(self.side_px // describer.stride, RIM_PX / describer.stride)

    def describe(self, squares: np.ndarray) -> np.ndarray:
        return np.array([pooled(self._dense.describe(one), self._disc) for one in squares], np.float32)


class GlobalModelPlaces:
    """A model that makes one vector of an image (role "global"), such as an export of DINOv2. Ground outside the disc
    is replaced by the mean colour of the disc."""

    def __init__(self, model: Model, manifest: Manifest) -> None:
        """``model`` was opened with the tensor names of ``names``."""
        assert manifest.image is not None and manifest.vector is not None
        self._model, self._image = model, manifest.image
        self.name = f"{manifest.name}-{model.sha256[:12]}"
        self.side_px = manifest.vector.side_px
        self.size = manifest.vector.size
        self._disc = disc(self.side_px, 0.0)

    @staticmethod
    def names(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the inputs and outputs in use."""
        assert manifest.image is not None and manifest.vector is not None
        return (manifest.image.input,), (manifest.vector.output,)

    def describe(self, squares: np.ndarray) -> np.ndarray:
        return unit_rows(np.array([self._describe_one(one) for one in squares]))

    def _describe_one(self, square: np.ndarray) -> np.ndarray:
        inside = self._disc > 0
        masked = np.where(inside[:, :, None], square, square[inside].mean(axis=0)).astype(np.uint8)
        size = self._model.side_lengths(*masked.shape[:2])
        (vector,) = self._model.run(image_tensor(masked, self._image, *size))
        if vector.size != self.size:
            raise ModelRunError(f"{self.name}: a vector of {vector.size} numbers, not {self.size}; check its manifest")
        return vector.ravel()


def open_place_describer(name: str, folder: str = "") -> PlaceDescriber:
    """``name``: "pooled-gradient", or the name of a fetched model with the role "dense" or "global".

    ``folder``: models folder, see ``models_folder``. Raises ModelFileError."""
    if name == POOLED_GRADIENT:
        return PooledGradientPlaces()
    where = models_folder(folder)
    try:
        manifest = find_manifest(name, where)
    except ManifestError as error:
        raise ModelFileError(f"{error}; or {POOLED_GRADIENT}, which needs no model") from None
    if manifest.role == "global":
        model = stored_model(manifest, where).open(*GlobalModelPlaces.names(manifest))
        return GlobalModelPlaces(model, manifest)
    if manifest.role == "dense":
        describer = open_describer(name, str(where))
        assert isinstance(describer, XFeatDescriber)
        return PooledFeaturePlaces(describer)
    raise ModelFileError(f"the model '{name}' cannot describe places: its role is {manifest.role}, not dense or global")


def disc(side: int, rim: float) -> np.ndarray:
    """-> (side, side) float32: 1 within the largest disc of a square, less ``rim``, else 0."""
    offset = np.arange(side) - (side - 1) / 2
    return (np.hypot(offset[:, None], offset) <= side / 2 - rim).astype(np.float32)


def pooled(channels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Means of (C, S, S) over BINS x BINS bins with weights (S, S), minus the mean of each channel -> (C * BINS^2,) of
    length one; zero without any structure."""
    size = (BINS, BINS)
    mean = np.einsum("khw,hw->k", channels, weights) / weights.sum()
    centred = (channels - mean[:, None, None]) * weights
    bins = np.array([cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in centred]).ravel()
    return np.asarray(bins / max(float(np.linalg.norm(bins)), 1e-9))
