"""One step of the training of field, poses and occupancy grid, and the state that it changes."""

import math
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.body.pose_correction import PoseCorrection
from pipeline.core.device import CPU
from pipeline.field.baked_inverse_skinning import BakedInverseSkinning
from pipeline.field.config import FieldConfig
from pipeline.field.field import RadianceField
from pipeline.field.losses import field_loss_gradients, field_losses
from pipeline.field.occupancy import OccupancyGrid
from pipeline.field.optimiser import POSE_PARAMETERS, FieldOptimiser
from pipeline.field.pixel_sampler import PixelPool
from pipeline.field.ray_batches import POINT_STREAM, STEP_STREAM, RayBatch, RaySampler, step_rng
from pipeline.field.volume_rendering import PoseBatch, PosedField, render_rays, render_rays_with_gradients
from pipeline.geometry.camera import Camera
from pipeline.kernels.common.dispatch import runs_on_cuda
from pipeline.kernels.common.thread_pool import ThreadPool, one_thread
from pipeline.kernels.hashgrid import FeatureGradients, add_table_gradient_
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.volume_rendering import OutputGradients, RenderOutput

REBAKE_FRACTIONS = (0.6,)
"""Fractions of the steps at which the inverse skinning is baked for the refined poses (docs/decisions/field.md)."""
MAX_SAMPLES_PER_RAY = 160
"""Samples farther along the ray are dropped."""
CPU_BATCH_PARTS = 4
"""Parts into which the frames of a step are divided on the CPU. It does not depend on the number of threads, so that
the order of floating-point sums does not either."""
OCCUPANCY_PREFIX, GATE, POSES = "occupancy.", "gate", "canonical_to_posed"


@dataclass(frozen=True)
class TrainingScene:
    """Training data: a body in motion, the camera, and the pixels of all training frames."""

    body: Body
    motion: Motion
    camera: Camera
    pool: PixelPool
    skin: SkinGrid


@dataclass(frozen=True)
class StepResult:
    """Losses and gradients of a part of a step; they add up to those of the whole step.

    gradients: by parameter. pose_gradient: of the matrices of the `PoseBatch`. feature_gradients: contributions to the
    gradient of the hash table, if autograd does not compute it.
    """

    batch: RayBatch
    rendered: RenderOutput
    colour_error: Float[Tensor, "n 3"]
    losses: dict[str, Tensor]
    gradients: dict[str, Tensor]
    pose_gradient: Tensor | None
    feature_gradients: FeatureGradients


