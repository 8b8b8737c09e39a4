"""An AnchorNode over one piece of textured ground."""

from typing import Any

import msgspec
import numpy as np

from one_place import ORIGIN, OnlyMap
from terrafix.anchor.node import AnchorNode
from terrafix.core.frames import MemoryFrameStore
from terrafix_engines.features.gradient import GradientDescriber


def started(ground: np.ndarray, start_sigma_m: float = 10.0) -> tuple[AnchorNode, MemoryFrameStore]:
    package: Any = OnlyMap(ground)
    frames = MemoryFrameStore(8)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    origin = msgspec.structs.replace(ORIGIN, start_sigma_m=start_sigma_m)
    assert list(node.on(origin)) == []
    return node, frames
