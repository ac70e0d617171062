"""Vertex positions and triangle density of the canonical mesh, refined against the video through the differentiable
rasteriser.

Letters: x0 the round's start positions, D per-vertex offsets, G one global offset (the paper's delta v_i and delta V);
x = x0 + D + G. D is not optimised itself but u = (I + lambda L) D with the graph Laplacian L, so every step moves a
neighbourhood and no vertex alone (Nicolet et al., "Large steps in inverse rendering of geometry", 2021). Rounds after
the first begin with new triangles: faces whose accumulated image error is above an upper percentile are split at
midpoints, those below a lower one decimated and remeshed (IHM 2.3). A round that makes the validation frames worse is
undone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from pipeline.avatar.body import Body
from pipeline.avatar.mesh_views import (
    Shade,
    Skin,
    View,
    face_errors,
    render_view,
    skin_of,
    target_over,
    validation_psnr_db,
)
from pipeline.core.config import Config
from pipeline.core.progress import track
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import is_closed_manifold, laplacian, remesh, repair, subdivide


class RefineConfig(Config):
    """Options of the refinement."""

    rounds: int = Field(
        3, ge=0, le=10, description="rounds of optimisation; each after the first starts with new triangles"
    )
    steps: int = Field(120, ge=1, le=5000, description="optimiser steps a round")
    frames_per_step: int = Field(3, ge=1, le=16, description="training frames a step looks at")
    person_height_px: int = Field(
        480, ge=64, le=4096, description="images are reduced until the person is at most this high, px"
    )
    learning_rate: float = Field(0.0012, gt=0.0, le=0.1, description="step of the smoothed offsets, m")
    global_learning_rate: float = Field(0.0003, ge=0.0, le=0.1, description="step of the one offset of all vertices, m")
    stiffness: float = Field(
        12.0, ge=0.0, le=1000.0, description="lambda of the implicit smoothing of every step; 0 moves vertices alone"
    )
    colour_weight: float = Field(1.0, ge=0.0, description="weight of the Huber colour loss")
    alpha_weight: float = Field(1.0, ge=0.0, description="weight of the silhouette loss, alpha against mask")
    smooth_weight: float = Field(
        0.02, ge=0.0, description="weight of the uniform Laplacian of the positions, in units of the edge length"
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
    decimate_edge: float = Field(
        1.4, ge=1.0, le=4.0, description="edge length of decimated regions, in target edge lengths"
    )
    max_faces: int = Field(60000, ge=100, description="no face is split beyond this number of faces")


@dataclass(frozen=True)
class Refined:
    """Where the refinement stands after a round: also what a checkpoint holds."""

    mesh: Mesh
    rounds_done: int
    validation_psnr_db: tuple[float, ...]
    finished: bool


class SmoothOffset(torch.autograd.Function):
    """D = (I + lambda L)^-1 u, with the same solve for the gradient (the matrix is symmetric)."""

    @staticmethod
    def forward(context: Any, smooth_coordinates: Tensor, factor: SuperLU) -> Tensor:
        """(v, 3) u -> (v, 3) D."""
        context.factor = factor
        return torch.from_numpy(factor.solve(smooth_coordinates.detach().double().numpy())).to(smooth_coordinates)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """dL/dD -> dL/du."""
        return torch.from_numpy(context.factor.solve(gradient.double().contiguous().numpy())).to(gradient), None


def smoothing_factor(mesh: Mesh, stiffness: float) -> SuperLU:
    """Factor of I + stiffness * L with the combinatorial Laplacian L = degree - adjacency."""
    operator = laplacian(mesh)
    degree = np.bincount(mesh.edges().ravel(), minlength=len(mesh.vertices))
    return splu(csc_array(eye_array(len(mesh.vertices)) + stiffness * (diags_array(degree.astype(float)) @ operator)))


def refine(
    start: Mesh | Refined,
    body: Body,
    views: tuple[Sequence[View], Sequence[View]],
    shade: Shade,
    edge_m: float,
    config: RefineConfig,
    seed: int = 0,
    on_round: Callable[[Refined], None] = lambda state: None,
) -> Refined:
    """Runs the rounds that are left. views: (training, validation). edge_m: target edge length, m. on_round: called
    after each round.

    Deterministic in (start, seed): going on from a `Refined` that `on_round` was given ends with the same mesh.
    """
    train, validation = views
    if isinstance(start, Mesh):
        psnr_db = validation_psnr_db(start, skin_of(start, body), validation, shade)
        start = Refined(start, 0, (psnr_db,), config.rounds == 0)
    state = start
    while not state.finished:
        state = _round(state, body, train, validation, shade, edge_m, config, seed)
        on_round(state)
    return state


def _round(
    state: Refined,
    body: Body,
    train: Sequence[View],
    validation: Sequence[View],
    shade: Shade,
    edge_m: float,
    config: RefineConfig,
    seed: int,
) -> Refined:
    """One round: new triangles (not in the first), optimisation, and back to the start if validation frames got
    worse."""
    mesh = state.mesh
    if state.rounds_done > 0:
        errors = face_errors(mesh, skin_of(mesh, body), train, shade)
        mesh = adapt_triangles(mesh, errors, edge_m, config)
    skin = skin_of(mesh, body)
    mesh = optimise(
        mesh, skin, train, shade, edge_m, config, seed + 1000 * state.rounds_done, f"mesh round {state.rounds_done + 1}"
    )
    psnr_db = validation_psnr_db(mesh, skin, validation, shade)
    rounds_done = state.rounds_done + 1
    if validation and psnr_db < state.validation_psnr_db[-1]:
        return replace(state, rounds_done=rounds_done, finished=True)
    return Refined(mesh, rounds_done, (*state.validation_psnr_db, psnr_db), rounds_done == config.rounds)


def optimise(
    mesh: Mesh,
    skin: Skin,
    views: Sequence[View],
    shade: Shade,
    edge_m: float,
    config: RefineConfig,
    seed: int,
    label: str = "refine",
) -> Mesh:
    """The mesh with its vertices moved so that it looks like the views; triangles stay."""
    generator = torch.Generator().manual_seed(seed)
    start = torch.from_numpy(mesh.vertices.astype(np.float32))
    factor = smoothing_factor(mesh, config.stiffness)
    coordinates, shift = torch.zeros_like(start, requires_grad=True), torch.zeros(3, requires_grad=True)
    operator = _to_torch(laplacian(mesh))
    optimiser = _UniformAdam(
        [(coordinates, config.learning_rate * (1.0 + config.stiffness)), (shift, config.global_learning_rate)]
    )
    for step in track(range(config.steps), label):
        offset = SmoothOffset.apply(coordinates, factor)
        vertices = start + offset + shift
        loss = _regularisers(vertices, offset, shift, operator, edge_m, config)
        for k in torch.randint(len(views), (config.frames_per_step,), generator=generator).tolist():
            background = torch.rand(3, generator=generator)
            loss = loss + _view_loss(vertices, skin, views[k], shade, background, config) / config.frames_per_step
        optimiser.step(loss, 0.5 * (1.0 + np.cos(np.pi * step / config.steps)))
    moved = (start + SmoothOffset.apply(coordinates, factor) + shift).detach().numpy()
    return Mesh(moved, mesh.faces)


def _view_loss(
    vertices: Float[Tensor, "v 3"],
    skin: Skin,
    view: View,
    shade: Shade,
    background: Float[Tensor, "3"],
    config: RefineConfig,
) -> Float[Tensor, ""]:
    image, alpha, _ = render_view(vertices, skin, view, shade)
    target, mask = target_over(view, background)
    colour = torch.nn.functional.huber_loss(image + (1.0 - alpha[..., None]) * background, target, delta=0.1)
    # Huber with delta 0.1 is 0.1 |e| for large errors: the factor 10 makes weight 1 mean the mean absolute error
    return config.colour_weight * 10.0 * colour + config.alpha_weight * (alpha - mask).abs().mean()


def _regularisers(
    vertices: Float[Tensor, "v 3"],
    offset: Float[Tensor, "v 3"],
    shift: Float[Tensor, "3"],
    operator: Tensor,
    edge_m: float,
    config: RefineConfig,
) -> Float[Tensor, ""]:
    """Uniform Laplacian, vertex offsets and global offset, squared in units of the edge length."""
    smooth = (torch.sparse.mm(operator, vertices) / edge_m).square().sum(1).mean()
    drift, common = (offset / edge_m).square().sum(1).mean(), (shift / edge_m).square().sum()
    return config.smooth_weight * smooth + config.offset_weight * drift + config.global_offset_weight * common


class _UniformAdam:
    """Adam whose second moment is one number per tensor, the largest: step sizes keep the gradient's shape (Nicolet et
    al., 4.3)."""

    def __init__(self, parameters: Sequence[tuple[Tensor, float]], betas: tuple[float, float] = (0.9, 0.99)) -> None:
        self._parameters = parameters
        self._betas = betas
        self._moments = [(torch.zeros_like(p), torch.zeros(())) for p, _ in parameters]
        self._count = 0

    def step(self, loss: Float[Tensor, ""], rate_factor: float) -> None:
        """One step down the loss with the learning rates times ``rate_factor``."""
        gradients = torch.autograd.grad(loss, [parameter for parameter, _ in self._parameters])
        self._count += 1
        first_beta, second_beta = self._betas
        first_bias, second_bias = 1.0 - first_beta**self._count, 1.0 - second_beta**self._count
        for i, ((parameter, rate), gradient) in enumerate(zip(self._parameters, gradients, strict=True)):
            mean, largest = self._moments[i]
            mean = torch.lerp(gradient, mean, first_beta)
            largest = torch.lerp(gradient.square().max(), largest, second_beta)
            self._moments[i] = (mean, largest)
            update = mean / first_bias / ((largest / second_bias).sqrt() + 1e-12)
            with torch.no_grad():
                parameter -= rate * rate_factor * update


def _to_torch(matrix: csr_array) -> Tensor:
    entries = matrix.tocoo()
    positions = torch.from_numpy(np.stack(entries.coords).astype(np.int64))
    values = torch.from_numpy(entries.data.astype(np.float32))
    return torch.sparse_coo_tensor(positions, values, matrix.shape, check_invariants=True).coalesce()


def adapt_triangles(mesh: Mesh, errors: Float[np.ndarray, "f"], edge_m: float, config: RefineConfig) -> Mesh:
    """Splits faces above the upper percentile of the error at midpoints, decimates and remeshes those below the lower
    one."""
    low = errors <= np.percentile(errors, config.decimate_percentile)
    high = errors > np.percentile(errors, config.subdivide_percentile)
    room = max(0, config.max_faces - len(mesh.faces)) // 4
    if high.sum() > room:
        high &= errors >= np.partition(errors, len(errors) - room)[len(errors) - room] if room else False
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    fine, _ = subdivide(mesh, high)
    # the faces to decimate are found again by their corners, which splitting elsewhere leaves alone
    keys = {tuple(face) for face in np.sort(mesh.faces[low], axis=1).tolist()}
    selected = np.array([tuple(face) in keys for face in np.sort(fine.faces, axis=1).tolist()])
    if len(centres) == 0 or not selected.any():
        return fine
    coarse = remesh(fine, config.decimate_edge * edge_m, iterations=3, selected=selected)
    return coarse if is_closed_manifold(coarse) else repair(fine)
