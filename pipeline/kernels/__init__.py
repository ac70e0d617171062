"""Kernels: one public operation a module, a numba version for the CPU and a plain-torch twin for all else."""

import os

# pymeshlab brings an old libtbb along, at which numba's default layer only warns; OpenMP is what it would fall back to.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
# LLVM then joins the few floats of a hash-grid row into one vector instruction: 1.7 to 2.6 times faster.
os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")
