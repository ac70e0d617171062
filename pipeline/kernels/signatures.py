"""Types of the arguments with which the stages call compiled functions. numba compiles a function once for each.

A call with other types works: it is compiled when it is made, in the stage that makes it.
"""

from typing import Any

from numba import types
from numba.types import bool_ as B1
from numba.types import float32 as F4
from numba.types import float64 as F8
from numba.types import int16 as I2
from numba.types import int32 as I4
from numba.types import int64 as I8
from numba.types import uint8 as U1

from pipeline.kernels import pixel_sampling
from pipeline.kernels.adam import cpu as adam
from pipeline.kernels.cholesky_solve import cpu as cholesky_solve
from pipeline.kernels.hashgrid import cpu as hashgrid
from pipeline.kernels.interpolate import cpu as interpolate
from pipeline.kernels.inverse_skinning import cell_skinning_cpu, newton_cpu
from pipeline.kernels.inverse_skinning import cpu as inverse_skinning
from pipeline.kernels.kinematics import cpu as kinematics
from pipeline.kernels.march import cpu as march
from pipeline.kernels.pixel_sampling import cpu as pixel_sampling_cpu
from pipeline.kernels.raster import cpu as raster
from pipeline.kernels.raster import silhouette_cpu
from pipeline.kernels.ray_losses import cpu as ray_losses
from pipeline.kernels.skinned_projection import cpu as skinned_projection
from pipeline.kernels.texel_projection import cpu as texel_projection
from pipeline.kernels.texture_sampling import cpu as texture_sampling
from pipeline.kernels.transmittance_stats import cpu as transmittance_stats
from pipeline.kernels.volume_rendering import backward_cpu
from pipeline.kernels.volume_rendering import cpu as volume_rendering


def named_tuple(tuple_class: type, *fields: Any) -> Any:
    """Return the type of a named tuple with these types of its fields."""
    return types.BaseTuple.from_types(fields, tuple_class)


# Contiguous arrays: type of an element, number of dimensions.
F4_1D, F4_2D, F4_3D, F4_4D = F4[::1], F4[:, ::1], F4[:, :, ::1], F4[:, :, :, ::1]
F8_1D, F8_4D = F8[::1], F8[:, :, :, ::1]
I2_2D = I2[:, ::1]
I4_1D, I4_2D, I4_3D = I4[::1], I4[:, ::1], I4[:, :, ::1]
I8_1D, I8_2D = I8[::1], I8[:, ::1]
U1_2D, U1_3D = U1[:, ::1], U1[:, :, ::1]
STRIDED_F4_2D = F4[:, :]

FEATURES = types.UniTuple(I8, 4)  # features of a level of the hash grid
HASH_TABLE = named_tuple(hashgrid.HashTable, F4_2D, I8_2D)

LATTICE = named_tuple(newton_cpu.LatticeArrays, F4_1D, F4, I4_3D)
SKIN = named_tuple(inverse_skinning.SkinArrays, LATTICE, F4_2D, F4_1D, F4_3D)
POSED_GRID = named_tuple(inverse_skinning.PosedGrid, F4_1D, I8_1D)

SKELETON = named_tuple(kinematics.SkeletonArrays, F4_2D, I8_1D, I8_1D)
POSES = named_tuple(kinematics.PoseArrays, F4_4D, F4_2D, F4_3D)

PIXEL_LISTS = named_tuple(pixel_sampling.PixelLists, I8_2D, I2_2D)
SAMPLE_COUNTS = named_tuple(pixel_sampling.SampleCounts, I8_1D, I8_2D, I8_2D)
TILE_ERRORS = named_tuple(pixel_sampling.TileErrors, F4_3D, I8, F8)
CAMERAS = named_tuple(pixel_sampling.PosedCameras, F4_1D, F4_1D, F4_2D, F4_3D)
PIXEL_RAYS = named_tuple(pixel_sampling_cpu.PixelRays, F4_2D, F4_2D, F4_2D)

LOSS_INPUTS = named_tuple(ray_losses.LossInputs, F4_2D, F4_1D, F4_2D, STRIDED_F4_2D, F4_1D)
LOSS_GRADIENTS = named_tuple(ray_losses.GradientArrays, F4_2D, F4_2D, F4_1D)

RAYS = named_tuple(march.RayArrays, F4_2D, F4_2D, I8_1D, F4_1D)
WARP = named_tuple(march.WarpArrays, F4, F4_2D, I8_2D, I8_2D, F4_2D, I4_1D, F4_2D)
OCCUPANCY = named_tuple(march.OccupancyArrays, U1_3D, F4_1D, F4_1D)
MARCH = named_tuple(march.MarchArrays, RAYS, F4, WARP, OCCUPANCY)
CELL_WEIGHTS = named_tuple(cell_skinning_cpu.CellWeights, F4_1D, F4, I4_3D, I8_1D, I4_1D, F4_2D)
SKINNING = named_tuple(volume_rendering.SkinningArrays, I8_1D, CELL_WEIGHTS, F4_3D)
NETWORK = named_tuple(volume_rendering.NetworkArrays, F4_2D, F4_2D, F4_1D, F4, F4)
FIELD = named_tuple(volume_rendering.FieldArrays, F4_2D, HASH_TABLE, FEATURES, NETWORK, F4_3D)
RENDER = named_tuple(volume_rendering.RenderArrays, MARCH, SKINNING, FIELD, I8, F4)
BUFFERS = named_tuple(
    volume_rendering.SampleBuffers, I4_1D, F4_2D, F4_1D, F4_2D, F4_2D, F4_2D, F4_2D, F4_1D, F4_1D, F4_1D
)
OUTPUT_GRADIENTS = named_tuple(backward_cpu.OutputGradientArrays, F4_2D, F4_1D, F4_1D)
PARAMETER_GRADIENTS = named_tuple(backward_cpu.ParameterGradients, F4_2D, F4_2D, F4_1D, F4_3D, F4_3D)

