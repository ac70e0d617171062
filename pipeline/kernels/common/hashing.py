"""The spatial hash's constants, shared by the compiled loops and their twin (Müller et al. 2022, equation 4)."""

PRIMES = (2654435761, 805459861)
"""Factors of y and z; x has the factor 1, so that neighbours along x share cache lines."""
