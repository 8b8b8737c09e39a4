"""Core budget: affinity, and the threads of the libraries that are imported after it."""

import os
import subprocess
import sys

import pytest

LIMITED = """
import os
from terrafix.runtime.core_budget import limit_cores
limit_cores({cores})
import cv2
print(len(os.sched_getaffinity(0)), cv2.getNumThreads())
"""


def cores_and_threads(cores: int) -> tuple[int, int]:
    done = subprocess.run(
        [sys.executable, "-c", LIMITED.format(cores=cores)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    count, threads = done.stdout.split()
    return int(count), int(threads)


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="a budget below one core cannot be shown on one core")
def test_with_a_budget_of_one_core_opencv_has_one_thread() -> None:
    assert cores_and_threads(1) == (1, 1)


@pytest.mark.parametrize("cores", [0, 256])
def test_without_a_budget_or_with_one_of_more_cores_than_there_are_all_are_used(cores: int) -> None:
    all_of_them = len(os.sched_getaffinity(0))
    assert cores_and_threads(cores) == (all_of_them, all_of_them)
