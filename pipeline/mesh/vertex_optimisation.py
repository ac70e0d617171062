"""Vertex positions and surface colours of a mesh, moved by gradient descent through the differentiable rasteriser.

Letters: x0 the start positions, D per-vertex offsets, G one global offset (delta v_i and delta V of the IHM paper,
section 2.3); x = x0 + D + G. D is not optimised itself but u = (I + lambda L) D with the graph Laplacian L, so every
step moves a neighbourhood and no vertex alone (Nicolet et al., "Large steps in inverse rendering of geometry", 2021).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.config import Config
from pipeline.core.progress import track
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import laplacian
from pipeline.kernels.common.thread_pool import ThreadPool
from pipeline.mesh.views import PosedView, SkinnedTopology, render_posed_view, view_losses


class RefinementConfig(Config):
    """Options of the refinement."""

    rounds: int = Field(
        3, ge=0, le=10, description="rounds of optimisation; each after the first starts with new triangles"
    )
    steps: int = Field(60, ge=1, le=5000, description="optimiser steps a round")
    frames_per_step: int = Field(3, ge=1, le=16, description="training frames a step looks at")
    max_person_px: int = Field(
        480, ge=64, le=4096, description="images are reduced until the person is at most this high, px"
    )
    learning_rate: float = Field(0.0012, gt=0.0, le=0.1, description="step of the smoothed offsets, m")
    global_learning_rate: float = Field(0.0003, ge=0.0, le=0.1, description="step of the one offset of all vertices, m")
    appearance_learning_rate: float = Field(
        0.003, ge=0.0, le=0.1, description="learning rate of the field's colours on the mesh's surface; 0 keeps them"
    )
    appearance_steps: int = Field(
        20, ge=0, le=1000, description="steps at the start of a round that change colours only"
    )
    smoothing_lambda: float = Field(
        12.0, ge=0.0, le=1000.0, description="lambda of the implicit smoothing of every step; 0 moves vertices alone"
    )
    colour_weight: float = Field(1.0, ge=0.0, description="weight of the Huber colour loss")
    silhouette_weight: float = Field(1.0, ge=0.0, description="weight of the silhouette loss, alpha against mask")
    laplacian_weight: float = Field(
        0.5, ge=0.0, description="weight of the uniform Laplacian of the positions, in units of the edge length"
    )
    offset_weight: float = Field(
        0.002, ge=0.0, description="weight of the squared vertex offsets, in units of the edge length"
    )
    global_offset_weight: float = Field(
        0.02, ge=0.0, description="weight of the squared global offset, in units of the edge length"
    )
    subdivide_percentile: float = Field(
        95.0, ge=50.0, le=100.0, description="faces with more image error than this share are split, %"
    )
    decimate_percentile: float = Field(
        50.0, ge=0.0, le=95.0, description="faces with less image error than this share are decimated, %"
    )
    decimated_edge_ratio: float = Field(
        1.4, ge=1.0, le=4.0, description="edge length of decimated regions, in target edge lengths"
    )
    max_faces: int = Field(60000, ge=100, description="no face is split beyond this number of faces")


@dataclass(frozen=True)
class RefinementInputs:
    """What a refinement works with.

    train, validation: views to learn from and to judge by. shade: colours in [0, 1] (n, 3) at canonical points (n, 3)
    in m; those of its parameters that require a gradient are learnt along. edge_m: target edge length.
    """

    body: Body
    train: Sequence[PosedView]
    validation: Sequence[PosedView]
    shader: torch.nn.Module
    target_edge_m: float
    config: RefinementConfig
    seed: int = 0


class FromDifferential(torch.autograd.Function):
    """D = (I + lambda L)^-1 u, with the same solve for the gradient (the matrix is symmetric)."""

    @staticmethod
    def forward(context: Any, differential_coordinates: Tensor, factorisation: SuperLU) -> Tensor:
        """(v, 3) u -> (v, 3) D."""
        context.factorisation = factorisation
        return torch.from_numpy(factorisation.solve(differential_coordinates.detach().double().numpy())).to(
            differential_coordinates
        )

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """dL/dD -> dL/du."""
        return torch.from_numpy(context.factorisation.solve(gradient.double().contiguous().numpy())).to(gradient), None


def factorise_smoothing_matrix(mesh: Mesh, smoothing_lambda: float) -> SuperLU:
    """Factor of I + stiffness * L with the combinatorial Laplacian L = degree - adjacency."""
    operator = laplacian(mesh)
    degree = np.bincount(mesh.edges().ravel(), minlength=len(mesh.vertices))
    return splu(
        csc_array(eye_array(len(mesh.vertices)) + smoothing_lambda * (diags_array(degree.astype(float)) @ operator))
    )


def optimise_vertices(
    mesh: Mesh, skin: SkinnedTopology, task: RefinementInputs, seed: int, label: str = "refine"
) -> Mesh:
    """The mesh with its vertices moved so that it looks like the training views; triangles stay.

    The parameters of ``task.shader`` are changed in place: colours that a volume gives along a ray are not those at one
    surface, and would pull the vertices to wherever they fit by chance.
    """
    config = task.config
    generator = torch.Generator().manual_seed(seed)
    start = torch.from_numpy(mesh.vertices.astype(np.float32))
    factorisation, operator = factorise_smoothing_matrix(mesh, config.smoothing_lambda), _to_torch(laplacian(mesh))
    coordinates, global_offset = torch.zeros_like(start, requires_grad=True), torch.zeros(3, requires_grad=True)
    learning_rates = [config.learning_rate * (1.0 + config.smoothing_lambda), config.global_learning_rate]
    offset_optimiser = AdamUniform([coordinates, global_offset], learning_rates)
    colours: list[Tensor] = [parameter for parameter in task.shader.parameters() if parameter.requires_grad]
    appearance_optimiser = (
        torch.optim.Adam(colours, lr=config.appearance_learning_rate, betas=(0.9, 0.99), eps=1e-12) if colours else None
    )
    warm_up = config.appearance_steps if appearance_optimiser else 0
    threads = ThreadPool(config.frames_per_step)
    for step in track(range(warm_up + config.steps), label):
        update_vertices = step >= warm_up
        with torch.set_grad_enabled(update_vertices):
            offset = FromDifferential.apply(coordinates, factorisation)
            vertices = start + offset + global_offset
        view_gradients = _batch_gradients(vertices, colours, skin, task, generator, threads)
        decay = 0.5 * (1.0 + math.cos(math.pi * step / (warm_up + config.steps)))
        if update_vertices:
            regularisation = _regularisation_loss(vertices, offset, global_offset, operator, task.target_edge_m, config)
            loss = regularisation + (vertices * view_gradients[0]).sum()
            offset_optimiser.step(torch.autograd.grad(loss, [coordinates, global_offset]), decay)
        if appearance_optimiser:
            _adam_step(
                appearance_optimiser, colours, view_gradients[-len(colours) :], config.appearance_learning_rate * decay
            )
    with torch.no_grad():
        moved = start + FromDifferential.apply(coordinates, factorisation) + global_offset
    return Mesh(moved.numpy(), mesh.faces)


def _adam_step(
    optimiser: torch.optim.Adam, parameters: Sequence[Tensor], gradients: Sequence[Tensor], rate: float
) -> None:
    optimiser.param_groups[0]["lr"] = rate
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)


def _batch_gradients(
    vertices: Float[Tensor, "v 3"],
    colours: Sequence[Tensor],
    skin: SkinnedTopology,
    task: RefinementInputs,
    generator: torch.Generator,
    threads: ThreadPool,
) -> list[Tensor]:
    """Gradients of the mean loss of a few random training views, each before a random background.

    Of the vertices, if these require one, and of the colours. Views are looked at by several threads at once; their
    gradients are added up in order.
    """
    config = task.config
    chosen = torch.randint(len(task.train), (config.frames_per_step,), generator=generator).tolist()
    backgrounds = [torch.rand(3, generator=generator) for _ in chosen]

    def gradients_of_view(k: int, background: Float[Tensor, "3"]) -> Sequence[Tensor]:
        leaf_vertices = vertices.detach().requires_grad_(vertices.requires_grad)
        image, alpha, _ = render_posed_view(leaf_vertices, skin, task.train[k], task.shader)
        colour_loss, silhouette_loss = view_losses(image, alpha, task.train[k], background)
        loss = (config.colour_weight * colour_loss + config.silhouette_weight * silhouette_loss) / len(chosen)
        # A view that shows nothing of the mesh says nothing of its colours.
        gradient_inputs = ([leaf_vertices] if leaf_vertices.requires_grad else []) + list(colours)
        return torch.autograd.grad(loss, gradient_inputs, materialize_grads=True)

    views = threads.map(gradients_of_view, chosen, backgrounds)
    return [reduce(torch.add, gradients) for gradients in zip(*views, strict=True)]


def _regularisation_loss(
    vertices: Float[Tensor, "v 3"],
    offset: Float[Tensor, "v 3"],
    global_offset: Float[Tensor, "3"],
    operator: Tensor,
    target_edge_m: float,
    config: RefinementConfig,
) -> Float[Tensor, ""]:
    """Uniform Laplacian, vertex offsets and global offset, squared in units of the edge length."""
    laplacian_penalty = (torch.sparse.mm(operator, vertices) / target_edge_m).square().sum(1).mean()
    offset_penalty, global_offset_penalty = (
        (offset / target_edge_m).square().sum(1).mean(),
        (global_offset / target_edge_m).square().sum(),
    )
    return (
        config.laplacian_weight * laplacian_penalty
        + config.offset_weight * offset_penalty
        + config.global_offset_weight * global_offset_penalty
    )


class AdamUniform:
    """Adam whose second moment is one number per tensor, the largest: a step keeps the gradient's shape (Nicolet et
    al., "Large steps in inverse rendering of geometry", 2021, section 4.3).
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
        """One step against the gradients with the learning rates times ``learning_rate_scale``."""
        self._count += 1
        first_beta, second_beta = self._betas
        first_bias, second_bias = 1.0 - first_beta**self._count, 1.0 - second_beta**self._count
        for i, (parameter, gradient) in enumerate(zip(self._parameters, gradients, strict=True)):
            self._first_moments[i] = torch.lerp(gradient, self._first_moments[i], first_beta)
            self._second_moments[i] = torch.lerp(gradient.square().max(), self._second_moments[i], second_beta)
            update = self._first_moments[i] / first_bias / ((self._second_moments[i] / second_bias).sqrt() + 1e-12)
            parameter -= self._learning_rates[i] * learning_rate_scale * update


def _to_torch(matrix: csr_array) -> Tensor:
    entries = matrix.tocoo()
    positions = torch.from_numpy(np.stack(entries.coords).astype(np.int64))
    values = torch.from_numpy(entries.data.astype(np.float32))
    return torch.sparse_coo_tensor(positions, values, matrix.shape, check_invariants=True).coalesce()
