"""Terrafix: a GPS receiver made of a camera and a map."""

import os

from terrafix.core.allocator import keep_freed_memory

__version__ = "0.1.0"

# Before numpy is imported. Matrices are small here and processes share the cores: a thread of BLAS that waits for a
# core holds up all the others. On two busy cores a frame of the estimator took 12 ms (99 %: 320), with one thread 5.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

keep_freed_memory()
