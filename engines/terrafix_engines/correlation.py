"""Cross-correlation of dense descriptors as an ONNX graph of this project, for TensorRT and CUDA.

Fourier transforms are products with matrices of cosines and sines: MatMul has kernels in every execution provider, in
half precision too, and shapes are static. ONNX's operator DFT has a kernel for the CPU alone (onnxruntime issue 21164),
TensorRT none, and the weights of its Conv must be constants, so that a template cannot be one (onnx-tensorrt,
operators.md). On a processor the matrices are slower than OpenCV's transforms (docs/models.md), which stay in use
there.

A graph is of one side S of the padded square; inputs are real, so that half of the spectrum is enough. Templates are
scaled to unit energy before they are rounded to half precision, and the forward transforms by 1 / sqrt(S), so that no
value overflows."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from terrafix_engines.features.gradient import CHANNELS
from terrafix_engines.manifest import CORRELATION_INPUTS, CORRELATION_OUTPUT, Manifest, find_manifest
from terrafix_engines.onnx_file import TYPES, model, node, tensor, value
from terrafix_engines.providers import CUDA, TENSORRT
from terrafix_engines.runtime import Model, ModelRunError
from terrafix_engines.store import models_folder, stored_model

GPU = (TENSORRT, CUDA)
# Cells: windows of a flight (400 to 720 cells for village-1 and town-a) and of a lost vehicle's belief.
# [measured: docs/models.md]
SIDES = (512, 768)
BATCHES = (1, 3, 9)  # templates of one inference: as predicted; three scales; three headings at each scale
NAME = "correlation-{side}"
MIN_ENERGY = 1e-6  # root of a template's energy, so that an empty one is not divided by zero


def graph(side: int, half: bool = False) -> bytes:
    """-> content of the ONNX file. Inputs: ``images`` (A, CHANNELS, side, side), ``templates`` (B, CHANNELS, side,
    side) float32, zero-padded; A is 1 or B. Output: ``correlation`` (B, side, side) float32: the sum over the channels
    of the circular cross-correlations; cell (r, c): the template's first cell lies at the image's cell (r, c).
    ``half``: transforms in float16."""
    kind = "float16" if half else "float32"
    nodes = [
        node("ReduceL2", ["templates"], ["energies"], axes=[1, 2, 3], keepdims=1),
        node("Max", ["energies", "least"], ["energy"]),
        node("Div", ["templates", "energy"], ["unit"]),
        node("Cast", ["images"], ["images_in"], to=TYPES[kind]),
        node("Cast", ["unit"], ["templates_in"], to=TYPES[kind]),
        *_forward("images_in", "x"),
        *_forward("templates_in", "y"),
        # x times the conjugate of y
        node("Mul", ["x_re", "y_re"], ["re_re"]),
        node("Mul", ["x_im", "y_im"], ["im_im"]),
        node("Mul", ["x_im", "y_re"], ["im_re"]),
        node("Mul", ["x_re", "y_im"], ["re_im"]),
        node("Add", ["re_re", "im_im"], ["p_re"]),
        node("Sub", ["im_re", "re_im"], ["p_im"]),
        node("Concat", ["p_re", "p_im"], ["p"], axis=3),
        node("ReduceSum", ["p", "channel_axis"], ["sum"], keepdims=0),
        # inverse: along the rows e^+i instead of e^-i
        node("MatMul", ["rows", "sum"], ["turned"]),
        *_quarters("turned", "s", axis=1),
        node("Sub", ["s_cos_re", "s_sin_im"], ["g_re"]),
        node("Add", ["s_cos_im", "s_sin_re"], ["g_im"]),
        node("Concat", ["g_re", "g_im"], ["g"], axis=2),
        node("MatMul", ["g", "back"], ["scaled"]),
        node("Cast", ["scaled"], ["scaled_out"], to=TYPES["float32"]),
        node("Squeeze", ["energy", "squeezed_axis"], ["factor"]),
        node("Mul", ["scaled_out", "factor"], [CORRELATION_OUTPUT]),
    ]
    columns, rows, back = (one.astype(kind) for one in _matrices(side))
    constants = {"columns": columns, "rows": rows, "back": back, "least": np.array(MIN_ENERGY, np.float32)}
    constants |= {"channel_axis": np.array([1]), "squeezed_axis": np.array([3])}
    counts = ("images", "templates")
    return model(
        nodes,
        [tensor(name, array) for name, array in constants.items()],
        [value(name, [count, CHANNELS, side, side]) for name, count in zip(CORRELATION_INPUTS, counts, strict=True)],
        [value(CORRELATION_OUTPUT, ["templates", side, side])],
        NAME.format(side=side),
    )


def _forward(source: str, name: str) -> list[bytes]:
    """Nodes of the transform (.., side, side) -> ``name``_re, ``name``_im (.., side, side // 2 + 1)."""
    return [
        node("MatMul", [source, "columns"], [f"{name}_columns"]),
        node("MatMul", ["rows", f"{name}_columns"], [f"{name}_rows"]),
        *_quarters(f"{name}_rows", name, axis=2),
        node("Add", [f"{name}_cos_re", f"{name}_sin_im"], [f"{name}_re"]),
        node("Sub", [f"{name}_cos_im", f"{name}_sin_re"], [f"{name}_im"]),
    ]


def _quarters(source: str, name: str, axis: int) -> list[bytes]:
    """Nodes that split a product with ``rows``: cosines and sines along ``axis``, real and imaginary part after it."""
    nodes = [node("Split", [source], [f"{name}_cos", f"{name}_sin"], axis=axis)]
    for half in ("cos", "sin"):
        nodes.append(node("Split", [f"{name}_{half}"], [f"{name}_{half}_re", f"{name}_{half}_im"], axis=axis + 1))
    return nodes


def _matrices(side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> of the transform of the columns (side, 2 (side // 2 + 1)), real then imaginary part; of the rows (2 side,
    side), cosines then sines; of the inverse of the columns (2 (side // 2 + 1), side)."""
    k = np.arange(side)
    angle = 2.0 * np.pi / side * (np.outer(k, k) % side)  # of small numbers, so that the cosines are exact
    cos, sin, kept = np.cos(angle), np.sin(angle), side // 2 + 1
    root = np.sqrt(side)
    weight = np.full((kept, 1), 2.0)  # the other half of the spectrum is the conjugate of this one
    weight[0] = 1.0
    if side % 2 == 0:
        weight[-1] = 1.0
    columns = np.hstack([cos[:, :kept], -sin[:, :kept]]) / root
    rows = np.vstack([cos, sin]) / root
    return columns, rows, np.vstack([weight * cos[:kept], -weight * sin[:kept]]) * root


def export(folder: Path, half: bool) -> list[Path]:
    """Writes a graph and its manifest for each of SIDES into the models folder. -> the ONNX files. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for side in SIDES:
        content, path = graph(side, half), folder / f"{NAME.format(side=side)}.onnx"
        path.write_bytes(content)
        path.with_suffix(".toml").write_text(_manifest(side, content, half), encoding="utf-8")
        paths.append(path)
    return paths


def _manifest(side: int, content: bytes, half: bool) -> str:
    precision = "fp16" if half else "fp32"
    presets = "".join(
        f'\n[[presets]]\nsizes = {{ images = 1, templates = {count} }}\nprecision = "{precision}"\n'
        for count in BATCHES
    )
    inputs = "".join(
        f'\n[[inputs]]\nname = "{name}"\nshape = ["{name}", {CHANNELS}, {side}, {side}]\n'
        for name in CORRELATION_INPUTS
    )
    return f"""# Written by `terrafix models export`.
name = "{NAME.format(side=side)}"
title = "correlation of gradients with a map window of {side} cells, {precision}"
role = "correlation"
file = "{NAME.format(side=side)}.onnx"
sha256 = "{hashlib.sha256(content).hexdigest()}"
size_bytes = {len(content)}
licence = "that of this program"
{inputs}
[[outputs]]
name = "{CORRELATION_OUTPUT}"
shape = ["templates", {side}, {side}]
{presets}"""


class GraphCorrelator:
    """Correlates templates with an image by the smallest graph that holds it. ``failure``: why it no longer runs;
    empty: it does."""

    name = "correlation"

    def __init__(self, models: dict[int, Model]) -> None:
        """``models``: by side."""
        self._models = models
        self.failure = ""

    @property
    def providers(self) -> list[str]:
        """Execution provider of each side."""
        return [model.provider for model in self._models.values()]

    def correlate(self, image: np.ndarray, templates: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        """``image`` (C, H, W), ``templates`` (C, h, w) each, float32 -> the cross-correlations (H - h + 1, W - w + 1).
        None: no graph is large enough, or it has failed; it is not tried again then."""
        side = min((side for side in self._models if side >= max(image.shape[1:])), default=0)
        if not side or self.failure:
            return None
        found: list[np.ndarray] = []
        try:
            for begin in range(0, len(templates), BATCHES[-1]):
                chunk = templates[begin : begin + BATCHES[-1]]
                size = next(size for size in BATCHES if size >= len(chunk))
                batch = np.zeros((size, len(image), side, side), np.float32)
                for i, template in enumerate(chunk):
                    batch[i, :, : template.shape[1], : template.shape[2]] = template
                (surfaces,) = self._models[side].run(_padded(image, side), batch)
                found += list(surfaces[: len(chunk)])
        except ModelRunError as error:
            self.failure = str(error)
            return None
        height, width = image.shape[1:]
        return [
            surface[: height - template.shape[1] + 1, : width - template.shape[2] + 1]
            for surface, template in zip(found, templates, strict=True)
        ]


def _padded(image: np.ndarray, side: int) -> np.ndarray:
    """(C, H, W) -> (1, C, side, side)."""
    padded = np.zeros((1, len(image), side, side), np.float32)
    padded[0, :, : image.shape[1], : image.shape[2]] = image
    return padded


def open_correlator(folder: str = "", prefer: tuple[str, ...] = GPU) -> GraphCorrelator:
    """The graphs that ``export`` wrote into the models folder, on one of the providers ``prefer``. Raises
    ManifestError: there are none; ModelFileError: no such provider can run them."""
    where = models_folder(folder)
    models = {}
    for side in SIDES:
        manifest: Manifest = find_manifest(NAME.format(side=side), where)
        models[side] = stored_model(manifest, where).open(CORRELATION_INPUTS, (CORRELATION_OUTPUT,), prefer=prefer)
    return GraphCorrelator(models)
