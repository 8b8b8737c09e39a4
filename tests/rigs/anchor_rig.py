"""An AnchorNode with a map that is one image of textured ground."""

from typing import Any

import msgspec
import numpy as np

from single_map_place import ORIGIN, SingleMapPackage
from terrafix.anchor.node import AnchorNode
from terrafix.core.frames import MemoryFrameStore
from terrafix_engines.features.gradient import GradientDescriber


def started(ground: np.ndarray, start_sigma_m: float = 10.0) -> tuple[AnchorNode, MemoryFrameStore]:
    """-> an AnchorNode that has received the Origin, and its frame store. ``ground``: (H, W, 3) uint8."""
    package: Any = SingleMapPackage(ground)
    frames = MemoryFrameStore(8)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    origin = msgspec.structs.replace(ORIGIN, start_sigma_m=start_sigma_m)
    assert list(node.on(origin)) == []
    return node, frames
