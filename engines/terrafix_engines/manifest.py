"""What is known of a model before it is opened: where it comes from, its checksum, and what goes in and out.

One TOML file a model. Those in ``terrafix_engines/models`` come with the program; a user's own stand beside the weights
in the models folder, so that an export of SuperPoint, ALIKED or LightGlue runs without code."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

SHIPPED = Path(__file__).parent / "models"

# A number; a name that stands for a number that may change from call to call; or "name/8".
Size = Annotated[int, Meta(ge=1)] | Annotated[str, Meta(pattern=r"^[A-Za-z_]\w*(/[1-9][0-9]*)?$")]
Name = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9._-]*$")]
File = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]  # no folder: it stands in the models folder
# Of points in a picture. pixels: of the input, the middle of the first pixel is 0; signed (-1 to 1) and unit (0 to 1):
# from the middle of the first pixel to that of the last one.
Coordinates = Literal["pixels", "signed", "unit"]


# Sections that a role needs.
SECTIONS = {
    "dense": ("image",),
    "keypoints": ("image", "keypoints"),
    "matcher": ("matcher",),
    "pair": ("image", "pair"),
}
DENSE_INPUT, DENSE_OUTPUTS = "input", ("descriptors", "keypoint_logits", "reliability")  # what "dense" means


class ManifestError(Exception):
    """A manifest that cannot be used, or the name of a model that nobody knows."""


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of every part of a manifest."""


class Tensor(Section, frozen=True, kw_only=True):
    """An input or an output."""

    name: str
    shape: list[Size]
    dtype: Literal["float32", "float16", "int64", "int32"] = "float32"


class Preset(Section, frozen=True, kw_only=True):
    """Sizes for which an engine is built: every name in the shapes of the inputs gets its number."""

    sizes: dict[str, Annotated[int, Meta(ge=1)]]
    precision: Literal["fp32", "fp16"] = "fp16"  # of TensorRT; other providers compute as the file says


class ImageInput(Section, frozen=True, kw_only=True):
    """How a picture (H, W, 3) uint8 BGR becomes the input: (1, C, height, width), where these two are either numbers or
    just these names."""

    input: str
    colour: Literal["gray", "rgb", "bgr"]
    scale: float = 1 / 255  # grey levels times this
    multiple: Annotated[int, Meta(ge=1)] = 1  # sides are filled up to multiples of this


class KeypointOutputs(Section, frozen=True, kw_only=True):
    """Names of the outputs of a detector that gives points, not maps. Leading axes of length one do not matter."""

    keypoints: str  # (N, 2), x then y
    scores: str  # (N,)
    descriptors: str  # (N, C), or (C, N) with channels_first
    coordinates: Coordinates = "pixels"
    channels_first: bool = False


class MatcherTensors(Section, frozen=True, kw_only=True):
    """Names of the tensors of a matcher, for the first picture and the second."""

    features: str  # name of the model whose descriptors it was trained on
    keypoints: tuple[str, str]  # (1, N, 2)
    descriptors: tuple[str, str]  # (1, N, C)
    matches: str  # pairs: (M, 2), or (M, 3) with the number of the pair in front; index: (1, N), -1 where there is none
    scores: str  # of the pairs (M,), or of each point (1, N)
    # centred: from the middle of the picture, divided by half of its longer side; pixels: as they are
    coordinates: Literal["centred", "pixels"] = "centred"
    form: Literal["pairs", "index"] = "pairs"


class PairTensors(Section, frozen=True, kw_only=True):
    """Names of the tensors of a model that is given two pictures; the first one goes into the input of [image]."""

    second: str  # input of the second picture, of the same shape
    keypoints: tuple[str, str]  # outputs (N, 2), x then y: what was found in the first picture, and in the second
    scores: str  # (N,), 0 to 1
    coordinates: Coordinates = "pixels"


class Manifest(Section, frozen=True, kw_only=True):
    """``role``: "dense" gives the maps of XFeat, "keypoints" points, "matcher" joins the points of two pictures, "pair"
    is given the two pictures themselves."""

    name: Name
    title: str
    role: Literal["dense", "keypoints", "matcher", "pair"]
    file: File
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    size_bytes: Annotated[int, Meta(ge=1)]
    licence: str
    credit: str = ""
    source: str = ""  # http(s) address of the file; empty: it is not to be had from a network
    inputs: Annotated[list[Tensor], Meta(min_length=1)]
    outputs: Annotated[list[Tensor], Meta(min_length=1)]
    presets: list[Preset] = []
    image: ImageInput | None = None
    keypoints: KeypointOutputs | None = None
    matcher: MatcherTensors | None = None
    pair: PairTensors | None = None

    def tensors(self, names: tuple[str, ...]) -> tuple[Tensor, ...]:
        """Those inputs and outputs, in this order."""
        known = {tensor.name: tensor for tensor in (*self.inputs, *self.outputs)}
        return tuple(known[name] for name in names)

    def picture_size(self) -> tuple[Size, Size]:
        """Height and width of the picture that goes in: "height" and "width", or numbers where it takes one size."""
        assert self.image is not None
        (tensor,) = self.tensors((self.image.input,))
        return tensor.shape[-2], tensor.shape[-1]


