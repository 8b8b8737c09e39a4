"""Header of a record: versions, map, models, computer, calibration."""

import hashlib
import json
import os
import platform
from pathlib import Path

import msgspec
import pytest

from flight_records import live_messages, origin
from terrafix.core.config import Config, Models
from terrafix.map.package import MapPackage
from terrafix.recorder import provenance
from terrafix.recorder.provenance import copied_header, header, map_of, models_of
from terrafix.recorder.reader import ReadResult, read_flight
from terrafix.recorder.writer import CALIBRATION_NAME, FlightWriter
from terrafix_lab.sim.world.place import generate
from terrafix_tools.log.edit import cut
from terrafix_tools.mapping.build import build


def header_of(path: Path) -> dict[str, object]:
    result = ReadResult()
    for _ in read_flight(path, result):
        pass
    return result.header


def write(path: Path, head: dict[str, str]) -> Path:
    writer = FlightWriter(path, head)
    for message in live_messages():
        writer.write(message, message.t_ns)
    writer.close()
    return path


def test_header_has_format_configuration_versions_and_device() -> None:
    config = Config(models=Models(xfeat="none.onnx"))
    head = header(config)
    assert head["format"] == "terrafix-flight/2"
    assert json.loads(head["config"]) == msgspec.to_builtins(config)
    assert json.loads(head["versions"])["python"] == platform.python_version()
    assert json.loads(head["map"]) == {}
    found = json.loads(head["device"])
    assert found["cores"] == os.cpu_count() and found["machine"] == platform.machine()
    assert found["kernel"] == platform.release()
    assert found["memory_mb"] == pytest.approx(_memory_mb(), rel=0.01)


def _memory_mb() -> float:
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemTotal:"):
            return int(line.split()[1]) / 1024
    raise AssertionError("no MemTotal")


def test_map_is_named_with_its_checksum(tmp_path: Path) -> None:
    place = generate(1, width_m=300.0, height_m=300.0)
    place.write_rendering(tmp_path / "map.tif", "summer")
    build(tmp_path / "map.tif", tmp_path / "map.gpkg", date="2020-07-10")
    manifest = MapPackage.open(tmp_path / "map.gpkg").manifest
    found = map_of(tmp_path / "map.gpkg")
    assert found["path"] == str(tmp_path / "map.gpkg")
    assert found["checksum"] == manifest.checksum and found["date"] == "2020-07-10"
    assert found["name"] == manifest.name and found["source"] == manifest.source


@pytest.mark.parametrize("content", [b"", b"no map", None])
def test_map_that_cannot_be_read_has_its_path_only(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "map.gpkg").write_bytes(content)
    assert map_of(tmp_path / "map.gpkg") == {"path": str(tmp_path / "map.gpkg")}


def test_configured_model_is_named_with_its_sha256(tmp_path: Path) -> None:
    (tmp_path / "own.onnx").write_bytes(b"weights")
    found = models_of(Models(xfeat=str(tmp_path / "own.onnx"), folder=str(tmp_path)))
    digest = hashlib.sha256(b"weights").hexdigest()
    assert found == {"xfeat": {"path": str(tmp_path / "own.onnx"), "sha256": digest}}


def test_fetched_model_is_named_by_its_file(tmp_path: Path) -> None:
    (tmp_path / "xfeat.onnx").write_bytes(b"fetched")
    digest = hashlib.sha256(b"fetched").hexdigest()
    found = models_of(Models(xfeat="xfeat", folder=str(tmp_path)))
    assert found == {"xfeat": {"path": str(tmp_path / "xfeat.onnx"), "sha256": digest}}


@pytest.mark.parametrize("name", ["/nowhere/own.onnx", "no-such-model"])
def test_model_that_cannot_be_read_has_no_sha256(name: str) -> None:
    assert models_of(Models(xfeat=name)) == {"xfeat": {"path": name, "sha256": ""}}


def test_without_a_configured_model_there_is_none() -> None:
    assert models_of(Models(folder="/models")) == {}


def test_processor_and_product_are_those_of_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "model").write_bytes(b"NVIDIA Jetson Orin NX\0")
    monkeypatch.setattr(provenance, "_DEVICE_NAMES", (str(tmp_path / "none"), str(tmp_path / "model")))
    assert provenance.device()["product"] == "NVIDIA Jetson Orin NX"
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    named = [line for line in lines if line.startswith("model name")]
    assert provenance.processor() == (named[0].split(":", 1)[1].strip() if named else "")


def test_calibration_is_in_the_header_of_each_file(tmp_path: Path) -> None:
    path = write(tmp_path / "flight.mcap", header(Config()))
    assert header_of(path)["calibration"] == json.loads(msgspec.json.encode(origin().camera))


def test_damaged_header_text_is_an_empty_part(tmp_path: Path) -> None:
    head = {**header(Config()), "device": '{"cores": '}
    found = header_of(write(tmp_path / "flight.mcap", head))
    assert found["device"] == {} and found["config"] == msgspec.to_builtins(Config())


def test_copy_of_a_record_keeps_its_provenance(tmp_path: Path) -> None:
    head = {**header(Config()), "map": '{"path": "/a.gpkg", "checksum": "12"}', "format": "terrafix-flight/1"}
    path = write(tmp_path / "flight.mcap", {**head, "format": "terrafix-flight/2"})
    cut(path, tmp_path / "part.mcap", 0.0, 3.0)
    assert header_of(tmp_path / "part.mcap") == header_of(path)


def test_copied_header_has_the_present_format_and_changed_parts() -> None:
    found = {"format": "terrafix-flight/1", "config": {"a": 1}, "device": {"cores": 2}, "calibration": {"fx": 3.0}}
    copied = copied_header(found, device={"cores": 8})
    assert copied == {"format": "terrafix-flight/2", "config": '{"a":1}', "device": '{"cores":8}'}
    assert CALIBRATION_NAME not in copied
