"""The files that a comparison with the truth writes into a run's report folder."""

TRUTH_FILES = ("truth.html", "truth.json")
TRUTH_VERSION = 3
"""Raised whenever the content or the meaning of a comparison changes, so that it is made again."""
