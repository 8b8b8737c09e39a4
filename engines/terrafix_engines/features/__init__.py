"""Dense describers: image in, descriptors out."""

from pathlib import Path

from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.features.xfeat import XFeatDescriber


def open_describer(xfeat: str) -> GradientDescriber | XFeatDescriber:
    """XFeat when its ONNX file is named, else oriented gradients. Raises ModelFileError."""
    return XFeatDescriber(Path(xfeat)) if xfeat else GradientDescriber()
