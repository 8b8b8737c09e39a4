"""A build on a Dask cluster: identical bytes, also when a worker dies; the error without a cluster."""

import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import map_rasters
from map_cluster import local_cluster
from terrafix.map.package import MapPackage
from terrafix_tools.installation import install_command
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.package.dem import TILES_PER_WORKER, height_places

ENOUGH = 400_000  # bytes of the package that is being written: some chunks are in it, more are to come


def command(tif: Path, out: Path, address: str, *more: str) -> list[str]:
    terrafix = "import sys; from terrafix_tools.cli import main; main()"
    return [sys.executable, "-c", terrafix, "map", "build", str(tif), "--out", str(out), "--scheduler", address, *more]


def written(out: Path) -> int:
    """Size in bytes of an unfinished package."""
    return sum(part.stat().st_size for part in out.parent.glob(f".{out.name}.*/part.gpkg"))


@pytest.mark.nightly
@pytest.mark.slow
def test_a_cluster_build_is_byte_identical_also_when_a_worker_is_killed(tmp_path: Path) -> None:
    """End to end: the real scheduler, three real workers, the command line; then the scheduler dies."""
    bands = np.tile(map_rasters.texture(500, 500), (1, 13, 10))
    bands[:, :300] = 0  # a collar mask, which the workers read from a file
    tif = map_rasters.utm(tmp_path / "i.tif", bands, pixel_m=0.6, tiled=True)
    heights = np.tile(map_rasters.texture(500, 500, seed=1)[:1], (1, 6, 5)).astype(np.float32)
    dem = map_rasters.utm(tmp_path / "d.tif", heights, pixel_m=2.0)
    (tmp_path / "cluster").mkdir()
    here, there = tmp_path / "here" / "m.gpkg", tmp_path / "there" / "m.gpkg"
    build(tif, here, dem=dem)
    grid = MapPackage.open(here).manifest.dem
    assert grid and len(height_places(grid)) >= TILES_PER_WORKER  # otherwise the cluster computes no elevation tiles
    with local_cluster(tmp_path / "cluster", workers=3) as cluster:
        line = command(
            tif, there, cluster.address, "--dem", dem.name
        )  # seen from the folder of the command, not theirs
        building = subprocess.Popen(line, stderr=subprocess.PIPE, cwd=tmp_path)
        while written(there) < ENOUGH and building.poll() is None:
            time.sleep(0.02)
        assert building.poll() is None, building.communicate()[1]
        cluster.workers[0].kill()
        _, stderr = building.communicate(timeout=120)
        assert building.returncode == 0, stderr
        assert there.read_bytes() == here.read_bytes()
        assert all(worker.poll() is None for worker in cluster.workers[1:])

        tif.write_bytes(tif.read_bytes()[:70_000_000])
        done = subprocess.run(command(tif, there, cluster.address), capture_output=True, text=True, timeout=120)
        assert done.returncode == 5 and "i.tif: cannot be read near" in done.stderr.splitlines()[-1]
        assert there.read_bytes() == here.read_bytes()
    assert [path.name for path in there.parent.iterdir()] == ["m.gpkg"]


@pytest.mark.slow
def test_an_unreachable_cluster_is_reported(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    done = subprocess.run(command(tif, tmp_path / "m.gpkg", address), capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"terrafix: --scheduler {address}: no Dask scheduler answers there")
    assert not (tmp_path / "m.gpkg").exists()


def test_without_dask_the_error_names_the_package_to_install(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300))
    hidden = command(tif, tmp_path / "m.gpkg", "tcp://127.0.0.1:1")
    hidden[2] = "import sys; sys.modules['distributed'] = None; " + hidden[2]
    done = subprocess.run(hidden, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr == f"terrafix: --scheduler needs distributed; install it: {install_command('cluster')}\n"
