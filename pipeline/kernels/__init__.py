"""Kernels: operations that are compiled with numba for float32, with a plain-torch reference for the rest.

Each kernel is a folder:

    hashgrid/__init__.py    the public operation: checks, choice of the implementation, autograd function
    hashgrid/cpu.py         the compiled loops of the CPU, on numpy arrays
    hashgrid/cuda.py        the kernels for a CUDA GPU, where the training has one; imported only there
    hashgrid/reference.py   the reference in plain torch: any dtype, any device, gradients by autograd
    hashgrid/inputs.py      named tuples of tensors, where operation and reference share them

To add a kernel:

1. Write `reference.py` first. It defines the operation, and it runs on a GPU and in float64.
2. Write `cpu.py` with `@njit(**NJIT_OPTIONS)` (`common/numba_options.py`); the file name ends in `cpu.py`, so that the
   cache key covers it. Arguments are arrays, scalars and named tuples of these. A `parallel=True` function takes flat
   named tuples, as arguments of its own: numba cannot pass a nested tuple, or one taken out of another tuple, to the
   body of a `prange` loop. Each thread writes rows of its own, so that the result does not depend on the number of
   threads.
3. Write the operation in `__init__.py`: `runs_on_numba` chooses the implementation. At most 8 parameters.
4. Add `tests/kernels/test_<kernel>.py`: values and gradients of the compiled loops against the reference in float64, a
   closed form, `gradcheck` of the reference; for a parallel loop an entry in `tests/kernels/test_threads.py`.
5. On a GPU the reference runs. If that is too slow, write `cuda.py` with `@cuda.jit(**CUDA_OPTIONS)` and `launch`
   (`common/cuda.py`), `runs_on_cuda` in the operation, its types in `cuda_signatures.py`, and a test in
   `tests/kernels/test_cuda.py`, which numba's simulator runs where there is no GPU.
6. If the kernel takes a noticeable part of a run, add it to `tests/bench/bench_kernels.py`.
"""

import os

# pymeshlab includes an old libtbb, for which numba's default layer prints a warning and falls back to OpenMP.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
# LLVM then combines the few floats of a hash-grid row into one vector instruction: 1.7 to 2.6 times faster.
os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")
