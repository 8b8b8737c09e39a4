"""`terrafix models list|verify|build|bench`, and models by name for a replay."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rasterio.transform import Affine
from typer.testing import CliRunner

import map_rasters
import tiny_onnx
from terrafix.core.errors import MapError, ModelError, OutputError
from terrafix_engines.providers import CPU, CUDA, TENSORRT
from terrafix_tools.models import bench, build, listing
from terrafix_tools.models.bench import bench_all
from terrafix_tools.models.build import build_all
from terrafix_tools.models.cli import app
from terrafix_tools.models.listing import verify_all


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "models"
    folder.mkdir()
    tiny_onnx.write(folder, tiny_onnx.XFEAT_LIKE, tiny_onnx.xfeat_like())
    return folder


def test_list_shows_fetched_models_and_available_providers(folder: Path) -> None:
    found = CliRunner().invoke(app, ["list", "--folder", str(folder), "--json"])
    output = json.loads(found.output)
    assert {m["name"]: m["state"] for m in output["models"]} == {
        "xfeat": "not fetched",
        "lighterglue-l3": "not fetched",
        "terrafix-1": "ready",
        "tiny": "ready",
    }
    assert output["folder"] == str(folder) and output["providers"]["CPU"] == ""
    (folder / "tiny.onnx").write_bytes(b"x")
    shown = CliRunner().invoke(app, ["list", "--folder", str(folder)]).output
    assert "altered" in shown and "Apache-2.0" in shown and str(folder) in shown


def test_verify_shows_the_provider_and_fails_for_a_model_that_does_not_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verify_all([], str(folder))
    assert "tiny: as published, run by CPU" in capsys.readouterr().out
    (folder / "tiny.onnx").write_bytes(b"x")
    with pytest.raises(ModelError, match="2 of 2 models cannot be used"):
        verify_all(["tiny", "xfeat"], str(folder))
    output = capsys.readouterr().out.splitlines()
    assert len(output) == 2 and "not the published file" in output[0] and "terrafix models fetch xfeat" in output[1]


def test_list_handles_an_empty_folder_and_a_broken_manifest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    verify_all([], str(tmp_path / "nothing"))
    assert capsys.readouterr().out.startswith("terrafix-1: as published, run by CPU")
    (tmp_path / "mine.toml").write_text("name = ")
    with pytest.raises(ModelError, match=r"mine\.toml: not valid TOML"):
        listing.show(str(tmp_path), as_json=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(ModelError, match="file: cannot be read"):
        listing.show(str(tmp_path / "file"), as_json=True)


def test_verify_reports_a_file_without_read_permission(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_: Path, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "stat", refused)
    with pytest.raises(ModelError, match=r"cannot be read \(Permission denied\)"):
        verify_all([], str(folder))


def test_build_without_tensorrt_builds_no_engine(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: [CPU])
    with pytest.raises(ModelError, match=r"TensorRT cannot be used here: this ONNX Runtime .* nothing was built"):
        build_all([], str(folder))


def test_build_reports_its_result(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the report; tests/unit/runtime builds on a simulated machine with TensorRT."""
    monkeypatch.setattr(build.providers, "check", lambda _: None)
    options: list[dict[str, Any]] = []

    def opened(_model: object, **more: Any) -> Any:
        options.append(more)
        return type(
            "Opened", (), {"provider": provider, "sha256": "f" * 64, "rejected_providers": ["TensorRT: out of memory"]}
        )

    monkeypatch.setattr(build, "open_complete", opened)
    provider = TENSORRT
    build_all(["tiny"], str(folder))
    assert options == [{"build": True}] and f"ready in {folder}/engines/{'f' * 16}" in capsys.readouterr().out
    provider = CUDA
    with pytest.raises(ModelError, match=r"tiny: no engine \(TensorRT: out of memory\)"):
        build_all(["tiny"], str(folder))


