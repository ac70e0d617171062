"""Packed segments: samples of rays, pixels of triangles, entries of matrix rows, one segment after the other."""

import torch
from jaxtyping import Int
from torch import Tensor


def segment_ids_from_counts(counts: Int[Tensor, "n"]) -> Int[Tensor, "m"]:
    """Return the segment (int64) of each of the m = sum(counts) packed elements; segment i has `counts[i]` of them."""
    return torch.repeat_interleave(counts.long())
