"""All of Terrafix was killed in flight and is started again: what it takes from the run before."""

import time
from pathlib import Path

import pytest

from terrafix.core.progress import Progress
from terrafix.core.rundir import PREFIX, OwnedRunDir, RunDir
from terrafix.supervisor import _is_camera


def killed(parent: Path, spec: bytes, age_s: float) -> RunDir:
    dead = RunDir(parent / f"{PREFIX}dead")
    dead.path.mkdir()
    (dead.path / "lock").touch()
    dead.spec.write_bytes(spec)
    dead.set_epoch(7)
    dead.kept("estimator").write_bytes(b"the newest estimate")
    progress = Progress.create(dead.progress("link"))
    progress.stamp(time.monotonic_ns() - round(age_s * 1e9))
    progress.close()
    return dead


@pytest.mark.parametrize(
    ("spec", "camera", "age_s", "goes_on"),
    [
        (b"this map", True, 5.0, True),
        (b"this map", False, 5.0, False),
        (b"another map", True, 5.0, False),
        (b"this map", True, 61.0, False),
    ],
)
def test_it_goes_on_from_a_run_of_the_same_that_was_killed_just_now(
    tmp_path: Path, spec: bytes, camera: bool, age_s: float, goes_on: bool
) -> None:
    dead = killed(tmp_path, spec, age_s)
    owned = OwnedRunDir(tmp_path, b"this map", goes_on=camera)
    try:
        assert owned.run_dir.epoch_ns == (7 if goes_on else None)
        assert owned.run_dir.kept("estimator").exists() == goes_on
        assert not dead.path.exists()
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


def test_a_recording_is_no_camera(tmp_path: Path) -> None:
    assert _is_camera("/dev/video0")
    assert _is_camera("http://127.0.0.1:80/stream")
    assert _is_camera("v4l2src device=/dev/video0 ! videoconvert ! appsink " + "x" * 300)
    assert not _is_camera(str(tmp_path))
