"""Model manifest: origin, checksum, and input and output tensors of a model.

One TOML file per model. Those in ``terrafix_engines/models`` are shipped; a user's own are in the models folder beside
the weights, so that an export of SuperPoint, ALIKED or LightGlue runs without new code."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

SHIPPED = Path(__file__).parent / "models"

# A number; a symbolic size that may differ from call to call; or "name/8".
Size = Annotated[int, Meta(ge=1)] | Annotated[str, Meta(pattern=r"^[A-Za-z_]\w*(/[1-9][0-9]*)?$")]
Name = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9._-]*$")]
File = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]  # without a folder: it is in the models folder
# Coordinates of keypoints. pixels: of the input, 0 is the centre of the first pixel; signed (-1 to 1) and unit (0 to
# 1): from the centre of the first pixel to that of the last one.
Coordinates = Literal["pixels", "signed", "unit"]


# Sections that each role requires.
SECTIONS = {
    "dense": ("image",),
    "keypoints": ("image", "keypoints"),
    "matcher": ("matcher",),
    "pair": ("image", "pair"),
    "global": ("image", "vector"),
    "correlation": (),
}
CORRELATION_INPUTS, CORRELATION_OUTPUT = ("images", "templates"), "correlation"  # tensors of role "correlation"
DENSE_INPUT, DENSE_OUTPUTS = "input", ("descriptors", "keypoint_logits", "reliability")  # tensors of role "dense"


class ManifestError(Exception):
    """An invalid manifest, or an unknown model name."""


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all parts of a manifest."""


class Tensor(Section, frozen=True, kw_only=True):
    """An input or output tensor."""

    name: str
    shape: list[Size]
    dtype: Literal["float32", "float16", "int64", "int32"] = "float32"


class Preset(Section, frozen=True, kw_only=True):
    """Sizes for which a TensorRT engine is built: a number for every symbolic size of the inputs."""

    sizes: dict[str, Annotated[int, Meta(ge=1)]]
    precision: Literal["fp32", "fp16"] = "fp16"  # of TensorRT; other providers use the precision of the file


class ImageInput(Section, frozen=True, kw_only=True):
    """Conversion of an image (H, W, 3) uint8 BGR to the input (1, C, height, width); the last two sizes are numbers or
    the names "height" and "width"."""

    input: str
    colour: Literal["gray", "rgb", "bgr"]
    scale: float = 1 / 255  # factor on grey levels
    multiple: Annotated[int, Meta(ge=1)] = 1  # sides are padded to multiples of this
    # of each colour, after the scale: (value - mean) / std; empty: none. DINOv2: those of ImageNet
    mean: list[float] = []
    std: list[Annotated[float, Meta(gt=0)]] = []


class KeypointOutputs(Section, frozen=True, kw_only=True):
    """Output names of a detector with role "keypoints". Leading axes of length one are ignored."""

    keypoints: str  # (N, 2), x then y
    scores: str  # (N,)
    descriptors: str  # (N, C), or (C, N) with channels_first
    coordinates: Coordinates = "pixels"
    channels_first: bool = False


class MatcherTensors(Section, frozen=True, kw_only=True):
    """Tensor names of a keypoint matcher, for the first and the second image."""

    features: str  # name of the model whose descriptors it was trained on
    keypoints: tuple[str, str]  # (1, N, 2)
    descriptors: tuple[str, str]  # (1, N, C)
    matches: str  # pairs: (M, 2), or (M, 3) with a leading pair index; index: (1, N), -1 for unmatched points
    scores: str  # of the pairs (M,), or of each point (1, N)
    # centred: relative to the image centre, divided by half of the longer side; pixels: unchanged
    coordinates: Literal["centred", "pixels"] = "centred"
    form: Literal["pairs", "index"] = "pairs"


class PairTensors(Section, frozen=True, kw_only=True):
    """Tensor names of a model that takes two images; the first image is the input of [image]."""

    second: str  # input of the second image, of the same shape
    keypoints: tuple[str, str]  # outputs (N, 2), x then y: points in the first and in the second image
    scores: str  # (N,), 0 to 1
    coordinates: Coordinates = "pixels"


