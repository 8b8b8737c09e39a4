"""A Dask cluster of real processes on this machine: scheduler and workers, which tests can kill."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

DEADLINE_S = 120.0  # for the start of the scheduler; long, because the machine may be busy


class LocalCluster:
    def __init__(self, folder: Path, workers: int) -> None:
        self.children: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        self._start("scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
        deadline_s = time.monotonic() + DEADLINE_S
        while True:
            try:
                self.address: str = json.loads(file.read_text())["address"]
                break
            except (FileNotFoundError, json.JSONDecodeError):
                assert time.monotonic() < deadline_s and self.children[0].poll() is None, "no scheduler"
                time.sleep(0.1)
        for number in range(workers):
            folder_of_worker = folder / f"worker-{number}"
            folder_of_worker.mkdir()
            # Without a nanny, which would restart a killed worker.
            options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder_of_worker))
            self._start("worker", self.address, *options)

    @property
    def scheduler(self) -> "subprocess.Popen[bytes]":
        return self.children[0]

    @property
    def workers(self) -> "list[subprocess.Popen[bytes]]":
        return self.children[1:]

    def stop(self) -> None:
        for child in reversed(self.children):
            child.kill()
        for child in self.children:
            child.wait()

    def _start(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "dask", *arguments]
        self.children.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))


@contextmanager
def local_cluster(folder: Path, workers: int) -> Iterator[LocalCluster]:
    cluster = LocalCluster(folder, workers)
    try:
        yield cluster
    finally:
        cluster.stop()
