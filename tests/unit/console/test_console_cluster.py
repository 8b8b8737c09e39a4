"""Flights that a Dask cluster computes: the results and events of this computer, also when a worker dies."""

import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from console_flight import AGL_M, GROUND, lat_lon, make_map, place_of, write_images
from console_rig import WAIT_FOR_RESULT_S, Console, settings
from map_cluster import LocalCluster, local_cluster
from terrafix_tools.cli import app
from terrafix_tools.console.client import ConsoleClient
from terrafix_tools.console.payloads import NewFlight
from terrafix_tools.parallel.pool import check_scheduler

FRAMES = range(10, 20)
KILLED_AT = 8  # event, of a flight of some 50


def new_flight() -> NewFlight:
    lat, lon = lat_lon(place_of(FRAMES[0]))
    camera = {"width": 640, "height": 480, "fx": 380.0, "cx": 319.5, "cy": 239.5, "distortion": [0, 0, 0, 0]}
    return NewFlight.model_validate(
        {"camera": camera, "map": "ground", "height_m": AGL_M, "yaw_deg": 90.0, "start": {"lat": lat, "lon": lon}}
    )


def computing(cluster: LocalCluster) -> list[int]:
    """Indices of the workers that have a child process."""
    parents = {int(path.read_text().rpartition(")")[2].split()[1]) for path in Path("/proc").glob("[0-9]*/stat")}
    return [i for i, worker in enumerate(cluster.workers) if worker.pid in parents]


def flown(data: Path, maps: Path, images: list[tuple[str, Path]], cluster: LocalCluster | None) -> list[Any]:
    """Results, refined results, fragments and events of a flight; of a cluster the first worker that has it is
    killed."""
    chosen = settings(data, workers=1, maps=(maps,), scheduler=cluster.address if cluster else "")
    with Console(chosen) as console:
        client = ConsoleClient(console.url)
        flight_id = client.create(new_flight()).flight_id
        list(client.upload(flight_id, images))
        client.complete(flight_id)
        events = []
        for event in client.events(flight_id):
            events.append((event.name, event.data))
            if event.event_id == KILLED_AT and cluster:
                (busy,) = computing(cluster)
                cluster.workers[busy].kill()
                cluster.workers[busy].wait()
        assert cluster is None or [worker.poll() for worker in cluster.workers].count(None) == 1
        results = [client.results(flight_id, refined=refined).results for refined in (False, True)]
        return [results, client.flight(flight_id).fragments, events]


@pytest.mark.slow
def test_a_cluster_whose_worker_is_killed_gives_the_results_and_events_of_this_computer(tmp_path: Path) -> None:
    make_map(tmp_path / "maps")
    images = write_images(tmp_path, FRAMES, GROUND)
    expected = flown(tmp_path / "here", tmp_path / "maps", images, None)
    (tmp_path / "cluster").mkdir()
    with local_cluster(tmp_path / "cluster", workers=2) as cluster:
        found = flown(tmp_path / "there", tmp_path / "maps", images, cluster)
        until = time.monotonic() + WAIT_FOR_RESULT_S
        while computing(cluster):
            assert time.monotonic() < until, "the program ends with its flight"
            time.sleep(0.05)
    assert len(found[0][0]) == len(FRAMES)
    assert found == expected


def test_a_service_whose_scheduler_does_not_answer_does_not_start(tmp_path: Path) -> None:
    words = ["serve", "--data", str(tmp_path), "--scheduler", "tcp://127.0.0.1:1"]
    refused = CliRunner().invoke(app, words)
    assert "no Dask scheduler answers there" in str(refused.exception)
    with pytest.raises(Exception, match="write tcp://host:port"):
        check_scheduler("127.0.0.1:8786")
