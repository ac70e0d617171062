"""Segment of each packed element, compared with a loop."""

import pytest
import torch

from pipeline.kernels.common.packing import segment_ids_from_counts


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("counts", [[], [0, 0], [3], [2, 0, 1, 4, 0]])
def test_segment_ids_match_a_loop(counts, dtype):
    expected = [segment for segment, count in enumerate(counts) for _ in range(count)]
    segment_ids = segment_ids_from_counts(torch.tensor(counts, dtype=dtype))
    assert segment_ids.dtype == torch.int64
    assert segment_ids.tolist() == expected
