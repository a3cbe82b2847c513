"""Benchmarks of imgcal and its peers."""

import os

# Before NumPy is imported: for small matrices, the threads of its BLAS mostly wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
