"""Features of images: dense describers for the map matcher, detectors and matchers of points. One file a model."""

from pathlib import Path

from terrafix_engines.features import xfeat as xfeat_model
from terrafix_engines.features.exported import ExportedDetector
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.features.keypoints import Detector
from terrafix_engines.features.lightglue import LightGlueMatcher
from terrafix_engines.features.semidense import SemiDenseMatcher
from terrafix_engines.features.xfeat import XFeatDescriber, XFeatDetector
from terrafix_engines.manifest import DENSE_OUTPUTS, ManifestError, named
from terrafix_engines.runtime import Model, ModelFileError
from terrafix_engines.store import ENGINES, Stored, find, models_folder


def open_describer(xfeat: str, folder: str = "") -> GradientDescriber | XFeatDescriber:
    """XFeat when its ONNX file or the name of a fetched model is given, else oriented gradients. ``folder``: of models,
    see ``models_folder``. Raises ModelFileError."""
    if not xfeat:
        return GradientDescriber()
    where = models_folder(folder)
    found = find(xfeat, XFeatDescriber.name, where)
    if isinstance(found, Stored):
        return XFeatDescriber(found.open(xfeat_model.INPUTS, xfeat_model.DESCRIPTORS_ONLY), found.manifest)
    return _own_xfeat(found, where)


def open_detector(model: Stored) -> Detector:
    """Of a model whose role is "dense" or "keypoints". Raises ModelFileError."""
    if model.manifest.role == "dense":
        return XFeatDetector(model.open(xfeat_model.INPUTS, DENSE_OUTPUTS), model.manifest)
    return ExportedDetector(model.open(*ExportedDetector.names(model.manifest)), model.manifest)


def open_matcher(model: Stored) -> LightGlueMatcher:
    """Of a model whose role is "matcher". Raises ModelFileError."""
    return LightGlueMatcher(model.open(*LightGlueMatcher.names(model.manifest)), model.manifest)


def open_picture_matcher(model: Stored) -> SemiDenseMatcher:
    """Of a model whose role is "pair". Raises ModelFileError."""
    return SemiDenseMatcher(model.open(*SemiDenseMatcher.names(model.manifest)), model.manifest)


def _own_xfeat(path: Path, folder: Path) -> XFeatDescriber:
    """A file of the user's own with the tensors of XFeat, whatever its checksum."""
    try:
        manifest = named(XFeatDescriber.name, folder)
    except ManifestError as error:
        raise ModelFileError(str(error)) from None
    model = Model(path, xfeat_model.INPUTS, xfeat_model.DESCRIPTORS_ONLY, manifest=manifest, engines=folder / ENGINES)
    return XFeatDescriber(model, manifest)
