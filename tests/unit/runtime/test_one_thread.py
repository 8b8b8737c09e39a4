"""Our processes use one BLAS thread each, because their matrices are small and they share the cores; what forks has one
thread."""

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


FORK_SERVER = """
import os
import sys
from terrafix.runtime import process_main
process_main.SHARED_LIBRARIES = ("no_such_library", *process_main.SHARED_LIBRARIES)
process_main.import_shared_libraries()
print(len(os.listdir("/proc/self/task")), *sorted({"cv2", "gtsam", "onnxruntime"} & set(sys.modules)))
"""


def test_the_fork_server_imports_opencv_and_gtsam_once_for_all_and_has_one_thread() -> None:
    """A process that is forked while another thread holds a lock would wait for that lock for ever. A library that
    cannot be imported does not end the fork server."""
    done = subprocess.run([sys.executable, "-c", FORK_SERVER], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == ["1", "cv2", "gtsam"]
