"""Optimisation of vertex positions and surface colours by gradient descent through the differentiable rasteriser.

Notation: x0 initial positions, D per-vertex offsets, G one global offset (delta v_i and delta V of the IHM paper,
section 2.3); x = x0 + D + G. The optimised variable is u = (I + lambda L) D with the graph Laplacian L instead of D, so
that each step moves neighbouring vertices together (Nicolet et al., "Large Steps in Inverse Rendering of Geometry",
2021).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial, reduce
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import csr_array, diags_array, eye_array
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.core.progress import track
from pipeline.field.field import FieldColours
from pipeline.geometry.linear_systems import factorise_positive_definite
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import adjacency, laplacian
from pipeline.kernels.adam import adam_step_
from pipeline.kernels.cholesky_solve import CholeskyFactors, cholesky_solve
from pipeline.kernels.common.thread_pool import ThreadPool, shared_thread_pool
from pipeline.kernels.hashgrid import FeatureGradients, add_table_gradient_
from pipeline.mesh.remeshing import face_of_person
from pipeline.mesh.settings import MeshSettings
from pipeline.mesh.skin_transfer import SkinnedTopology
from pipeline.mesh.views import PosedView, Shader, sampled_losses

MAX_EDGE_WEIGHT = 16.0
"""Largest weight of an edge in the smoothing of the gradients: that of a quarter of the median length."""
STIFFNESS = 12.0
"""Weight of edges of the face, which moves almost as a whole: its details are the body model's, and dark brows or lips
would become grooves."""


@dataclass(frozen=True)
class RefinementInputs:
    """Everything that a refinement needs besides the initial mesh.

    body: source of the skin weights. train, validation: views for optimisation and for validation. train_motion,
    validation_motion: poses of the first views of either kind, in time order; those are aligned to the surface between
    rounds, unless there are none. shader: module that maps canonical points (n, 3) in m to colours (n, 3) in [0, 1];
    its parameters that require a gradient are optimised. target_edge_m: target edge length, m. rounds: number of
    rounds. steps: optimiser steps per round. max_faces: no face is subdivided beyond this number of faces.
    """

    body: Body
    train: Sequence[PosedView]
    validation: Sequence[PosedView]
    shader: torch.nn.Module
    target_edge_m: float
    rounds: int
    steps: int
    max_faces: int
    train_motion: Motion | None = None
    validation_motion: Motion | None = None
    settings: MeshSettings = field(default_factory=MeshSettings)


def factorise_smoothing_matrix(mesh: Mesh, stiff: Bool[np.ndarray, "f"], smoothing_lambda: float) -> CholeskyFactors:
    """Factorise I + lambda L with the combinatorial Laplacian L = degree - adjacency.

    An edge has the weight (median length / length)^2, at most `MAX_EDGE_WEIGHT`, so that the smoothing reaches equally
    far, in metres, where the edges are short. Edges of stiff faces weigh `STIFFNESS` times as much.
    """
    ends, count = mesh.edges(), len(mesh.vertices)
    stiff_vertex = np.zeros(count, dtype=bool)
    stiff_vertex[mesh.faces[stiff]] = True
    length_m = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1).astype(np.float64)
    weight = np.minimum((np.median(length_m) / np.maximum(length_m, 1e-9)) ** 2, MAX_EDGE_WEIGHT)
    weight[stiff_vertex[ends].all(axis=1)] *= STIFFNESS
    weighted = adjacency(mesh, weight)
    combinatorial = diags_array(np.asarray(weighted.sum(axis=1)).ravel()) - weighted
    matrix = eye_array(count) + smoothing_lambda * combinatorial
    return CholeskyFactors.from_superlu(factorise_positive_definite(matrix))


def optimise_vertices(
    mesh: Mesh, skin: SkinnedTopology, inputs: RefinementInputs, seed: int, label: str = "refine"
) -> Mesh:
    """Optimise the vertices so that renders of the mesh match the training views; the faces stay.

    The parameters of `inputs.shader` are optimised in place: the colours of volume rendering differ from the colours at
    the surface, and without their optimisation the vertices would compensate for the difference.

    Args:
        mesh: the initial mesh, m.
        skin: its topology and skin weights.
        inputs: training views, shader, number of steps and settings.
        seed: seed of the frame order and of the backgrounds.
        label: label of the progress bar.
    """
    settings = inputs.settings
    generator = torch.Generator().manual_seed(seed)
    start = torch.from_numpy(mesh.vertices.astype(np.float32))
    stiff = face_of_person(mesh, inputs.body)
    factors = factorise_smoothing_matrix(mesh, stiff, settings.smoothing_lambda)
    operator = csr_array(laplacian(mesh)).astype(np.float32)
    squared_laplacian = csr_array(operator.T @ operator)
    coordinates, global_offset = torch.zeros_like(start), torch.zeros(3)
    learning_rates = [settings.learning_rate * (1.0 + settings.smoothing_lambda), settings.global_learning_rate]
    offset_optimiser = AdamUniform([coordinates, global_offset], learning_rates)
    colour_optimiser = ColourOptimiser(inputs.shader, settings.appearance_learning_rate)
    warm_up = settings.appearance_steps if colour_optimiser.leaves else 0
    threads = shared_thread_pool(settings.frames_per_step)
    for step in track(range(warm_up + inputs.steps), label):
        offset = cholesky_solve(factors, coordinates)
        vertices = (start + offset + global_offset).requires_grad_(step >= warm_up)
        gradients = _batch_gradients(vertices, colour_optimiser, skin, inputs, generator, threads)
        decay = 0.5 * (1.0 + math.cos(math.pi * step / (warm_up + inputs.steps)))
        if gradients.vertices is not None:
            of_offset, of_global = regularisation_gradients(offset, global_offset, squared_laplacian, inputs)
            # (I + lambda L) is symmetric, so that the gradient of u is smoothed like u itself.
            of_coordinates = cholesky_solve(factors, of_offset + gradients.vertices)
            offset_optimiser.step((of_coordinates, of_global + gradients.vertices.sum(0)), decay)
        colour_optimiser.step(gradients, decay)
    moved = start + cholesky_solve(factors, coordinates) + global_offset
    return Mesh(moved.numpy(), mesh.faces)


class BatchGradients(NamedTuple):
    """Gradients of the mean loss of some views.

    vertices: None if they are not optimised, or not seen. colours: of `ColourOptimiser.leaves`; None where autograd has
    none. features: of the hash grid, in the order of the views.
    """

    vertices: Float[Tensor, "v 3"] | None
    colours: Sequence[Tensor | None]
    features: FeatureGradients


class ColourOptimiser:
    """Adam on those parameters of a shader that require a gradient, `leaves`.

    Autograd would allocate, clear and add up a gradient of the whole hash table for each view; it is added up outside
    of autograd, once for all views of a step.
    """

    def __init__(self, shader: torch.nn.Module, learning_rate: float) -> None:
        self._shader, self._learning_rate, self._count = shader, learning_rate, 0
        self._field = shader.field if isinstance(shader, FieldColours) and shader.field.table.requires_grad else None
        self.leaves = [parameter for parameter in shader.parameters() if parameter.requires_grad]
        self._moments = [(torch.zeros_like(leaf), torch.zeros_like(leaf)) for leaf in self.leaves]
        self._grad_table = torch.zeros_like(self._field.table) if self._field else torch.zeros(0)

    def shader(self, feature_gradients: FeatureGradients) -> Shader:
        """Return the shader of one view; its backward pass appends the gradients of the features to the list."""
        return partial(self._shader, feature_gradients=feature_gradients) if self._field else self._shader

    def step(self, gradients: BatchGradients, learning_rate_scale: float) -> None:
        """Update the parameters with the learning rate times `learning_rate_scale`."""
        self._count += 1
        rate = self._learning_rate * learning_rate_scale
        for leaf, gradient, moments in zip(self.leaves, gradients.colours, self._moments, strict=True):
            if self._field and leaf is self._field.table:
                add_table_gradient_(self._grad_table, gradients.features, self._field.layout)
                gradient = self._grad_table
            elif gradient is None:
                # No view has a covered pixel.
                gradient = torch.zeros_like(leaf)
            adam_step_(leaf, gradient, *moments, self._count, rate, epsilon=1e-12)


def _batch_gradients(
    vertices: Float[Tensor, "v 3"],
    colours: ColourOptimiser,
    skin: SkinnedTopology,
    inputs: RefinementInputs,
    generator: torch.Generator,
    threads: ThreadPool,
) -> BatchGradients:
    """Return the gradients of the mean loss of a batch of random training views on random backgrounds.

    The views are rendered in parallel; their gradients are summed in a fixed order.
    """
    settings = inputs.settings
    chosen = torch.randint(len(inputs.train), (settings.frames_per_step,), generator=generator).tolist()
    backgrounds = [torch.rand(3, generator=generator) for _ in chosen]
    phases = torch.randint(settings.pixel_stride, (len(chosen),), generator=generator).tolist()

    def gradients_of_view(
        k: int, background: Float[Tensor, "3"], phase: int
    ) -> tuple[Sequence[Tensor | None], FeatureGradients]:
        leaf_vertices = vertices.detach().requires_grad_(vertices.requires_grad)
        feature_gradients: FeatureGradients = []
        shader, lattice = colours.shader(feature_gradients), (settings.pixel_stride, phase)
        colour_loss, silhouette_loss = sampled_losses(leaf_vertices, skin, inputs.train[k], shader, background, lattice)
        loss = (settings.colour_weight * colour_loss + settings.silhouette_weight * silhouette_loss) / len(chosen)
        leaves = ([leaf_vertices] if leaf_vertices.requires_grad else []) + colours.leaves
        return torch.autograd.grad(loss, leaves, allow_unused=True), feature_gradients

    by_view, features = zip(*threads.map(gradients_of_view, chosen, backgrounds, phases), strict=True)
    summed = [_sum_of_present(gradients) for gradients in zip(*by_view, strict=True)]
    of_vertices = summed.pop(0) if vertices.requires_grad else None
    return BatchGradients(of_vertices, summed, [part for parts in features for part in parts])


def _sum_of_present(gradients: Sequence[Tensor | None]) -> Tensor | None:
    """Return the sum, in order, of the gradients that are not None; None if there is none."""
    present = [gradient for gradient in gradients if gradient is not None]
    return reduce(torch.add, present) if present else None


def regularisation_gradients(
    offset: Float[Tensor, "v 3"],
    global_offset: Float[Tensor, "3"],
    squared_laplacian: csr_array,
    inputs: RefinementInputs,
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "3"]]:
    """Return the gradients of the weighted sum of squared Laplacian of the offsets, offsets and global offset.

    Lengths are in edge lengths; squares are averaged over the vertices. The Laplacian is that of the offsets, not of
    the positions, so that curved details of the initial mesh stay. squared_laplacian: its transpose times itself.
    """
    settings, scale = inputs.settings, 2.0 / inputs.target_edge_m**2
    bent = torch.from_numpy(squared_laplacian @ offset.detach().numpy())
    of_offset = (settings.laplacian_weight * bent + settings.offset_weight * offset.detach()) / len(offset)
    return scale * of_offset, scale * settings.global_offset_weight * global_offset.detach()


class AdamUniform:
    """Adam with one second moment per tensor, the maximum over its entries (Nicolet et al. 2021, section 4.3).

    A step therefore has the direction of the first moment.
    """

    def __init__(
        self, parameters: Sequence[Tensor], learning_rates: Sequence[float], betas: tuple[float, float] = (0.9, 0.99)
    ) -> None:
        self._parameters, self._learning_rates, self._betas = parameters, learning_rates, betas
        self._first_moments = [torch.zeros_like(parameter) for parameter in parameters]
        self._second_moments = [torch.zeros(()) for _ in parameters]
        self._count = 0

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], learning_rate_scale: float) -> None:
        """Update the parameters with the learning rates times `learning_rate_scale`."""
        self._count += 1
        first_beta, second_beta = self._betas
        first_bias, second_bias = 1.0 - first_beta**self._count, 1.0 - second_beta**self._count
        for i, (parameter, gradient) in enumerate(zip(self._parameters, gradients, strict=True)):
            self._first_moments[i] = torch.lerp(gradient, self._first_moments[i], first_beta)
            self._second_moments[i] = torch.lerp(gradient.square().max(), self._second_moments[i], second_beta)
            update = self._first_moments[i] / first_bias / ((self._second_moments[i] / second_bias).sqrt() + 1e-12)
            parameter -= self._learning_rates[i] * learning_rate_scale * update
