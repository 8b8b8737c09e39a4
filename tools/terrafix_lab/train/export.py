"""Exports the network as ONNX with its manifest, as a models folder for `terrafix models`."""

import copy
import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch

from terrafix_engines.manifest import ManifestError, read
from terrafix_engines.runtime import Model, ModelFileError
from terrafix_lab.train.errors import TrainingError
from terrafix_lab.train.network import CHANNELS, STRIDE, TILE_CHANNELS, FeatureNetwork

INPUT, OUTPUTS = "input", ("descriptors", "keypoint_logits", "reliability", "tile")
OPSET = 18
MULTIPLE = 32  # of the image sides; twice the network's stride, matches the GPU presets
SIDES = (320, 640, 960, 1280)  # px: a map tile with its margin; rectified frames by field of view and heading
TRACED_SIDES = (96, 64)  # px; arbitrary, but must differ


@dataclass(frozen=True)
class ManifestText:
    """Descriptive text fields of the manifest."""

    name: str
    licence: str
    credit: str


def export(network: FeatureNetwork, folder: Path, text_fields: ManifestText) -> Path:
    """Writes NAME.onnx and NAME.toml and opens them the way the daemon does. Raises TrainingError."""
    path = folder / f"{text_fields.name}.onnx"
    network_copy = copy.deepcopy(network).cpu().eval()
    batch, height, width = (torch.export.Dim(name) for name in ("batch", "height32", "width32"))
    torch.onnx.export(
        network_copy,
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
    manifest_path = path.with_suffix(".toml")
    manifest_path.write_text(manifest(text_fields, path.name, content), encoding="utf-8")
    try:
        Model(path, (INPUT,), OUTPUTS, manifest=read(manifest_path), exact=True)
    except (ManifestError, ModelFileError) as error:
        raise TrainingError(f"{error}; check --name") from None
    return path


def manifest(text_fields: ManifestText, file: str, content: bytes) -> str:
    """The manifest as TOML."""
    shapes = {
        "descriptors": f'["batch", {CHANNELS}, "height/{STRIDE}", "width/{STRIDE}"]',
        "keypoint_logits": f'["batch", {STRIDE**2 + 1}, "height/{STRIDE}", "width/{STRIDE}"]',
        "reliability": f'["batch", 1, "height/{STRIDE}", "width/{STRIDE}"]',
        "tile": f'["batch", {TILE_CHANNELS}]',
    }
    outputs = "".join(f'\n[[outputs]]\nname = "{name}"\nshape = {shapes[name]}\n' for name in OUTPUTS)
    presets = "".join(f"\n[[presets]]\nsizes = {{ batch = 1, height = {side}, width = {side} }}\n" for side in SIDES)
    return f"""name = {_quoted(text_fields.name)}
title = "trained by terrafix_lab.train: dense descriptors, keypoints, reliability, a descriptor of the tile"
role = "dense"
file = {_quoted(file)}
sha256 = "{hashlib.sha256(content).hexdigest()}"
size_bytes = {len(content)}
licence = {_quoted(text_fields.licence)}
credit = {_quoted(text_fields.credit)}

[image]
input = "{INPUT}"
colour = "rgb"
multiple = {MULTIPLE}

[[inputs]]
name = "{INPUT}"
shape = ["batch", 3, "height", "width"]
{outputs}{presets}"""


def _quoted(text: str) -> str:
    """A one-line TOML string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