class VectorOutput(Section, frozen=True, kw_only=True):
    """The output of a model with role "global": one vector for an image."""

    output: str  # (1, size); leading axes of length one are ignored
    size: Annotated[int, Meta(ge=1)]
    side_px: Annotated[int, Meta(ge=16)]  # side of the square images that it is given; DINOv2: a multiple of 14


class Manifest(Section, frozen=True, kw_only=True):
    """``role``: "dense" outputs the maps of XFeat, "keypoints" outputs keypoints, "matcher" matches the keypoints of
    two images, "pair" takes two images, "global" makes one vector of an image, "correlation" correlates descriptors."""

    name: Name
    title: str
    role: Literal["dense", "keypoints", "matcher", "pair", "global", "correlation"]
    file: File
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    size_bytes: Annotated[int, Meta(ge=1)]
    licence: str
    credit: str = ""
    source: str = ""  # http(s) address of the file; empty: it cannot be downloaded
    inputs: Annotated[list[Tensor], Meta(min_length=1)]
    outputs: Annotated[list[Tensor], Meta(min_length=1)]
    presets: list[Preset] = []
    image: ImageInput | None = None
    keypoints: KeypointOutputs | None = None
    matcher: MatcherTensors | None = None
    pair: PairTensors | None = None
    vector: VectorOutput | None = None

    def tensors(self, names: tuple[str, ...]) -> tuple[Tensor, ...]:
        """Input and output tensors by name, in this order."""
        read_all = {tensor.name: tensor for tensor in (*self.inputs, *self.outputs)}
        return tuple(read_all[name] for name in names)

    def image_size(self) -> tuple[Size, Size]:
        """Height and width of the input image: "height" and "width", or numbers for a fixed size."""
        assert self.image is not None
        (tensor,) = self.tensors((self.image.input,))
        return tensor.shape[-2], tensor.shape[-1]


def read(path: Path) -> Manifest:
    """Reads and validates a manifest. Raises ManifestError with file and key."""
    try:
        manifest = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Manifest)
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{path}: cannot be read ({error}); check the file and its permissions") from None
    except tomllib.TOMLDecodeError as error:
        raise ManifestError(f"{path}: not valid TOML ({error}); correct it or move it away") from None
    except msgspec.ValidationError as error:
        text = str(error).replace("`$.", "`")
        raise ManifestError(f"{path}: {text}; docs/models.md explains every key") from None
    inconsistency = _find_inconsistency(manifest)
    if inconsistency:
        raise ManifestError(f"{path}: {inconsistency}; docs/models.md explains every key")
    return manifest


def read_all(folder: Path) -> dict[str, Manifest]:
    """All manifests by model name: the shipped ones and those in ``folder``. Raises ManifestError."""
    found: dict[str, Manifest] = {}
    for path in (*sorted(SHIPPED.glob("*.toml")), *sorted(folder.glob("*.toml"))):
        manifest = read(path)
        if manifest.name in found:
            raise ManifestError(f"{path}: the name '{manifest.name}' is taken; give the model another name")
        found[manifest.name] = manifest
    return found


def find_manifest(name: str, folder: Path) -> Manifest:
    """Manifest of a model. Raises ManifestError. A broken file in ``folder`` does not affect a shipped model."""
    shipped = SHIPPED / f"{name}.toml"
    if shipped.is_file():
        return read(shipped)
    all_known = read_all(folder)
    if name not in all_known:
        raise ManifestError(f"no model is called '{name}'; known: {', '.join(all_known)} (terrafix models list)")
    return all_known[name]


def bind_sizes(tensor: Tensor, shape: tuple[int, ...], sizes: dict[str, int]) -> str:
    """Compares a shape with the manifest and adds the values of its symbolic sizes to ``sizes``. -> error, or ""."""
    if len(shape) != len(tensor.shape):
        return f"'{tensor.name}' has {len(shape)} dimensions, not {len(tensor.shape)}"
    for declared, actual in zip(tensor.shape, shape, strict=True):
        if isinstance(declared, str) and "/" not in declared and declared not in sizes:
            sizes[declared] = actual
        elif _number(declared, sizes) != actual:
            return f"'{tensor.name}' is {list(shape)}, not {tensor.shape}"
    return ""


