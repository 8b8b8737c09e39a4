"""Our processes use one BLAS thread each, because their matrices are small and they share the cores."""

import os
import subprocess
import sys

PROGRAM = """
import os
import terrafix.messages
import numpy
numpy.ones((500, 500)) @ numpy.ones((500, 500))
print(len(os.listdir("/proc/self/task")))
"""


def test_numpy_starts_no_threads() -> None:
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "1"