SKIN_WEIGHTS = named_tuple(skinned_projection.SkinArrays, I8_1D, I8_1D, F4_1D, F4_2D)

MESH = named_tuple(texel_projection.MeshArrays, F4_2D, F4_1D, F4_1D, I4_2D)
TEXEL_SUMS = types.Tuple((F4_2D, F4_1D))
VIEW = named_tuple(texel_projection.ViewArrays, F4_3D, F4_2D, F4_2D)

SIGNATURES: tuple[tuple[Any, tuple[Any, ...]], ...] = (
    # body
    (raster.face_boxes, (F4_2D, F4_1D, I4_2D, types.UniTuple(I8, 2), F8, B1)),
    (raster.bin_faces, (I4_2D, I8)),
    (raster.draw_bands, (F4_2D, F4_1D, I4_2D, I4_2D, I8_1D, I4_1D, I4_2D, F4_2D)),
    (raster.resolve, (F4_2D, F4_1D, I4_2D, I4_2D, F4_3D, F4_2D)),
    # field
    (volume_rendering.evaluate_field, (I8, I8, FIELD, BUFFERS)),
    (transmittance_stats.update_voxel_maxima, (F4_2D, F4_1D, F4_1D, F4_2D, types.UniTuple(I8, 3), F4_1D, F4_1D)),
    (pixel_sampling_cpu.update_error_map, (I8_1D, I8_1D, I2_2D, F4_2D, F8, I8, F4_3D)),
    (adam._update, (F4_1D, F4_1D, F4_1D, F4_1D, F4, F4, F4, F4)),
    (hashgrid.add_table_gradient, (F4_2D, F4_2D, HASH_TABLE, FEATURES)),
    (kinematics.backward, (F4_3D, SKELETON, POSES, F8_4D, F8_4D, F4_4D, F4_3D, F4_2D)),
    (backward_cpu.backward_pass, (RENDER, BUFFERS, I8, F4_1D, F8, OUTPUT_GRADIENTS, PARAMETER_GRADIENTS)),
    (ray_losses.ray_losses, (LOSS_INPUTS, F4, F4_1D, F4_2D, LOSS_GRADIENTS)),
    (volume_rendering.render_rays_fused, (RENDER, BUFFERS, I8, F4_2D, F4_1D)),
    (kinematics.forward, (F4_3D, F4_2D, SKELETON, POSES, F8_4D, F8_4D, F4_4D)),
    (pixel_sampling_cpu.generate_pixel_rays, (I8_1D, I8_1D, I2_2D, U1_2D, F4_2D, CAMERAS, PIXEL_RAYS)),
    (pixel_sampling_cpu.sample_pixels, (PIXEL_LISTS, SAMPLE_COUNTS, TILE_ERRORS, F8_1D, I8_1D, F4_1D)),
    (cell_skinning_cpu.weights_by_cell, (I4_3D, I8_1D, I8_1D, F4_1D, I8)),
    (inverse_skinning.skin_nodes, (F4_2D, F4_3D)),
    (inverse_skinning.bake_warp_grid, (F4_2D, SKIN, POSED_GRID)),
    # mesh
    (skinned_projection.project_skinned_backward, (F4_2D, F4_2D, F4_1D, SKIN_WEIGHTS, types.UniTuple(F8, 4))),
    (skinned_projection.project_skinned, (F4_2D, SKIN_WEIGHTS, types.UniTuple(F8, 4))),
    (cholesky_solve.cholesky_solve, (I8_1D, I4_1D, F4_1D, F4_1D, I8_1D, F4_2D)),
    (raster.silhouette_edges_cpu, (F4_2D, I4_2D, I4_2D)),
    (silhouette_cpu.add_fraction_gradient, (I8_2D, F4_2D, F4_1D, I8)),
    (silhouette_cpu.silhouette_blends_cpu, (I4_2D, F4_2D, F4_2D, F4_1D, I8_2D)),
    (interpolate.interpolate_backward, (I8_1D, I4_1D, I8, F4_2D, F4_1D, I4_2D, F4_2D, F4_2D)),
    (interpolate.interpolate_forward, (I8_1D, I4_1D, I8, F4_2D, F4_1D, I4_2D, F4_2D)),
    (hashgrid.find_nonzero_rows, (F4_2D,)),
    (hashgrid.add_points_gradient, (F4_2D, HASH_TABLE, FEATURES, F4_2D, F4_2D)),
    (hashgrid.encode, (F4_2D, HASH_TABLE, FEATURES, F4_2D)),
    # texture and report
    (texel_projection.add_projections, (TEXEL_SUMS, MESH, I4_1D, F4_2D, VIEW, types.UniTuple(F8, 4))),
    (texel_projection.project_texels, (MESH, I4_1D, F4_2D, VIEW, F8, F8)),
    (texture_sampling.supersample_texture_cpu, (I4_2D, F4_3D, I4_2D, F4_2D, F4_3D, I8)),
    (texture_sampling.supersample_attributes_cpu, (I4_2D, F4_3D, I4_2D, F4_2D, I8)),
)
"""Function and types of its arguments, by stage. Those of a stage are in the reverse order of their use: a stage that
starts before all are compiled begins at the other end, and does not compile what is being compiled."""
