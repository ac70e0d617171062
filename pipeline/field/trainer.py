"""Learning the canonical field from a video: one step, and all that it changes."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.body.pose_correction import PoseCorrection
from pipeline.field.config import FieldConfig
from pipeline.field.field import RadianceField
from pipeline.field.inverse_skinning import Rays, build_inverse_skinning
from pipeline.field.losses import field_losses
from pipeline.field.occupancy import OccupancyGrid
from pipeline.field.pixel_sampler import ErrorMap, PixelPool, posed_space_cameras
from pipeline.field.skin_grid import world_to_posed
from pipeline.field.volume_rendering import PoseBatch, render_rays
from pipeline.geometry.camera import Camera
from pipeline.kernels.adam import adam_step_
from pipeline.kernels.common.thread_pool import ThreadPool
from pipeline.kernels.hashgrid import FeatureGradients, add_table_gradient_
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.pixel_sampling import generate_pixel_rays
from pipeline.kernels.volume_rendering import RenderOutput

WARMUP_STEPS = 20
MAX_NONFINITE_STEPS = 20
REBAKE_FRACTIONS = (0.6,)
"""Parts of the training at which the warp grids follow the refined poses (docs/decisions.md)."""
MAX_SAMPLES_PER_RAY = 160
"""Of a ray; those farther back are dropped."""
CPU_BATCH_PARTS = 4
"""On the CPU a step's frames are divided into so many parts, which threads work at, whatever the number of threads."""
STEP_STREAM, POINT_STREAM, FRAME_STREAM = range(3)
"""Streams of random numbers in a step: what it takes from where is the same however its work is divided."""


@dataclass(frozen=True)
class TrainingScene:
    """What is learnt from: one body in motion before one camera, and the pixels that saw it."""

    body: Body
    motion: Motion
    camera: Camera
    pool: PixelPool
    skin: SkinGrid


@dataclass(frozen=True)
class RayBatch:
    """Some rays of a step, in the posed space of their frames, in the order of these."""

    frames: Int[Tensor, "k"]
    frame: Int[Tensor, "n"]
    rows: Int[np.ndarray, "n"]
    origins_m: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    rgba: Float[Tensor, "n 4"]
    background: Float[Tensor, "n 3"]
    jitter: Float[Tensor, "n"]
    inlier_weight: Float[Tensor, "n"]


@dataclass(frozen=True)
class StepResult:
    """What learning comes to for a part of a step; losses and gradients are its share of the whole step's.

    gradients: by parameter, without those that have none. towards: what the table's is made of, where that is not
    among them.
    """

    batch: RayBatch
    rendered: RenderOutput
    colour_error: Float[Tensor, "n 3"]
    losses: dict[str, Tensor]
    gradients: dict[str, Tensor]
    feature_gradients: FeatureGradients


