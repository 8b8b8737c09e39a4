"""ONNX files of a few nodes, so that tests need no real weights."""

import hashlib
import json
from pathlib import Path

import numpy as np

from terrafix_engines.onnx_file import Shape, model, node, tensor, value


def xfeat_like(nan: str = "never") -> bytes:
    """-> a model with the outputs of XFeat, one convolution each. ``nan``: cells whose descriptors are NaN: "never",
    "always", or "blue" (cells of pure blue)."""
    rng = np.random.default_rng(1)
    weights = {name: rng.normal(size=(c, 3, 8, 8)).astype(np.float32) for name, c in (("d", 64), ("k", 65), ("r", 1))}
    red = np.zeros((1, 3, 8, 8), np.float32)
    red[0, 0], red[0, 2] = 1 / 64, -1 / 64  # mean red minus mean blue of a cell
    least = np.array({"never": 9.0, "blue": 0.5, "always": -9.0}[nan], np.float32)
    convolution = {"kernel_shape": [8, 8], "strides": [8, 8]}
    nodes = [
        node("Conv", ["input", "d"], ["plain"], **convolution),
        node("Conv", ["input", "k"], ["keypoint_logits"], **convolution),
        node("Conv", ["input", "r"], ["reliability"], **convolution),
        node("Conv", ["input", "red"], ["redder"], **convolution),
        node("Add", ["redder", "least"], ["above"]),
        node("Sqrt", ["above"], ["root"]),
        node("Mul", ["root", "zero"], ["nothing"]),
        node("Add", ["plain", "nothing"], ["descriptors"]),
    ]
    initializers = [tensor(n, a) for n, a in weights.items()]
    initializers += [tensor("red", red), tensor("least", least), tensor("zero", np.array(0.0, np.float32))]
    outputs = [
        value(n, ["b", c, "h", "w"]) for n, c in (("descriptors", 64), ("keypoint_logits", 65), ("reliability", 1))
    ]
    return model(nodes, initializers, [value("input", ["batch", 3, "height", "width"])], outputs)


def mean_colours(cell_px: int) -> bytes:
    """-> a model of one vector for an image: the mean of each colour of each cell, colour by colour."""
    cell = [cell_px, cell_px]
    nodes = [
        node("AveragePool", ["image"], ["cells"], kernel_shape=cell, strides=cell),
        node("Flatten", ["cells"], ["vector"], axis=1),
    ]
    return model(nodes, [], [value("image", [1, 3, "height", "width"])], [value("vector", [1, "n"])])


def constants(inputs: dict[str, tuple[Shape, str]], outputs: dict[str, np.ndarray]) -> bytes:
    """-> a model whose outputs do not depend on its inputs."""
    nodes = [node("Identity", [f"{name}_is"], [name]) for name in outputs]
    return model(
        nodes,
        [tensor(f"{name}_is", array) for name, array in outputs.items()],
        [value(name, shape, dtype) for name, (shape, dtype) in inputs.items()],
        [value(name, list(array.shape), array.dtype.name) for name, array in outputs.items()],
    )


def described(
    head: str, inputs: dict[str, Shape], outputs: dict[str, Shape], dtypes: dict[str, str] | None = None
) -> str:
    """-> a manifest: ``head`` and the tensors; ``dtypes``: of those that are not float32."""
    text = head
    for kind, tensors in (("inputs", inputs), ("outputs", outputs)):
        for name, shape in tensors.items():
            text += f'[[{kind}]]\nname = "{name}"\nshape = {json.dumps(shape)}\n'
            text += f'dtype = "{dtypes[name]}"\n' if dtypes and name in dtypes else ""
    return text


def write(folder: Path, manifest: str, content: bytes) -> Path:
    """Writes the model NAME.onnx and its manifest with file, sha256 and size. -> path of the model."""
    name = next(line.split('"')[1] for line in manifest.splitlines() if line.startswith("name = "))
    path = folder / f"{name}.onnx"
    path.write_bytes(content)
    head = f'file = "{path.name}"\nsha256 = "{hashlib.sha256(content).hexdigest()}"\nsize_bytes = {len(content)}\n'
    (folder / f"{name}.toml").write_text(head + manifest)
    return path


XFEAT_LIKE = (
    described(
        """name = "tiny"
title = "tensors of XFeat"
role = "dense"
licence = "CC0"
[image]
input = "input"
colour = "rgb"
multiple = 8
""",
        {"input": ["batch", 3, "height", "width"]},
        {
            "descriptors": ["batch", 64, "height/8", "width/8"],
            "keypoint_logits": ["batch", 65, "height/8", "width/8"],
            "reliability": ["batch", 1, "height/8", "width/8"],
        },
    )
    + """[[presets]]
sizes = { batch = 1, height = 32, width = 64 }
[[presets]]
sizes = { batch = 1, height = 64, width = 64 }
"""
)
GLOBAL = described(
    """name = "means"
title = "mean colours of a grid"
role = "global"
licence = "CC0"
[image]
input = "image"
colour = "rgb"
multiple = 14
mean = [0.485, 0.456, 0.406]
std = [0.229, 0.224, 0.225]
[vector]
output = "vector"
size = 12
side_px = 28
""",
    {"image": [1, 3, 28, 28]},
    {"vector": [1, 12]},
)
PAIR = described(
    """name = "both"
title = "an export that is given two pictures"
role = "pair"
licence = "CC0"
[image]
input = "image0"
colour = "gray"
multiple = 8
[pair]
second = "image1"
keypoints = ["mkpts0", "mkpts1"]
scores = "mconf"
""",
    {"image0": [1, 1, "height", "width"], "image1": [1, 1, "height", "width"]},
    {"mkpts0": ["pairs", 2], "mkpts1": ["pairs", 2], "mconf": ["pairs"]},
)
