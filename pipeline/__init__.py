"""Video to avatar: `core` runs stages, the rest is what they are made of."""

import os

# torch and numba each keep a pool of OpenMP threads that would spin for work on the same cores. Two spinning pools, or
# one beside any other program, slow a small step down tenfold; sleeping costs a quiet machine little. OpenMP reads this
# when it is loaded, so it is set before anything else is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# The libraries for matrices of NumPy and SciPy each have a pool of their own, which the workers of a thread pool would
# wait for in turns. Products here are too small to be divided; it is the workers that share them out.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
