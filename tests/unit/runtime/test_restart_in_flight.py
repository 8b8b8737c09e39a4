"""All of Terrafix was killed in flight and is started again: what it takes from the run before."""

import fcntl
import shutil
import time
from pathlib import Path

import msgspec
import pytest

from terrafix.core.config import Config, LinkSection, Map, Source
from terrafix.processes import PROCESSES
from terrafix.runtime import run_dir
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import PREFIX, OwnedRunDir, RunDir
from terrafix.runtime.run_spec import spec_of
from terrafix.runtime.supervisor import _is_camera, killed_just_now


def killed(parent: Path, spec: bytes, age_s: float) -> RunDir:
    dead = RunDir(parent / f"{PREFIX}dead")
    dead.path.mkdir()
    (dead.path / "lock").touch()
    dead.spec.write_bytes(spec)
    dead.set_epoch(7)
    dead.checkpoint("estimator").write_bytes(b"the newest estimate")
    dead.shelf("anchor").mkdir()
    (dead.shelf("anchor") / "0 0.tile").touch()
    progress = Progress.create(dead.progress("link"))
    progress.stamp(time.monotonic_ns() - round(age_s * 1e9))
    progress.close()
    return dead


@pytest.mark.parametrize(
    ("spec", "camera", "age_s", "goes_on", "stays"),
    [
        (b"this map", True, 5.0, True, False),
        (b"this map", False, 5.0, False, True),
        (b"another map", True, 5.0, False, True),
        (b"this map", True, 61.0, False, False),
        (b"another map", True, 61.0, False, False),
    ],
)
def test_it_goes_on_from_a_run_of_the_same_that_was_killed_just_now(
    tmp_path: Path, spec: bytes, camera: bool, age_s: float, goes_on: bool, stays: bool
) -> None:
    dead = killed(tmp_path, spec, age_s)
    owned = OwnedRunDir(tmp_path, b"this map", goes_on=camera)
    try:
        assert owned.run_dir.epoch_ns == (7 if goes_on else None)
        assert owned.run_dir.checkpoint("estimator").exists() == goes_on
        assert (owned.run_dir.shelf("anchor") / "0 0.tile").exists() == goes_on
        assert dead.path.exists() == stays, "what goes on another way has an heir that is still to come"
    finally:
        owned.remove()


def test_a_supervisor_that_ended_without_being_asked_leaves_it_too(tmp_path: Path) -> None:
    first = OwnedRunDir(tmp_path, b"this map")
    first.run_dir.set_epoch(7)
    progress = Progress.create(first.run_dir.progress("link"))
    progress.stamp(time.monotonic_ns())
    progress.close()
    first.left = True
    first.remove()
    second = OwnedRunDir(tmp_path, b"this map", goes_on=True)
    assert second.run_dir.epoch_ns == 7
    second.remove()
    assert not list(tmp_path.iterdir())


CAMERA = "http://127.0.0.1:80/stream"


def test_a_map_that_was_looked_at_is_not_looked_at_again_while_a_vehicle_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_dir, "SHM", tmp_path)
    package, out = tmp_path / "a.gpkg", tmp_path / "out"
    config = Config(map=Map(path=str(package)), source=Source(path=CAMERA), link=LinkSection(device="udpin:h:1"))
    spec = msgspec.json.encode(spec_of(PROCESSES, config, package, out, 412.5))

    def found(source: str = CAMERA, map_path: Path = package, link: str = "udpin:h:1") -> float | None:
        before = killed_just_now(source=source, map_path=map_path, link=link, out_dir=out, configs=[])
        return None if before is None else before.ground_amsl_m

    assert found() is None
    dead = killed(tmp_path, spec, 5.0)
    assert found() == 412.5
    assert found(map_path=tmp_path / "b.gpkg") is None
    assert found(link="udpin:h:2") is None
    config = msgspec.structs.replace(config, source=Source(path=str(tmp_path)))
    dead.spec.write_bytes(msgspec.json.encode(spec_of(PROCESSES, config, package, out, 412.5)))
    assert found(source=str(tmp_path)) is None, "a recording begins anew"
    dead.spec.write_bytes(b'{"of another version": 1}')
    assert found() is None
    dead.spec.write_bytes(spec)
    with (dead.path / "lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert found() is None, "it lives"
    shutil.rmtree(dead.path)
    killed(tmp_path, spec, 61.0)
    assert found() is None


def test_a_recording_is_no_camera(tmp_path: Path) -> None:
    assert _is_camera("/dev/video0")
    assert _is_camera("http://127.0.0.1:80/stream")
    assert _is_camera("v4l2src device=/dev/video0 ! videoconvert ! appsink " + "x" * 300)
    assert not _is_camera(str(tmp_path))
