"""Manifests: the shipped ones are valid, and errors in a user's own are reported in one line."""

import re
from pathlib import Path

import pytest

import tiny_onnx
from terrafix_engines import manifest
from terrafix_engines.manifest import ManifestError, Preset
from terrafix_engines.providers import CPU, CUDA, TENSORRT, provider_chain, tensorrt_options
from terrafix_engines.runtime import ModelFileError
from terrafix_engines.store import State, StoredModel, models_folder, resolve_model, stored_model
from terrafix_lab.train.ground import read_list
from terrafix_tools.models.matching import read_sets

OWN_WEIGHTS = "terrafix-1"

HEAD = f'file = "tiny.onnx"\nsha256 = "{"0" * 64}"\nsize_bytes = 7\n'
WHOLE = HEAD + tiny_onnx.XFEAT_LIKE


def written(folder: Path, text: str, name: str = "tiny.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_the_shipped_weights_are_those_of_their_manifest_and_none_of_their_images_judges_them(tmp_path: Path) -> None:
    """Each input with its licence and sha256."""
    found = stored_model(manifest.find_manifest(OWN_WEIGHTS, tmp_path), tmp_path)
    assert found.state() is State.READY and found.path.parent == manifest.SHIPPED
    assert found.path.stat().st_size <= 2_000_000
    text = (manifest.SHIPPED / f"{OWN_WEIGHTS}.toml").read_text(encoding="utf-8")
    inputs = re.findall(r"(?m)^# (?:trained on|held out): (\S+), sha256 [0-9a-f]{64}, \S.*$", text)
    lists = Path(__file__).parents[3] / "config/training"
    places = read_list(lists / "places.toml")
    assert inputs == [name for place in places for name in place.pictures or [place.name]]
    assert set(inputs).isdisjoint(path for one in read_sets(lists / "judges.toml") for path in (one.camera, one.map))


def test_the_shipped_manifests_have_a_source_and_a_licence() -> None:
    shipped = [manifest.read(path) for path in manifest.SHIPPED.glob("*.toml")]
    assert {m.name for m in shipped} == {"xfeat", "lighterglue-l3", OWN_WEIGHTS}
    for m in shipped:
        if m.name == OWN_WEIGHTS:
            continue
        assert m.source.startswith("https://") and m.licence == "Apache-2.0" and m.credit
        assert m.source.endswith(m.file)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (('name = "tiny"\n', 'name = "Tiny Model"\n'), "name"),
        (('role = "dense"', 'role = "dens"'), "Invalid enum value 'dens'"),
        (('role = "dense"', 'role = "matcher"'), r"needs a section \[matcher\]"),
        (('licence = "CC0"\n', ""), "missing required field `licence`"),
        (('licence = "CC0"\n', 'licence = "CC0"\nlicense = "CC0"\n'), "unknown field `license`"),
        (('file = "tiny.onnx"', 'file = "../tiny.onnx"'), "file"),
        (('input = "input"', 'input = "image"'), "'image' is used, but neither"),
        (('name = "descriptors"', 'name = "certainty"'), "'descriptors' is used, but neither"),
        (("width = 64 }\n[[presets]]", "wide = 64 }\n[[presets]]"), "a preset has no size for 'width'"),
        (("height = 32", "height = 0"), "presets"),
        (('licence = "CC0"\n', 'licence = "CC0"\nsource = "ftp://host/file"\n'), "must be an http or https address"),
        (("size_bytes = 7", "size_bytes = "), "not valid TOML"),
        (('"height/8"', '"height/0"'), "outputs"),
        (('"height/8"', '"rows/8"'), "'rows' is divided in a shape, but is no size of an input"),
        (('3, "height", "width"]', '3, "h", "w"]'), "is divided in a shape"),
        (('["batch", 3, "height", "width"]', '[3, "height", "width"]'), 'must end with "height", "width", or'),
    ],
)
def test_a_manifest_error_names_file_and_reason(tmp_path: Path, change: tuple[str, str], reason: str) -> None:
    assert change[0] in WHOLE
    path = written(tmp_path, WHOLE.replace(*change, 1))
    with pytest.raises(ManifestError, match=reason) as error:
        manifest.read(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_broken_manifest_does_not_affect_a_shipped_model(tmp_path: Path) -> None:
    written(tmp_path, "name = ")
    assert manifest.find_manifest("xfeat", tmp_path).name == "xfeat"
    with pytest.raises(ManifestError, match=r"tiny\.toml: not valid TOML"):
        manifest.find_manifest("tiny", tmp_path)


def test_a_duplicate_model_name_is_rejected(tmp_path: Path) -> None:
    written(tmp_path, WHOLE.replace('"tiny"', '"xfeat"'))
    with pytest.raises(ManifestError, match=r"tiny\.toml: the name 'xfeat' is taken"):
        manifest.read_all(tmp_path)


@pytest.mark.parametrize(
    ("shape", "sizes", "wrong"),
    [
        ((1, 64, 4, 8), {"batch": 1, "height": 32, "width": 64}, ""),
        ((1, 64, 5, 8), {"batch": 1, "height": 32, "width": 64}, "'descriptors' is [1, 64, 5, 8], not"),
        ((1, 64, 4), {"batch": 1, "height": 32, "width": 64}, "has 3 dimensions, not 4"),
        ((2, 64, 4, 8), {"height": 32, "width": 64}, ""),
    ],
)
def test_tensor_shapes_are_compared_with_the_manifest(
    shape: tuple[int, ...], sizes: dict[str, int], wrong: str
) -> None:
    tensor = manifest.Tensor(name="descriptors", shape=["batch", 64, "height/8", "width/8"])
    found = manifest.bind_sizes(tensor, shape, sizes)
    assert wrong in found and bool(found) == bool(wrong)
    assert sizes["batch"] == shape[0] or wrong


def test_the_models_folder_is_the_argument_the_environment_or_the_users_data_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("TERRAFIX_MODELS", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert models_folder() == tmp_path / ".local/share/terrafix/models"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert models_folder() == tmp_path / "data/terrafix/models"
    monkeypatch.setenv("TERRAFIX_MODELS", str(tmp_path / "m"))
    assert models_folder() == tmp_path / "m"
    assert models_folder("~/chosen") == tmp_path / "chosen"


def test_a_configured_model_is_resolved_as_name_or_path(tmp_path: Path) -> None:
    tiny_onnx.write(tmp_path, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like())
    assert resolve_model("models/xfeat.onnx", "xfeat", tmp_path) == Path("models/xfeat.onnx")
    assert resolve_model("own.onnx", "xfeat", tmp_path) == Path("own.onnx")
    found = resolve_model("tiny", "xfeat", tmp_path)
    assert isinstance(found, StoredModel) and found.path == tmp_path / "tiny.onnx" and found.state() is State.READY
    with pytest.raises(
        ModelFileError, match="no model is called 'superglue'; known: lighterglue-l3, terrafix-1, xfeat, tiny"
    ):
        resolve_model("superglue", "xfeat", tmp_path)
    with pytest.raises(
        ModelFileError, match="'lighterglue-l3' cannot be used as xfeat: its role is matcher, not dense"
    ):
        resolve_model("lighterglue-l3", "xfeat", tmp_path)


def test_a_stored_model_is_ready_absent_or_altered(tmp_path: Path) -> None:
    path = tiny_onnx.write(tmp_path, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like())
    model = stored_model(manifest.read(path.with_suffix(".toml")), tmp_path)
    assert model.state() is State.READY
    content = path.read_bytes()
    path.write_bytes(content[:-1] + b"?")
    assert model.state() is State.ALTERED
    path.write_bytes(content + b"?")
    assert model.state() is State.ALTERED
    path.unlink()
    assert model.state() is State.ABSENT
    with pytest.raises(ModelFileError, match=r"tiny\.onnx: not there; terrafix models fetch tiny"):
        model.open(("input",), ("descriptors",))


@pytest.mark.parametrize("provider", [CUDA, TENSORRT])
def test_every_gpu_provider_is_told_a_share_of_the_six_gigabytes(provider: str) -> None:
    chain = provider_chain(provider, tensorrt_options(Path("e"), Preset(sizes={}), ()))
    stated = [link[1] for link in chain if not isinstance(link, str)]
    limits = [int(options.get("gpu_mem_limit") or options["trt_max_workspace_size"]) for options in stated]
    assert limits and all(0 < 4 * limit <= 6 * 2**30 for limit in limits)
    assert chain[0][0] == provider and chain[-1] == CPU
