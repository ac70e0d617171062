"""Packing of warp grids: the same rows as a concatenation, without a second copy of all grids in memory."""

import tracemalloc
from collections.abc import Iterator

import numpy as np

from pipeline.kernels.inverse_skinning import WarpGrid
from pipeline.kernels.march import PackedWarpGrids

CELL_M = 0.03


def random_grids(count: int, nodes: int) -> Iterator[WarpGrid]:
    """Grids of different lengths, made one after the other."""
    rng = np.random.default_rng(0)
    for index in range(count):
        own = nodes + index
        yield WarpGrid(
            origin_m=rng.random(3, dtype=np.float32),
            dims=rng.integers(2, 9, 3),
            canonical_m=rng.random((own, 3), dtype=np.float32),
            cell_codes=rng.integers(-1, 9, own - 1).astype(np.int32),
            affine_maps=rng.random((index % 3, 12), dtype=np.float32),
        )


def test_packed_grids_are_the_concatenated_ones() -> None:
    grids, packed = list(random_grids(7, 50)), PackedWarpGrids.from_grids(random_grids(7, 50), CELL_M)
    for name in ("canonical_m", "cell_codes", "affine_maps"):
        joined = getattr(packed, name).numpy()
        np.testing.assert_array_equal(joined, np.concatenate([getattr(grid, name) for grid in grids]))
        assert joined.dtype == getattr(grids[0], name).dtype
    for index, grid in enumerate(grids):
        node, cell, affine = packed.offsets[index].tolist()
        np.testing.assert_array_equal(packed.canonical_m[node : node + len(grid.canonical_m)].numpy(), grid.canonical_m)
        np.testing.assert_array_equal(packed.cell_codes[cell : cell + len(grid.cell_codes)].numpy(), grid.cell_codes)
        np.testing.assert_array_equal(
            packed.affine_maps[affine : affine + len(grid.affine_maps)].numpy(), grid.affine_maps
        )
        np.testing.assert_array_equal(packed.dims[index].numpy(), grid.dims)


def test_packing_needs_little_more_memory_than_its_result() -> None:
    tracemalloc.start()
    try:
        packed = PackedWarpGrids.from_grids(random_grids(40, 20_000), CELL_M)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.15 * sum(tensor.nbytes for tensor in packed.tensors())