def test_bench_compares_with_the_describer_without_weights(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "models.json"
    bench_all([], str(folder), out, runs=3)
    measured = json.loads(out.read_text())
    rows = measured["models"]["tiny"]["rows"]
    assert [row["sizes"]["height"] for row in rows] == [32, 64] and measured["machine"]["cores"] > 0
    for row in rows:
        assert row["provider"] == "CPU" and row["runs"] == 3 and row["baseline"]["what"] == "gradients"
        assert 0.0 < row["ms"]["median"] <= row["ms"]["p95"] and row["baseline"]["ms"]["median"] > 0.0
    with pytest.raises(OutputError, match="cannot be written"):
        bench_all([], str(folder), out / "file.json", runs=1)


def raster(path: Path, image: np.ndarray, x_m: float = 500_000.0, crs: int = 32633) -> Path:
    corner = Affine(0.5, 0, x_m, 0, -0.5, 5e6)
    return map_rasters.write_tif(path, image[:, :, ::-1].transpose(2, 0, 1), f"EPSG:{crs}", corner)


SETS = """
[[set]]
name = "here"
camera = "one.tif"
map = "two.tif"
agl_m = 60.0
"""


@pytest.mark.slow
def test_matching_places_frames_of_another_date_and_no_mirrored_ones(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map begins 30 px further east and is darker; positions are compared in ground coordinates."""
    from terrafix_tools.models.matching import measure_matching
    from textured_ground import texture

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    ground = np.ascontiguousarray(texture(6, 230.0)[:860, :900])
    raster(tmp_path / "one.tif", ground)
    raster(tmp_path / "two.tif", cv2.convertScaleAbs(ground[:, 30:], alpha=0.8), 500_000.0 + 30 * 0.5)
    (tmp_path / "sets.toml").write_text(SETS)

    def rows_of(models: list[str]) -> dict[str, dict[str, Any]]:
        out = tmp_path / "matching.json"
        measure_matching(
            tmp_path / "sets.toml",
            tmp_path,
            models,
            str(folder),
            only=["here"],
            priors_m=[30.0],
            unknown_heading=False,
            places=2,
            out=out,
        )
        return {row["method"]: row for row in json.loads(out.read_text())}

    found = rows_of(["tiny"])
    assert set(found) == {"gradients", "tiny", "gradients+tiny"}
    gradients = found["gradients"]
    assert gradients["placed"] == gradients["right"] == 1.0 and gradients["wrong"] == gradients["mirrored"] == 0
    assert gradients["lead_nats"] > 2.0 and gradients["margin_sd"] > 2.0 and gradients["cpu_ms"] > 0.0
    raster(tmp_path / "two.tif", ground, crs=32634)
    with pytest.raises(MapError, match="another coordinate system than"):
        rows_of([])
    (tmp_path / "sets.toml").write_text("[[set]]\nname = 3\n")
    with pytest.raises(MapError, match="no list of sets"):
        rows_of([])


def test_bench_times_a_model_of_fixed_input_size(tmp_path: Path) -> None:
    text = tiny_onnx.XFEAT_LIKE.split("[[presets]]")[0].replace('3, "height", "width"', "3, 24, 40")
    text = text.replace('"height/8", "width/8"', "3, 5")
    tiny_onnx.write(tmp_path, text, tiny_onnx.xfeat_like())
    bench_all([], str(tmp_path), tmp_path / "m.json", runs=2)
    (row,) = json.loads((tmp_path / "m.json").read_text())["models"]["tiny"]["rows"]
    assert row["input"] == [1, 3, 24, 40]


def test_bench_times_a_slow_model_with_fewer_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "MAX_TIME_S", 0.0)
    assert bench._time_runs(lambda: None, 50)["runs"] == bench.MIN_RUNS - 1


def test_every_models_command_has_help() -> None:
    for command in ("list", "fetch", "verify", "build", "bench"):
        found = CliRunner().invoke(app, [command, "--help"])
        assert found.exit_code == 0 and "--folder" in found.output
