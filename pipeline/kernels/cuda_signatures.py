"""Types of the arguments with which the training launches CUDA kernels, as in `pipeline.kernels.signatures`."""

from typing import Any

from numba import types

from pipeline.kernels.adam import cuda as adam
from pipeline.kernels.hashgrid import cuda as hashgrid
from pipeline.kernels.inverse_skinning import cuda as inverse_skinning
from pipeline.kernels.march import Rays
from pipeline.kernels.march import cuda as march
from pipeline.kernels.ray_losses import cuda as ray_losses
from pipeline.kernels.signatures import (
    F4,
    F4_1D,
    F4_2D,
    F4_3D,
    I4_1D,
    I4_3D,
    I8,
    I8_1D,
    I8_2D,
    U1_3D,
    named_tuple,
)
from pipeline.kernels.transmittance_stats import cuda as transmittance_stats
from pipeline.kernels.volume_rendering import cuda as volume_rendering

RAYS = named_tuple(Rays, F4_2D, F4_2D, I8_1D, F4_1D)
WARP = named_tuple(march.WarpTensors, F4, F4_2D, I8_2D, I8_2D, F4_2D, I4_1D, F4_2D)
OCCUPANCY = named_tuple(march.OccupancyTensors, U1_3D, F4_1D, F4_1D)
SAMPLES = named_tuple(march.SampleTensors, F4_2D, F4_1D, I4_1D)
CELLS = named_tuple(inverse_skinning.CellTensors, F4_1D, F4, I4_3D, I8_1D, I4_1D, F4_2D)
FRAMES = named_tuple(inverse_skinning.FrameTensors, I8_1D, F4_3D, CELLS)
LOSS_RAYS = named_tuple(ray_losses.RayTensors, F4_2D, F4_1D, F4_2D, F4_2D, F4_1D)
COMPOSITED = named_tuple(volume_rendering.CompositedTensors, F4_1D, F4_2D, F4_1D, F4_1D, F4_1D)
F4_3, I8_3 = types.UniTuple(F4, 3), types.UniTuple(I8, 3)

SIGNATURES: tuple[tuple[Any, tuple[Any, ...]], ...] = (
    (march.march_rays, (RAYS, F4, WARP, OCCUPANCY, I8, SAMPLES, I8_1D)),
    (march.pack_samples, (SAMPLES, I8_1D, I8, SAMPLES)),
    (hashgrid.encode_points, (F4_2D, F4_2D, I8_2D, I8, F4_2D)),
    (volume_rendering.composite_samples, (I8_1D, F4, COMPOSITED, F4_2D)),
    (ray_losses.add_ray_losses, (LOSS_RAYS, F4, F4_3, F4_1D, F4_2D, F4_2D, F4_1D)),
    (volume_rendering.network_output_gradients, (I8_1D, F4, COMPOSITED, F4_2D, F4_1D, F4_2D)),
    (hashgrid.scatter_table_gradient, (F4_2D, F4_2D, I8_2D, I8, F4_2D)),
    (transmittance_stats.update_maxima, (F4_2D, F4_1D, F4_1D, F4_2D, I8_3, F4_1D, F4_1D)),
    (adam.update_elements, (F4_1D, F4_1D, F4_1D, F4_1D, F4, F4, F4, F4)),
    (inverse_skinning.step_samples, (F4_2D, F4_1D, I4_1D, RAYS, FRAMES, F4_2D, F4_2D)),
    (hashgrid.gather_points_gradient, (F4_2D, F4_2D, I8_2D, F4_2D, I8, F4_2D)),
    (inverse_skinning.scatter_matrix_gradient, (F4_2D, I4_1D, FRAMES, F4_2D, F4_2D, F4_3D)),
)
"""Kernel and types of its arguments, in the order in which a training first calls them."""
