"""Image features: dense describers for the map matcher, keypoint detectors and matchers. One file per model."""

from pathlib import Path

from terrafix_engines.features import xfeat as xfeat_model
from terrafix_engines.features.exported import ExportedDetector
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.features.keypoints import Detector, MutualNearestMatcher
from terrafix_engines.features.lightglue import LightGlueMatcher
from terrafix_engines.features.xfeat import XFeatDescriber, XFeatDetector
from terrafix_engines.manifest import DENSE_OUTPUTS, ManifestError, find_manifest
from terrafix_engines.runtime import Model, ModelFileError
from terrafix_engines.store import ENGINES, StoredModel, models_folder, resolve_model, stored_model


def open_describer(xfeat: str, folder: str = "") -> GradientDescriber | XFeatDescriber:
    """XFeat when ``xfeat`` is an ONNX file or the name of a fetched model; oriented gradients when it is empty.

    ``folder``: models folder, see ``models_folder``. Raises ModelFileError."""
    if not xfeat:
        return GradientDescriber()
    where = models_folder(folder)
    found = resolve_model(xfeat, XFeatDescriber.name, where)
    if isinstance(found, StoredModel):
        return XFeatDescriber(found.open(xfeat_model.INPUTS, xfeat_model.DESCRIPTORS_ONLY), found.manifest)
    return _open_user_xfeat(found, where)


def open_detector(model: StoredModel) -> Detector:
    """Detector for a model with role "dense" or "keypoints". Raises ModelFileError."""
    if model.manifest.role == "dense":
        return XFeatDetector(model.open(xfeat_model.INPUTS, DENSE_OUTPUTS), model.manifest)
    return ExportedDetector(model.open(*ExportedDetector.names(model.manifest)), model.manifest)


def open_point_features(name: str, folder: str = "") -> tuple[Detector, MutualNearestMatcher | LightGlueMatcher]:
    """Detector and matcher of the fetched model ``name``. One with role "dense" or "keypoints" is matched by mutual
    nearest neighbours; one with role "matcher" takes the keypoints that it was trained on. ``folder``: models folder,
    see ``models_folder``. Raises ModelFileError."""
    where = models_folder(folder)
    try:
        manifest = find_manifest(name, where)
        features = manifest if manifest.matcher is None else find_manifest(manifest.matcher.features, where)
    except ManifestError as error:
        raise ModelFileError(str(error)) from None
    for wanted, roles in ((manifest, ("dense", "keypoints", "matcher")), (features, ("dense", "keypoints"))):
        if wanted.role not in roles:
            raise ModelFileError(f"the model '{wanted.name}' has no keypoints: its role is {wanted.role}")
    matcher = MutualNearestMatcher() if manifest is features else open_matcher(stored_model(manifest, where))
    return open_detector(stored_model(features, where)), matcher


def open_matcher(model: StoredModel) -> LightGlueMatcher:
    """Keypoint matcher for a model with role "matcher". Raises ModelFileError."""
    return LightGlueMatcher(model.open(*LightGlueMatcher.names(model.manifest)), model.manifest)


def _open_user_xfeat(path: Path, folder: Path) -> XFeatDescriber:
    """A user's own file with XFeat's tensors; the checksum is not verified."""
    try:
        manifest = find_manifest(XFeatDescriber.name, folder)
    except ManifestError as error:
        raise ModelFileError(str(error)) from None
    model = Model(path, xfeat_model.INPUTS, xfeat_model.DESCRIPTORS_ONLY, manifest=manifest, engines=folder / ENGINES)
    return XFeatDescriber(model, manifest)
