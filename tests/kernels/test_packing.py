"""The owner of packed things against a loop that hands them out."""

import pytest
import torch

from pipeline.kernels.common.packing import owner_of_each


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("counts", [[], [0, 0], [3], [2, 0, 1, 4, 0]])
def test_each_thing_knows_its_owner(counts, dtype):
    expected = [owner for owner, count in enumerate(counts) for _ in range(count)]
    owner = owner_of_each(torch.tensor(counts, dtype=dtype))
    assert owner.dtype == torch.int64
    assert owner.tolist() == expected
