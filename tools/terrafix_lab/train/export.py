"""Exports the network as ONNX with its manifest, as a models folder for `terrafix models`."""

import copy
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import torch

from terrafix_engines.manifest import ManifestError, read
from terrafix_engines.runtime import Model, ModelFileError
from terrafix_lab.train.errors import TrainingError
from terrafix_lab.train.network import CHANNELS, STRIDE, FeatureNetwork

INPUT, OUTPUTS = "input", ("descriptors",)
OPSET = 18
MULTIPLE = 32  # of the image sides; twice the network's stride, matches the GPU presets
SIDES = (320, 640, 960, 1280)  # px: a map tile with its margin; rectified frames by field of view and heading
TRACED_SIDES = (96, 64)  # px; arbitrary, but must differ


@dataclass(frozen=True)
class ManifestText:
    """Descriptive fields of the manifest. ``inputs``: name, use, licence and sha256 of everything it was made from."""

    name: str
    credit: str
    inputs: list[dict[str, str]]

    @property
    def licence(self) -> str:
        return "; ".join(sorted({one["licence"] for one in self.inputs}))


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
    """The manifest as TOML (strings as in JSON); the inputs of the training are comments, which nobody else reads."""
    presets = "".join(f"\n[[presets]]\nsizes = {{ batch = 1, height = {side}, width = {side} }}\n" for side in SIDES)
    made_from = "".join(
        f"# {one['use']}: {one['name']}, sha256 {one['sha256']}, {one['licence']}\n" for one in text_fields.inputs
    )
    return f"""{made_from}name = {json.dumps(text_fields.name)}
title = "trained by terrafix_lab.train: dense descriptors of cells of {STRIDE} px"
role = "dense"
file = {json.dumps(file)}
sha256 = "{hashlib.sha256(content).hexdigest()}"
size_bytes = {len(content)}
licence = {json.dumps(text_fields.licence)}
credit = {json.dumps(text_fields.credit)}

[image]
input = "{INPUT}"
colour = "rgb"
multiple = {MULTIPLE}

[[inputs]]
name = "{INPUT}"
shape = ["batch", 3, "height", "width"]

[[outputs]]
name = "{OUTPUTS[0]}"
shape = ["batch", {CHANNELS}, "height/{STRIDE}", "width/{STRIDE}"]
{presets}"""
