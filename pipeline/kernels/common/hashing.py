"""Constants of the spatial hash, shared by the compiled loops and the reference (Müller et al. 2022, equation 4)."""

PRIMES = (2654435761, 805459861)
"""Factors of y and z. The factor of x is 1, so that neighbours along x share cache lines."""
