"""Terrafix: a GPS receiver made of a camera and a map."""

import os

from terrafix.core.allocator import keep_freed_memory

__version__ = "0.1.0"

# Before numpy is imported. Matrices are small here and processes share the cores: a thread of BLAS that waits for a
# core holds up all the others. On two busy cores a frame of the estimator took 12 ms (99 %: 320), with one thread 5.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Before OpenCV is imported: pixels of the largest image that it decodes. A file of a few kB may state 2^30, 3 GB; the
# largest cameras have 100 to 150 million.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(160_000_000))

keep_freed_memory()