def read(path: Path) -> Manifest:
    """Raises ManifestError with file and key."""
    try:
        manifest = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Manifest)
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{path}: cannot be read ({error}); check the file and its permissions") from None
    except tomllib.TOMLDecodeError as error:
        raise ManifestError(f"{path}: not valid TOML ({error}); correct it or move it away") from None
    except msgspec.ValidationError as error:
        text = str(error).replace("`$.", "`")
        raise ManifestError(f"{path}: {text}; docs/models.md explains every key") from None
    wrong = _contradiction(manifest)
    if wrong:
        raise ManifestError(f"{path}: {wrong}; docs/models.md explains every key")
    return manifest


def known(folder: Path) -> dict[str, Manifest]:
    """All models by name: those that come with the program, and those described in ``folder``. Raises ManifestError."""
    found: dict[str, Manifest] = {}
    for path in (*sorted(SHIPPED.glob("*.toml")), *sorted(folder.glob("*.toml"))):
        manifest = read(path)
        if manifest.name in found:
            raise ManifestError(f"{path}: the name '{manifest.name}' is taken; give the model another name")
        found[manifest.name] = manifest
    return found


def named(name: str, folder: Path) -> Manifest:
    """Raises ManifestError when nobody knows the name. A broken file beside it does no harm to a shipped one."""
    shipped = SHIPPED / f"{name}.toml"
    if shipped.is_file():
        return read(shipped)
    all_known = known(folder)
    if name not in all_known:
        raise ManifestError(f"no model is called '{name}'; known: {', '.join(all_known)} (terrafix models list)")
    return all_known[name]


def sizes_of(tensor: Tensor, shape: tuple[int, ...], sizes: dict[str, int]) -> str:
    """Compares a shape with what is stated, and adds what its names stand for to ``sizes``. -> "" or what is wrong."""
    if len(shape) != len(tensor.shape):
        return f"'{tensor.name}' has {len(shape)} dimensions, not {len(tensor.shape)}"
    for stated, real in zip(tensor.shape, shape, strict=True):
        if isinstance(stated, str) and "/" not in stated and stated not in sizes:
            sizes[stated] = real
        elif _number(stated, sizes) != real:
            return f"'{tensor.name}' is {list(shape)}, not {tensor.shape}"
    return ""


def shape_of(tensor: Tensor, sizes: dict[str, int]) -> tuple[int, ...]:
    """The shape with numbers for its names."""
    return tuple(_number(size, sizes) for size in tensor.shape)


def _number(size: Size, sizes: dict[str, int]) -> int:
    if isinstance(size, int):
        return size
    name, _, divisor = size.partition("/")
    return sizes[name] // int(divisor or 1)


def _contradiction(manifest: Manifest) -> str:
    """What does not fit together, or ""."""
    inputs, outputs = {t.name for t in manifest.inputs}, {t.name for t in manifest.outputs}
    free = {size for t in manifest.inputs for size in t.shape if isinstance(size, str)}
    for section in SECTIONS[manifest.role]:
        if getattr(manifest, section) is None:
            return f"a model with the role '{manifest.role}' needs a section [{section}]"
    if manifest.source and not manifest.source.startswith(("https://", "http://")):
        return "`source` must be an http or https address, or be left out"
    used_in: set[str] = {manifest.image.input} if manifest.image else set()
    used_out: set[str] = set()
    if manifest.role == "dense":
        used_in, used_out = {*used_in, DENSE_INPUT}, set(DENSE_OUTPUTS)
    if points := manifest.keypoints:
        used_out |= {points.keypoints, points.scores, points.descriptors}
    if matcher := manifest.matcher:
        used_in |= {*matcher.keypoints, *matcher.descriptors}
        used_out |= {matcher.matches, matcher.scores}
    if pair := manifest.pair:
        used_in |= {pair.second}
        used_out |= {*pair.keypoints, pair.scores}
    for name in sorted((used_in - inputs) | (used_out - outputs)):
        return f"'{name}' is used, but neither an input nor an output of that name is stated"
    parts = [str(size).partition("/") for t in (*manifest.inputs, *manifest.outputs) for size in t.shape]
    for name in sorted({name for name, slash, _ in parts if slash} - free):
        return f"'{name}' is divided in a shape, but is no size of an input"
    if manifest.image and not _is_picture(manifest):
        return f'the shape of \'{manifest.image.input}\' must end with "height", "width", or with two numbers'
    if (image := manifest.image) and pair and _shape(manifest, pair.second) != _shape(manifest, image.input):
        return f"'{pair.second}' must have the shape of '{image.input}'"
    for preset in manifest.presets:
        if missing := free - set(preset.sizes):
            return f"a preset has no size for '{min(missing)}'"
    return ""


def _shape(manifest: Manifest, name: str) -> list[Size]:
    return manifest.tensors((name,))[0].shape


def _is_picture(manifest: Manifest) -> bool:
    assert manifest.image is not None
    if len(_shape(manifest, manifest.image.input)) != 4:
        return False
    size = manifest.picture_size()
    return size == ("height", "width") or all(isinstance(side, int) for side in size)
