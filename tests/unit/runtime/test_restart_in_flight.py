"""Restart of all of Terrafix in flight: the state that it takes over from the killed run."""

import fcntl
import shutil
import time
from pathlib import Path

import msgspec
import pytest

from terrafix.core.config import Config, LinkSection, Map, SourceSection
from terrafix.processes import PROCESSES
from terrafix.runtime import run_dir
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import PREFIX, OwnedRunDir, RunDir
from terrafix.runtime.run_spec import is_camera, spec_of
from terrafix.runtime.supervisor import RunOptions, recently_killed_spec


def killed(parent: Path, spec: bytes, age_s: float) -> RunDir:
    """The folder of a run that was killed ``age_s`` ago."""
    stale = RunDir(parent / f"{PREFIX}dead")
    stale.path.mkdir()
    (stale.path / "lock").touch()
    stale.spec.write_bytes(spec)
    stale.set_epoch(7)
    stale.checkpoint("estimator").write_bytes(b"the newest estimate")
    stale.cache_dir("anchor").mkdir()
    (stale.cache_dir("anchor") / "0 0.tile").touch()
    progress = Progress.create(stale.progress("link"))
    progress.stamp(time.monotonic_ns() - round(age_s * 1e9))
    progress.close()
    return stale


@pytest.mark.parametrize(
    ("spec", "camera", "age_s", "resumes", "stays"),
    [
        (b"this map", True, 5.0, True, False),
        (b"this map", False, 5.0, False, True),
        (b"another map", True, 5.0, False, True),
        (b"this map", True, 61.0, False, False),
        (b"another map", True, 61.0, False, False),
    ],
)
def test_a_run_resumes_from_a_recently_killed_run_with_the_same_spec(
    tmp_path: Path, spec: bytes, camera: bool, age_s: float, resumes: bool, stays: bool
) -> None:
    stale = killed(tmp_path, spec, age_s)
    owned = OwnedRunDir(tmp_path, b"this map", resume=camera)
    try:
        assert owned.run_dir.epoch_ns == (7 if resumes else None)
        assert owned.run_dir.checkpoint("estimator").exists() == resumes
        assert (owned.run_dir.cache_dir("anchor") / "0 0.tile").exists() == resumes
        assert (owned.run_dir.path == stale.path) == resumes
        assert stale.path.exists() == (stays or resumes), "a run with another spec is kept for its own successor"
    finally:
        owned.remove()


def test_the_folder_kept_by_a_failed_supervisor_is_resumed_and_then_removed(tmp_path: Path) -> None:
    first = OwnedRunDir(tmp_path, b"this map")
    first.run_dir.set_epoch(7)
    progress = Progress.create(first.run_dir.progress("link"))
    progress.stamp(time.monotonic_ns())
    progress.close()
    first.keep_for_successor = True
    first.remove()
    second = OwnedRunDir(tmp_path, b"this map", resume=True)
    assert second.run_dir.epoch_ns == 7
    second.remove()
    assert not list(tmp_path.iterdir())


CAMERA = "http://127.0.0.1:80/stream"


def test_the_spec_of_a_recently_killed_run_is_found_so_that_the_map_is_not_inspected_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_dir, "SHM", tmp_path)
    package, out = tmp_path / "a.gpkg", tmp_path / "out"
    config = Config(map=Map(path=str(package)), source=SourceSection(path=CAMERA), link=LinkSection(device="udpin:h:1"))
    spec = msgspec.json.encode(spec_of(PROCESSES, config, package, out, 412.5))

    def ground_amsl_m(source: str = CAMERA, map_path: Path = package, link: str = "udpin:h:1") -> float | None:
        before = recently_killed_spec(RunOptions(source=source, map_path=map_path, link=link, out_dir=out))
        return None if before is None else before.ground_amsl_m

    assert ground_amsl_m() is None
    stale = killed(tmp_path, spec, 5.0)
    assert ground_amsl_m() == 412.5
    assert ground_amsl_m(map_path=tmp_path / "b.gpkg") is None
    assert ground_amsl_m(link="udpin:h:2") is None
    config = msgspec.structs.replace(config, source=SourceSection(path=str(tmp_path)))
    stale.spec.write_bytes(msgspec.json.encode(spec_of(PROCESSES, config, package, out, 412.5)))
    assert ground_amsl_m(source=str(tmp_path)) is None, "a recorded source is not resumed"
    stale.spec.write_bytes(b'{"of another version": 1}')
    assert ground_amsl_m() is None
    stale.spec.write_bytes(spec)
    with (stale.path / "lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert ground_amsl_m() is None, "its supervisor is running"
    shutil.rmtree(stale.path)
    killed(tmp_path, spec, 61.0)
    assert ground_amsl_m() is None


def test_a_recorded_source_is_not_a_live_camera(tmp_path: Path) -> None:
    assert is_camera("/dev/video0")
    assert is_camera("http://127.0.0.1:80/stream")
    assert is_camera("v4l2src device=/dev/video0 ! videoconvert ! appsink " + "x" * 300)
    assert not is_camera(str(tmp_path))
