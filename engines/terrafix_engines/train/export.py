"""The network as ONNX, and its manifest beside it: a models folder as `terrafix models` knows it."""

import copy
import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch

from terrafix_engines.manifest import ManifestError, read
from terrafix_engines.runtime import Model, ModelFileError
from terrafix_engines.train.errors import TrainingError
from terrafix_engines.train.network import CHANNELS, STRIDE, TILE_CHANNELS, Describing

INPUT, OUTPUTS = "input", ("descriptors", "keypoint_logits", "reliability", "tile")
OPSET = 18
MULTIPLE = 32  # of the sides of a picture: twice what the strides need, as the presets of a GPU have it
SIDES = (320, 640, 960, 1280)  # a tile of the map with its rim; rectified frames by field of view and heading
TRACED_SIDES = (96, 64)  # any that are not alike


@dataclass(frozen=True)
class Words:
    """Of the manifest, for people."""

    name: str
    licence: str
    credit: str


def export(network: Describing, folder: Path, words: Words) -> Path:
    """Writes NAME.onnx and NAME.toml, and opens them as a flight would. Raises TrainingError."""
    path = folder / f"{words.name}.onnx"
    alone = copy.deepcopy(network).cpu().eval()
    batch, height, width = (torch.export.Dim(name) for name in ("batch", "height32", "width32"))
    torch.onnx.export(
        alone,
        (torch.rand(2, 3, *TRACED_SIDES),),
        str(path),
        input_names=[INPUT],
        output_names=list(OUTPUTS),
        dynamic_shapes=({0: batch, 2: MULTIPLE * height, 3: MULTIPLE * width},),
        opset_version=OPSET,
        external_data=False,
        dynamo=True,
        verbose=False,
    )
    content = path.read_bytes()
    described = path.with_suffix(".toml")
    described.write_text(manifest(words, path.name, content), encoding="utf-8")
    try:
        Model(path, (INPUT,), OUTPUTS, manifest=read(described), exact=True)
    except (ManifestError, ModelFileError) as error:
        raise TrainingError(f"{error}; --name may be at fault") from None
    return path


def manifest(words: Words, file: str, content: bytes) -> str:
    """TOML."""
    shapes = {
        "descriptors": f'["batch", {CHANNELS}, "height/{STRIDE}", "width/{STRIDE}"]',
        "keypoint_logits": f'["batch", {STRIDE**2 + 1}, "height/{STRIDE}", "width/{STRIDE}"]',
        "reliability": f'["batch", 1, "height/{STRIDE}", "width/{STRIDE}"]',
        "tile": f'["batch", {TILE_CHANNELS}]',
    }
    outputs = "".join(f'\n[[outputs]]\nname = "{name}"\nshape = {shapes[name]}\n' for name in OUTPUTS)
    presets = "".join(f"\n[[presets]]\nsizes = {{ batch = 1, height = {side}, width = {side} }}\n" for side in SIDES)
    return f"""name = {_quoted(words.name)}
title = "trained by terrafix_engines.train: dense descriptors, keypoints, reliability, a descriptor of the tile"
role = "dense"
file = {_quoted(file)}
sha256 = "{hashlib.sha256(content).hexdigest()}"
size_bytes = {len(content)}
licence = {_quoted(words.licence)}
credit = {_quoted(words.credit)}

[image]
input = "{INPUT}"
colour = "rgb"
multiple = {MULTIPLE}

[[inputs]]
name = "{INPUT}"
shape = ["batch", 3, "height", "width"]
{outputs}{presets}"""


def _quoted(text: str) -> str:
    """A TOML string on one line."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
