"""Processor cores that the processes of the daemon may use together."""

import os


def limit_cores(cores: int) -> None:
    """Restricts this process, and libraries that it imports after that, to the first ``cores`` of the cores that it may
    use; 0, or more than there are: to all of these. OpenCV and ONNX Runtime then begin as many threads as there are
    cores in the budget; with more, threads of one process would wait for each other."""
    available = sorted(os.sched_getaffinity(0))
    if 0 < cores < len(available):
        os.sched_setaffinity(0, available[:cores])
