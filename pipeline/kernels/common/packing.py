"""Things packed one owner after the other: the samples of rays, the pixels of triangles, the entries of rows."""

import torch
from jaxtyping import Int
from torch import Tensor


def segment_ids_from_counts(counts: Int[Tensor, "n"]) -> Int[Tensor, "m"]:
    """Which of the n owners has each of the m packed things (int64), when owner i has the next `counts[i]` of them."""
    return torch.repeat_interleave(counts.long())