def concrete_shape(tensor: Tensor, sizes: dict[str, int]) -> tuple[int, ...]:
    """The shape with numbers for its symbolic sizes."""
    return tuple(_number(size, sizes) for size in tensor.shape)


def _number(size: Size, sizes: dict[str, int]) -> int:
    if isinstance(size, int):
        return size
    name, _, divisor = size.partition("/")
    return sizes[name] // int(divisor or 1)


def _find_inconsistency(manifest: Manifest) -> str:
    """First inconsistency of the manifest, or ""."""
    inputs, outputs = {t.name for t in manifest.inputs}, {t.name for t in manifest.outputs}
    free = {size for t in manifest.inputs for size in t.shape if isinstance(size, str)}
    for section in SECTIONS[manifest.role]:
        if getattr(manifest, section) is None:
            return f"a model with the role '{manifest.role}' needs a section [{section}]"
    if manifest.source and not manifest.source.startswith(("https://", "http://")):
        return "`source` must be an http or https address, or be left out"
    used_in, used_out = _used_tensors(manifest)
    for name in sorted((used_in - inputs) | (used_out - outputs)):
        return f"'{name}' is used, but neither an input nor an output of that name is stated"
    parts = [str(size).partition("/") for t in (*manifest.inputs, *manifest.outputs) for size in t.shape]
    for name in sorted({name for name, slash, _ in parts if slash} - free):
        return f"'{name}' is divided in a shape, but is no size of an input"
    if inconsistency := _find_image_inconsistency(manifest):
        return inconsistency
    for preset in manifest.presets:
        if missing := free - set(preset.sizes):
            return f"a preset has no size for '{min(missing)}'"
    return ""


def _used_tensors(manifest: Manifest) -> tuple[set[str], set[str]]:
    """Names of the inputs and of the outputs that the sections and the role use."""
    used_in: set[str] = {manifest.image.input} if manifest.image else set()
    used_out: set[str] = set()
    if manifest.role == "dense":
        used_in, used_out = {*used_in, DENSE_INPUT}, {DENSE_OUTPUTS[0]}
    if manifest.role == "correlation":
        used_in, used_out = set(CORRELATION_INPUTS), {CORRELATION_OUTPUT}
    if points := manifest.keypoints:
        used_out |= {points.keypoints, points.scores, points.descriptors}
    if matcher := manifest.matcher:
        used_in |= {*matcher.keypoints, *matcher.descriptors}
        used_out |= {matcher.matches, matcher.scores}
    if manifest.vector:
        used_out |= {manifest.vector.output}
    if pair := manifest.pair:
        used_in |= {pair.second}
        used_out |= {*pair.keypoints, pair.scores}
    return used_in, used_out


def _find_image_inconsistency(manifest: Manifest) -> str:
    """First inconsistency of the image inputs, or ""."""
    image, pair = manifest.image, manifest.pair
    if image and not _has_image_shape(manifest):
        return f'the shape of \'{image.input}\' must end with "height", "width", or with two numbers'
    colours = 1 if image and image.colour == "gray" else 3
    if image and any(len(values) not in (0, colours) for values in (image.mean, image.std)):
        return f"`mean` and `std` of the image must have {colours} numbers, or be left out"
    if image and pair and _shape(manifest, pair.second) != _shape(manifest, image.input):
        return f"'{pair.second}' must have the shape of '{image.input}'"
    return ""


def _shape(manifest: Manifest, name: str) -> list[Size]:
    return manifest.tensors((name,))[0].shape


def _has_image_shape(manifest: Manifest) -> bool:
    assert manifest.image is not None
    if len(_shape(manifest, manifest.image.input)) != 4:
        return False
    size = manifest.image_size()
    return size == ("height", "width") or all(isinstance(side, int) for side in size)