def sum_by_name(parts: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Add up the tensors of the same name, in the order of the parts."""
    total: dict[str, Tensor] = {}
    for part in parts:
        for name, value in part.items():
            total[name] = total[name] + value if name in total else value
    return total


class Trainer:
    """Training of a field, on the device of the field. `state_dict` holds everything that a step changes.

    Frames, pixels and poses of a step are computed on the CPU, whatever the device: they are small, and follow each
    other.
    """

    def __init__(
        self, scene: TrainingScene, field: RadianceField, occupancy: OccupancyGrid, config: FieldConfig
    ) -> None:
        self.scene, self.field, self.occupancy, self.config = scene, field, occupancy, config
        self.device = field.bounds_m.device
        self.poses = PoseCorrection(scene.body, scene.motion)
        self.sampler = RaySampler(scene.pool, config, self.device)
        self.optimiser = FieldOptimiser(field, self.poses, occupancy.parameters(), config)
        self.inverse_skinning = BakedInverseSkinning(
            scene.body, scene.skin.to(self.device), scene.camera, self.poses, config.settings.inverse_skinning
        )
        self.step_m = scene.body.height_m() * config.settings.step_fraction
        self.completed_steps = 0
        self.part_count = CPU_BATCH_PARTS if self.device.type == "cpu" else 1
        self.threads = ThreadPool(self.part_count)
        field.gate = occupancy.gate()

    @property
    def refines_poses(self) -> bool:
        """Whether the present step refines the poses."""
        start_step = self.config.settings.pose_start_fraction * self.config.steps
        return self.config.pose_refinement and self.completed_steps >= start_step

    def step(self) -> dict[str, float]:
        """Take one training step; return the losses and the number of samples.

        Raises:
            DivergedError: many consecutive steps had no finite loss.
        """
        self._prepare_pose_refinement()
        # On a GPU what is left for the CPU is small: to wake a second thread takes longer than what it would do.
        with nullcontext() if self.device == CPU else one_thread():
            return self._step()

    def _step(self) -> dict[str, float]:
        settings, rng = self.config.settings, step_rng(self.config.seed, self.completed_steps, STEP_STREAM)
        frames = self.sampler.sample_frames(rng)
        parts = np.array_split(frames, min(self.part_count, len(frames)))
        empty_m = self.occupancy.sample_empty_points(
            settings.empty_points,
            settings.unobserved_points,
            step_rng(self.config.seed, self.completed_steps, POINT_STREAM),
        )
        ray_fractions = [self.sampler.ray_fraction(part, frames) for part in parts]
        pose_batch = self.inverse_skinning.pose_batch(torch.from_numpy(frames)) if self.refines_poses else None
        pose_parts = pose_batch.split([len(part) for part in parts]) if pose_batch else [None] * len(parts)
        arguments = (parts, empty_m.tensor_split(len(parts)), ray_fractions, pose_parts)
        results = self.threads.map(self.forward_backward, *arguments)
        of_losses = sum_by_name(result.losses for result in results)
        losses = dict(zip(of_losses, torch.stack(list(of_losses.values())).tolist(), strict=True))
        total, gradients = sum(losses.values()), [result.gradients for result in results]
        if pose_batch:
            of_parts = [result.pose_gradient for result in results if result.pose_gradient is not None]
            pose_loss, of_poses = self._pose_loss(), torch.cat(of_parts).cpu()
            # The gradient of the sum is that of the losses of rays and poses.
            weighted_sum = (pose_batch.canonical_to_posed * of_poses).sum()
            gradients.append(self.optimiser.gradients(pose_loss + weighted_sum, POSE_PARAMETERS))
            total += float(pose_loss.detach())
        is_finite = math.isfinite(total)
        if is_finite:
            self._record_results(results)
        self.optimiser.step(self.completed_steps, self._through_gate(sum_by_name(gradients)), is_finite)
        self.completed_steps += 1
        self._update_occupancy(rng)
        self.field.gate = self.occupancy.gate()
        samples = sum(len(result.rendered.transmittance) for result in results)
        return losses | {"samples": float(samples)}

    @torch.no_grad()
    def count_samples(self) -> int:
        """Return the number of samples on the rays of the next step, without taking it."""
        frames = self.sampler.sample_frames(step_rng(self.config.seed, self.completed_steps, STEP_STREAM))
        batch = self.sampler.sample_rays(frames, self.completed_steps, self.inverse_skinning.cameras)
        posed_field = self.posed_field()
        none_m = self.field.bounds_m[:0]
        return len(render_rays(posed_field, batch.rays, None, none_m, self.step_m, MAX_SAMPLES_PER_RAY, []).weight)

    def forward_backward(
        self,
        frames: Int[np.ndarray, "k"],
        empty_m: Float[Tensor, "e 3"],
        ray_fraction: float,
        pose_batch: PoseBatch | None = None,
    ) -> StepResult:
        """Compute losses and gradients of rays of some frames and of empty points (m), without changing any state.

        ray_fraction: rays of these frames as a fraction of all rays of the step. pose_batch: their present poses; None:
        those of the last bake. Threads may call it concurrently.
        """
        batch = self.sampler.sample_rays(frames, self.completed_steps, self.inverse_skinning.cameras)
        posed_field = self.posed_field()
        if posed_field.is_fused:
            return self._forward_backward_compiled(posed_field, batch, empty_m, ray_fraction, pose_batch)
        return self._forward_backward_autograd(posed_field, batch, empty_m, ray_fraction, pose_batch)

    def _forward_backward_compiled(
        self,
        posed_field: PosedField,
        batch: RayBatch,
        empty_m: Float[Tensor, "e 3"],
        ray_fraction: float,
        pose_batch: PoseBatch | None,
    ) -> StepResult:
        """Do `_forward_backward_autograd` with compiled kernels alone."""
        losses: dict[str, Tensor] = {}
        error, settings = batch.background, self.config.settings

        def output_gradients(image: Tensor, alpha: Tensor, density_per_m: Tensor) -> OutputGradients:
            nonlocal losses, error
            targets = batch.rgba, batch.background, batch.inlier_weight, density_per_m
            losses, error, gradients = field_loss_gradients(image, alpha, *targets, settings, ray_fraction)
            return gradients

        rendered, gradients, feature_gradients = render_rays_with_gradients(
            posed_field, batch.rays, pose_batch, empty_m, self.step_m, MAX_SAMPLES_PER_RAY, output_gradients
        )
        by_name = {"hidden": gradients.hidden, "output": gradients.output, "bias": gradients.bias}
        if gradients.gate is not None:
            by_name[GATE] = gradients.gate
        return StepResult(batch, rendered, error, losses, by_name, gradients.canonical_to_posed, feature_gradients)

    def _forward_backward_autograd(
        self,
        posed_field: PosedField,
        batch: RayBatch,
        empty_m: Float[Tensor, "e 3"],
        ray_fraction: float,
        pose_batch: PoseBatch | None,
    ) -> StepResult:
        feature_gradients = FeatureGradients()
        rendered = render_rays(
            posed_field, batch.rays, pose_batch, empty_m, self.step_m, MAX_SAMPLES_PER_RAY, feature_gradients
        )
        targets = (batch.rgba, batch.background, batch.inlier_weight, rendered.density_per_m, self.config.settings)
        losses, error = field_losses(rendered.image, rendered.alpha, *targets)
        losses = {name: loss if name == "density" else ray_fraction * loss for name, loss in losses.items()}
        leaves = {} if self.field.gate is None else {GATE: self.field.gate}
        if pose_batch:
            leaves[POSES] = pose_batch.canonical_to_posed
        gradients = self.optimiser.gradients(torch.stack(list(losses.values())).sum(), others=leaves)
        of_poses = gradients.pop(POSES, torch.zeros_like(leaves[POSES])) if pose_batch else None
        detached = {name: loss.detach() for name, loss in losses.items()}
        return StepResult(batch, rendered, error, detached, gradients, of_poses, feature_gradients)

    def posed_field(self) -> PosedField:
        """Return the field in the poses of the last bake, for the present step."""
        return PosedField(self.field, self.inverse_skinning.inverse, self.occupancy.binary())

    def _through_gate(self, gradients: dict[str, Tensor]) -> dict[str, Tensor]:
        """Replace the gradient of the gate, if there is one, by those of the parameters that it depends on."""
        of_gate = gradients.pop(GATE, None)
        return gradients if of_gate is None else gradients | self.occupancy.parameter_gradients(of_gate)

    def _prepare_pose_refinement(self) -> None:
        """Bake the inverse skinning for the refined poses if it is time, and crop the skin grid once."""
        if not self.refines_poses:
            return
        if self.completed_steps in {round(fraction * self.config.steps) for fraction in REBAKE_FRACTIONS}:
            self.inverse_skinning.bake()
        if not self.inverse_skinning.is_cropped:
            self._crop_skin_grid()

    def _pose_loss(self) -> Tensor:
        settings = self.config.settings
        return (
            settings.pose_smoothness_weight * self.poses.temporal_roughness()
            + settings.pose_l2_weight * self.poses.mean_square_correction()
        )

    def _record_results(self, results: list[StepResult]) -> None:
        """Add the hash table gradient, and update the error map and the observations of the occupancy grid."""
        feature_gradients = FeatureGradients(part for result in results for part in result.feature_gradients)
        add_table_gradient_(self.optimiser.grad_table, feature_gradients, self.field.layout)
        for result in results:
            self.sampler.update_errors(result.batch, result.colour_error)
            self.occupancy.record_observations(
                result.rendered.canonical_m, result.rendered.transmittance, result.rendered.weight
            )

    def _update_occupancy(self, rng: np.random.Generator) -> None:
        """Update the occupancy grid every few steps once the warm-up is over."""
        settings = self.config.settings
        is_due = self.completed_steps % settings.occupancy_update_interval == 0
        if is_due and self.completed_steps >= settings.occupancy_warmup_steps:
            self.occupancy.update(self.field.density, self.step_m, rng)
            self._crop_skin_grid()

    def _crop_skin_grid(self) -> None:
        """Crop the skin grid, so that what a step reads fits in the cache; CUDA kernels do not gain from it."""
        if self.refines_poses and not runs_on_cuda(self.field.table):
            self.inverse_skinning.crop_skin_grid(self.occupancy.binary())

    def state_dict(self) -> dict[str, Tensor]:
        """Return all tensors that a resumed training needs."""
        tensors = {
            "completed_steps": torch.tensor(self.completed_steps),
            "baked.rotation_rad": self.inverse_skinning.baked_rotation_rad,
            "baked.shift_m": self.inverse_skinning.baked_shift_m,
            "pixel_errors": torch.from_numpy(self.sampler.error_map.error),
        }
        occupancy = {f"{OCCUPANCY_PREFIX}{name}": value for name, value in self.occupancy.state_dict().items()}
        return tensors | self.optimiser.state_dict() | occupancy

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state that `state_dict` returned; the next step equals that of the uninterrupted training."""
        self.completed_steps = int(tensors["completed_steps"])
        with torch.no_grad():
            self.poses.rotation_rad.copy_(tensors["baked.rotation_rad"])
            self.poses.shift_m.copy_(tensors["baked.shift_m"])
        self.inverse_skinning.bake()
        self.optimiser.load_state_dict(tensors)
        self.sampler.error_map.error[:] = tensors["pixel_errors"].cpu().numpy()
        occupancy = {
            name.removeprefix(OCCUPANCY_PREFIX): value
            for name, value in tensors.items()
            if name.startswith(OCCUPANCY_PREFIX)
        }
        self.occupancy.load_state_dict(occupancy)
        self.field.gate = self.occupancy.gate()
        self._crop_skin_grid()
