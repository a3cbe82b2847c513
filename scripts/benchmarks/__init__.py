"""Benchmarks of imgcal beside its peers."""

import os

# Before NumPy is imported: with small matrices the threads of its BLAS wait for each other more than they work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