def sum_by_name(parts: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
    """What several parts say under the same names, added up in their order."""
    total: dict[str, Tensor] = {}
    for part in parts:
        for name, value in part.items():
            total[name] = total[name] + value if name in total else value
    return total


class DivergedError(ArithmeticError):
    """Many steps in a row had no finite loss."""


class Trainer:
    """The state of stage one: everything that a step changes is here and in `state()`, on the field's device.

    Random numbers come from a generator keyed by (seed, step), so a resumed run draws what an unbroken one would
    have drawn.
    """

    def __init__(
        self, scene: TrainingScene, field: RadianceField, occupancy: OccupancyGrid, config: FieldConfig
    ) -> None:
        self.scene, self.field, self.occupancy, self.config = scene, field, occupancy, config
        self.device = field.bounds_m.device
        self.poses = PoseCorrection(scene.body, scene.motion, self.device)
        self.step_m = scene.body.height_m() * config.step_fraction
        self.completed_steps = 0
        self.nonfinite_steps = 0
        self.error_map = ErrorMap(scene.pool.frames, scene.pool.xy_px)
        self.grad_table = torch.zeros_like(field.table)
        class_ratios = (
            1 - config.border_sampling_ratio - config.outside_sampling_ratio,
            config.border_sampling_ratio,
            config.outside_sampling_ratio,
        )
        all_frames = np.arange(scene.pool.frames)
        self.frames_with_rays = np.flatnonzero(
            scene.pool.sample_counts(all_frames, float(config.rays), class_ratios).any(axis=1)
        )
        if not len(self.frames_with_rays):
            raise ValueError("no frame has a pixel to learn from")
        self.frames_per_step = min(config.frames_per_step, len(self.frames_with_rays))
        self.sample_counts = scene.pool.sample_counts(all_frames, config.rays / self.frames_per_step, class_ratios)
        self.part_count = CPU_BATCH_PARTS if self.device.type == "cpu" else 1
        self.threads = ThreadPool(self.part_count)
        parameters: dict[str, Tensor] = dict(field.named_parameters())
        parameters |= {"rotation_rad": self.poses.rotation_rad, "shift_m": self.poses.shift_m}
        self.parameters = parameters
        self.moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in parameters.items()}
        self.baked_rotation_rad, self.baked_shift_m = torch.zeros(()), torch.zeros(())
        self.full_skin_grid = self.skin = scene.skin.to(self.device)
        self._bake_inverse_skinning()

    def _bake_inverse_skinning(self) -> None:
        """Invert the skinning of all training frames as they are posed now."""
        self.baked_rotation_rad = self.poses.rotation_rad.detach().clone()
        self.baked_shift_m = self.poses.shift_m.detach().clone()
        with torch.no_grad():
            all_frames = torch.arange(self.scene.pool.frames, device=self.device)
            canonical_to_world = self.poses.canonical_to_world(all_frames)
            self.world_to_posed = world_to_posed(canonical_to_world)
            self.posed_space_cameras = posed_space_cameras(self.scene.camera, self.world_to_posed.cpu().numpy())
            poses = self.world_to_posed[:, None] @ canonical_to_world
            self.inverse = build_inverse_skinning(self.config.inverse_skinning, self.scene.body, self.scene.skin, poses)

    def _crop_skin_grid(self) -> None:
        """Blend skinning only where samples can lie: a third of the nodes, and of the memory that a step touches."""
        if self.refines_poses:
            self.skin = self.full_skin_grid.crop_to_occupied(self.occupancy.occupied, self.occupancy.bounds_m)

    @property
    def refines_poses(self) -> bool:
        """True once the poses take part in the learning."""
        return (
            self.config.pose_refinement and self.completed_steps >= self.config.pose_start_fraction * self.config.steps
        )

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.Generator(
            np.random.Philox(key=[self.config.seed, self.completed_steps], counter=[0, 0, 0, stream])
        )

    def _sample_batch(self, frames: Int[np.ndarray, "k"]) -> RayBatch:
        """Rays of some frames; those of a frame hang on nothing but frame and step."""
        config, pool, sample_counts = self.config, self.scene.pool, self.sample_counts[frames]
        rngs = [self._rng(FRAME_STREAM + frame) for frame in frames.tolist()]
        rows, inlier_weight = pool.sample_pixels(
            frames, sample_counts, rngs, self.error_map, config.error_sampling_ratio, config.outlier_threshold
        )
        counts = sample_counts.sum(axis=1).tolist()
        uniform = np.concatenate([s.random((n, 6), dtype=np.float32) for s, n in zip(rngs, counts, strict=True)])
        pixel_offset = uniform[:, 4:] if config.pixel_jitter else np.full((len(rows), 2), 0.5, np.float32)
        frame = np.repeat(frames, counts)
        origins, directions, rgba = generate_pixel_rays(
            rows, frame, pool.xy_px, pool.rgba, pixel_offset, self.posed_space_cameras
        )
        return RayBatch(
            frames=self._to_device(frames),
            frame=self._to_device(frame),
            rows=rows,
            origins_m=self._to_device(origins),
            directions=self._to_device(directions),
            rgba=self._to_device(rgba),
            background=self._to_device(uniform[:, :3]),
            jitter=self._to_device(uniform[:, 3]),
            # What lies outside the mask is not the person, however much it errs.
            inlier_weight=self._to_device(1 - rgba[:, 3] * (1 - inlier_weight)),
        )

    def _to_device(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)

    def _pose_batch(self, frames: Int[Tensor, "k"]) -> PoseBatch | None:
        """Where samples lie once poses are refined: wherever these are now."""
        if not self.refines_poses:
            return None
        poses = self.poses.canonical_to_posed(frames, self.world_to_posed[frames])
        return PoseBatch(self.skin, frames, poses)

    def step(self) -> dict[str, float]:
        """One step; returns the losses. Raises DivergedError after many steps without a finite loss."""
        config, random = self.config, self._rng(STEP_STREAM)
        if self.refines_poses and self.completed_steps in {round(part * config.steps) for part in REBAKE_FRACTIONS}:
            self._bake_inverse_skinning()
        if self.refines_poses and self.skin is self.full_skin_grid:
            self._crop_skin_grid()
        frames = np.sort(random.choice(self.frames_with_rays, self.frames_per_step, replace=False))
        parts = np.array_split(frames, min(self.part_count, len(frames)))
        empty_m = self.occupancy.sample_empty_points(
            config.empty_points, config.unobserved_points, self._rng(POINT_STREAM)
        )
        ray_fraction = [float(self.sample_counts[part].sum() / self.sample_counts[frames].sum()) for part in parts]
        results = self.threads.map(self._forward_backward, parts, empty_m.tensor_split(len(parts)), ray_fraction)
        losses = sum_by_name(result.losses for result in results)
        total, gradients = torch.stack(list(losses.values())).sum(), [result.gradients for result in results]
        if self.refines_poses:
            pose_penalty = (
                config.pose_smoothness_weight * self.poses.temporal_roughness()
                + config.pose_l2_weight * self.poses.size()
            )
            gradients.append(self._gradients(pose_penalty, ("rotation_rad", "shift_m")))
            total = total + pose_penalty.detach()
        finite = bool(torch.isfinite(total))
        if finite:
            feature_gradients = FeatureGradients(part for result in results for part in result.feature_gradients)
            add_table_gradient_(self.grad_table, feature_gradients, self.field.layout)
            for result in results:
                self._update_error_map(result.batch, result.colour_error)
                self.occupancy.record_observations(
                    result.rendered.canonical_m, result.rendered.transmittance, result.rendered.weight
                )
        self._optimiser_step(finite, sum_by_name(gradients))
        self.completed_steps += 1
        if (
            self.completed_steps % config.occupancy_update_interval == 0
            and self.completed_steps >= config.occupancy_warmup_steps
        ):
            self.occupancy.update(self.field.density, self.step_m, random)
            self._crop_skin_grid()
        samples = sum(len(result.rendered.transmittance) for result in results)
        return {name: float(loss) for name, loss in losses.items()} | {"samples": float(samples)}

    def _forward_backward(
        self, frames: Int[np.ndarray, "k"], empty_m: Float[Tensor, "e 3"], ray_fraction: float
    ) -> StepResult:
        """Learn from rays of some frames and points that should be empty. Changes nothing, so threads may do it at
        once. share: that of all rays.
        """
        batch, feature_gradients = self._sample_batch(frames), FeatureGradients()
        rays = Rays(batch.origins_m, batch.directions, batch.frame, batch.jitter)
        inputs = (self.occupancy.grid(), rays, self._pose_batch(batch.frames), empty_m)
        rendered = render_rays(self.field, self.inverse, *inputs, self.step_m, MAX_SAMPLES_PER_RAY, feature_gradients)
        targets = (batch.rgba, batch.background, batch.inlier_weight, rendered.density_per_m, self.config)
        losses, error = field_losses(rendered.image, rendered.alpha, *targets)
        losses = {name: loss if name == "density" else ray_fraction * loss for name, loss in losses.items()}
        gradients = self._gradients(torch.stack(list(losses.values())).sum(), tuple(self.parameters))
        detached = {name: loss.detach() for name, loss in losses.items()}
        return StepResult(batch, rendered, error, detached, gradients, feature_gradients)

    def _gradients(self, loss: Tensor, names: tuple[str, ...]) -> dict[str, Tensor]:
        """Of the parameters that the loss depends on and whose gradient autograd is told."""
        gradients = torch.autograd.grad(loss, [self.parameters[name] for name in names], allow_unused=True)
        return {name: gradient for name, gradient in zip(names, gradients, strict=True) if gradient is not None}

    def _update_error_map(self, batch: RayBatch, colour_error: Float[Tensor, "n 3"]) -> None:
        """Remember where colours are wrong, for the rays of later steps."""
        if self.config.error_sampling_ratio > 0.0:
            self.error_map.update(batch.rows, batch.frame.cpu().numpy(), colour_error.cpu().numpy())

    def _learning_rate_factor(self) -> float:
        """Part of the full learning rate: a short warm-up, then an exponential decay that ends at
        `final_learning_rate_ratio`.
        """
        return min(1.0, (self.completed_steps + 1) / WARMUP_STEPS) * self.config.final_learning_rate_ratio ** (
            self.completed_steps / self.config.steps
        )

    def _pose_learning_rate_factor(self) -> float:
        """Part of the poses' learning rate: full when they begin to be refined, a tenth at the end."""
        start_step = self.config.pose_start_fraction * self.config.steps
        return 0.1 ** ((self.completed_steps - start_step) / max(self.config.steps - start_step, 1))

    def _optimiser_step(self, finite: bool, gradients: dict[str, Tensor]) -> None:
        self.nonfinite_steps = 0 if finite else self.nonfinite_steps + 1
        if self.nonfinite_steps >= MAX_NONFINITE_STEPS:
            raise DivergedError(f"no finite loss in {MAX_NONFINITE_STEPS} steps up to step {self.completed_steps}")
        if not finite:
            return
        config = self.config
        rates = {
            "table": config.table_learning_rate,
            "rotation_rad": config.pose_learning_rate,
            "shift_m": config.pose_learning_rate / 3,
        }
        # The compiled encoding fills a buffer of ours; its plain twin, for other devices, fills autograd's.
        if "table" in self.parameters and "table" not in gradients:
            gradients = {"table": self.grad_table} | gradients
        for name, gradient in gradients.items():
            is_pose = name in ("rotation_rad", "shift_m")
            start_step = math.ceil(config.pose_start_fraction * config.steps) if is_pose else 0
            updates = self.completed_steps + 1 - start_step
            rate = rates.get(name, config.network_learning_rate) * (
                self._pose_learning_rate_factor() if is_pose else self._learning_rate_factor()
            )
            moments = self.moments[name]
            adam_step_(self.parameters[name], gradient.contiguous(), *moments, updates, rate, epsilon=1e-15)

    def state(self) -> dict[str, Tensor]:
        """Everything that a resumed run needs."""
        tensors = {
            "completed_steps": torch.tensor(self.completed_steps),
            "nonfinite_steps": torch.tensor(self.nonfinite_steps),
        }
        tensors |= {"baked.rotation_rad": self.baked_rotation_rad, "baked.shift_m": self.baked_shift_m}
        for name, parameter in self.parameters.items():
            tensors[f"parameter.{name}"] = parameter.detach()
            tensors[f"first.{name}"], tensors[f"second.{name}"] = self.moments[name]
        tensors["pixel_errors"] = torch.from_numpy(self.error_map.error)
        return tensors | {f"occupancy.{name}": value for name, value in self.occupancy.state().items()}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `state()`; the next step is the one that the other run would have made."""
        self.completed_steps, self.nonfinite_steps = int(tensors["completed_steps"]), int(tensors["nonfinite_steps"])
        with torch.no_grad():
            self.poses.rotation_rad.copy_(tensors["baked.rotation_rad"])
            self.poses.shift_m.copy_(tensors["baked.shift_m"])
            self._bake_inverse_skinning()
            for name, parameter in self.parameters.items():
                parameter.copy_(tensors[f"parameter.{name}"])
                for moment, order in zip(self.moments[name], ("first", "second"), strict=True):
                    moment.copy_(tensors[f"{order}.{name}"])
        self.error_map.error[:] = tensors["pixel_errors"].cpu().numpy()
        prefix = "occupancy."
        kept = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
        self.occupancy.load_state(kept)
        self._crop_skin_grid()
