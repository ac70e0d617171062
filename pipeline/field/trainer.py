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
from pipeline.field.field import Field
from pipeline.field.inverse_skinning import Rays, invert_motion
from pipeline.field.losses import field_losses
from pipeline.field.occupancy import OccupancyUpdate
from pipeline.field.pixel_sampler import ErrorMap, PixelPool, eyes
from pipeline.field.skin_grid import posed_from_world
from pipeline.field.volume_rendering import Placing, look
from pipeline.geometry.camera import Camera
from pipeline.kernels.adam import adam_step_
from pipeline.kernels.common.thread_pool import Parallel
from pipeline.kernels.hashgrid import Towards, add_table_gradient_
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.pixel_sampling import pixel_rays
from pipeline.kernels.volume_rendering import Traced

WARM_UP = 20
MAX_BAD_STEPS = 20
REBAKES = (0.6,)
"""Parts of the training at which the warp grids follow the refined poses (docs/decisions.md)."""
MAX_SAMPLES = 160
"""Of a ray; those farther back are dropped."""
PARTS = 4
"""On the CPU a step's frames are divided into so many parts, which threads work at, whatever the number of threads."""
OF_STEP, OF_POINTS, OF_FRAMES = range(3)
"""Streams of random numbers in a step: what it takes from where is the same however its work is divided."""


@dataclass(frozen=True)
class Scene:
    """What is learnt from: one body in motion before one camera, and the pixels that saw it."""

    body: Body
    motion: Motion
    camera: Camera
    pool: PixelPool
    skin: SkinGrid


@dataclass(frozen=True)
class Batch:
    """Some rays of a step, in the posed space of their frames, in the order of these."""

    frames: Int[Tensor, "k"]
    frame: Int[Tensor, "n"]
    rows: Int[np.ndarray, "n"]
    origins_m: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    rgba: Float[Tensor, "n 4"]
    background: Float[Tensor, "n 3"]
    jitter: Float[Tensor, "n"]
    trust: Float[Tensor, "n"]


@dataclass(frozen=True)
class Answer:
    """What learning comes to for a part of a step; losses and gradients are its share of the whole step's.

    gradients: by parameter, without those that have none. towards: what the table's is made of, where that is not
    among them.
    """

    batch: Batch
    seen: Traced
    colour_error: Float[Tensor, "n 3"]
    losses: dict[str, Tensor]
    gradients: dict[str, Tensor]
    towards: Towards


def summed(parts: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
    """What several parts say under the same names, added up in their order."""
    total: dict[str, Tensor] = {}
    for part in parts:
        for name, value in part.items():
            total[name] = total[name] + value if name in total else value
    return total


class DivergedError(ArithmeticError):
    """Many steps in a row had no finite loss."""


class Learning:
    """The state of stage one: everything that a step changes is here and in `state()`, on the field's device.

    Random numbers come from a generator keyed by (seed, step), so a resumed run draws what an unbroken one would
    have drawn.
    """

    def __init__(self, scene: Scene, field: Field, occupancy: OccupancyUpdate, config: FieldConfig) -> None:
        self.scene, self.field, self.occupancy, self.config = scene, field, occupancy, config
        self.device = field.bounds_m.device
        self.poses = PoseCorrection(scene.body, scene.motion, self.device)
        self.step_m = scene.body.height_m() * config.step_fraction
        self.done = 0
        self.bad_steps = 0
        self.errors = ErrorMap(scene.pool.frames, scene.pool.xy_px)
        self.table_gradient = torch.zeros_like(field.table)
        shares = (1 - config.share_border - config.share_outside, config.share_border, config.share_outside)
        everything = np.arange(scene.pool.frames)
        self.frames_with_rays = np.flatnonzero(scene.pool.sizes(everything, float(config.rays), shares).any(axis=1))
        if not len(self.frames_with_rays):
            raise ValueError("no frame has a pixel to learn from")
        self.frames_per_step = min(config.frames_per_step, len(self.frames_with_rays))
        self.sizes = scene.pool.sizes(everything, config.rays / self.frames_per_step, shares)
        self.part_count = PARTS if self.device.type == "cpu" else 1
        self.threads = Parallel(self.part_count)
        parameters: dict[str, Tensor] = dict(field.named_parameters())
        parameters |= {"rotation_rad": self.poses.rotation_rad, "shift_m": self.poses.shift_m}
        self.parameters = parameters
        self.moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in parameters.items()}
        self.baked_rotation_rad, self.baked_shift_m = torch.zeros(()), torch.zeros(())
        self.whole_skin = self.skin = scene.skin.to(self.device)
        self._bake()

    def _bake(self) -> None:
        """Invert the skinning of all training frames as they are posed now."""
        self.baked_rotation_rad = self.poses.rotation_rad.detach().clone()
        self.baked_shift_m = self.poses.shift_m.detach().clone()
        with torch.no_grad():
            everything = torch.arange(self.scene.pool.frames, device=self.device)
            canonical_to_world = self.poses.canonical_to_world(everything)
            self.posed_from_world = posed_from_world(canonical_to_world)
            self.eyes = eyes(self.scene.camera, self.posed_from_world.cpu().numpy())
            poses = self.posed_from_world[:, None] @ canonical_to_world
            self.inverse = invert_motion(self.config.inverse_skinning, self.scene.body, self.scene.skin, poses)

    def _follow_occupancy(self) -> None:
        """Blend skinning only where samples can lie: a third of the nodes, and of the memory that a step touches."""
        if self.refines_poses:
            self.skin = self.whole_skin.around(self.occupancy.occupied, self.occupancy.bounds_m)

    @property
    def refines_poses(self) -> bool:
        """True once the poses take part in the learning."""
        return self.config.pose_refinement and self.done >= self.config.pose_start * self.config.steps

    def _random(self, stream: int) -> np.random.Generator:
        return np.random.Generator(np.random.Philox(key=[self.config.seed, self.done], counter=[0, 0, 0, stream]))

    def _draw(self, frames: Int[np.ndarray, "k"]) -> Batch:
        """Rays of some frames; those of a frame hang on nothing but frame and step."""
        config, pool, sizes = self.config, self.scene.pool, self.sizes[frames]
        streams = [self._random(OF_FRAMES + frame) for frame in frames.tolist()]
        rows, trust = pool.draw(frames, sizes, streams, self.errors, config.share_error, config.outlier)
        counts = sizes.sum(axis=1).tolist()
        number = np.concatenate([s.random((n, 6), dtype=np.float32) for s, n in zip(streams, counts, strict=True)])
        inside = number[:, 4:] if config.pixel_jitter else np.full((len(rows), 2), 0.5, np.float32)
        frame = np.repeat(frames, counts)
        origins, directions, rgba = pixel_rays(rows, frame, pool.xy_px, pool.rgba, inside, self.eyes)
        return Batch(
            frames=self._here(frames),
            frame=self._here(frame),
            rows=rows,
            origins_m=self._here(origins),
            directions=self._here(directions),
            rgba=self._here(rgba),
            background=self._here(number[:, :3]),
            jitter=self._here(number[:, 3]),
            # What lies outside the mask is not the person, however much it errs.
            trust=self._here(1 - rgba[:, 3] * (1 - trust)),
        )

    def _here(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)

    def _placing(self, frames: Int[Tensor, "k"]) -> Placing | None:
        """Where samples lie once poses are refined: wherever these are now."""
        if not self.refines_poses:
            return None
        poses = self.poses.canonical_to_posed(frames, self.posed_from_world[frames])
        return Placing(self.skin, frames, poses)

    def step(self) -> dict[str, float]:
        """One step; returns the losses. Raises DivergedError after many steps without a finite loss."""
        config, random = self.config, self._random(OF_STEP)
        if self.refines_poses and self.done in {round(part * config.steps) for part in REBAKES}:
            self._bake()
        if self.refines_poses and self.skin is self.whole_skin:
            self._follow_occupancy()
        frames = np.sort(random.choice(self.frames_with_rays, self.frames_per_step, replace=False))
        parts = np.array_split(frames, min(self.part_count, len(frames)))
        empty_m = self.occupancy.should_be_empty(config.empty_points, config.unproven_points, self._random(OF_POINTS))
        share = [float(self.sizes[part].sum() / self.sizes[frames].sum()) for part in parts]
        answers = self.threads.map(self._answer, parts, empty_m.tensor_split(len(parts)), share)
        losses = summed(answer.losses for answer in answers)
        total, gradients = torch.stack(list(losses.values())).sum(), [answer.gradients for answer in answers]
        if self.refines_poses:
            effort = config.pose_smoothness * self.poses.roughness() + config.pose_size * self.poses.size()
            gradients.append(self._gradients(effort, ("rotation_rad", "shift_m")))
            total = total + effort.detach()
        finite = bool(torch.isfinite(total))
        if finite:
            towards = Towards(part for answer in answers for part in answer.towards)
            add_table_gradient_(self.table_gradient, towards, self.field.layout)
            for answer in answers:
                self._note_errors(answer.batch, answer.colour_error)
                self.occupancy.record(answer.seen.canonical_m, answer.seen.light, answer.seen.weight)
        self._update_parameters(finite, summed(gradients))
        self.done += 1
        if self.done % config.occupancy_every == 0 and self.done >= config.occupancy_start:
            self.occupancy.update(self.field.density, self.step_m, random)
            self._follow_occupancy()
        samples = sum(len(answer.seen.light) for answer in answers)
        return {name: float(loss) for name, loss in losses.items()} | {"samples": float(samples)}

    def _answer(self, frames: Int[np.ndarray, "k"], empty_m: Float[Tensor, "e 3"], share: float) -> Answer:
        """Learn from rays of some frames and points that should be empty. Changes nothing, so threads may do it at
        once. share: that of all rays.
        """
        batch, towards = self._draw(frames), Towards()
        rays = Rays(batch.origins_m, batch.directions, batch.frame, batch.jitter)
        about = (self.occupancy.grid(), rays, self._placing(batch.frames), empty_m)
        seen = look(self.field, self.inverse, *about, self.step_m, MAX_SAMPLES, towards)
        truth = (batch.rgba, batch.background, batch.trust, seen.density_per_m, self.config)
        losses, error = field_losses(seen.image, seen.alpha, *truth)
        losses = {name: loss if name == "density" else share * loss for name, loss in losses.items()}
        gradients = self._gradients(torch.stack(list(losses.values())).sum(), tuple(self.parameters))
        told = {name: loss.detach() for name, loss in losses.items()}
        return Answer(batch, seen, error, told, gradients, towards)

    def _gradients(self, loss: Tensor, names: tuple[str, ...]) -> dict[str, Tensor]:
        """Of the parameters that the loss depends on and whose gradient autograd is told."""
        found = torch.autograd.grad(loss, [self.parameters[name] for name in names], allow_unused=True)
        return {name: gradient for name, gradient in zip(names, found, strict=True) if gradient is not None}

    def _note_errors(self, batch: Batch, colour_error: Float[Tensor, "n 3"]) -> None:
        """Remember where colours are wrong, for the rays of later steps."""
        if self.config.share_error > 0.0:
            self.errors.note(batch.rows, batch.frame.cpu().numpy(), colour_error.cpu().numpy())

    def _rate(self) -> float:
        """Part of the full learning rate: a short warm-up, then an exponential decay that ends at `final_rate`."""
        return min(1.0, (self.done + 1) / WARM_UP) * self.config.final_rate ** (self.done / self.config.steps)

    def _pose_rate(self) -> float:
        """Part of the poses' learning rate: full when they begin to be refined, a tenth at the end."""
        begun = self.config.pose_start * self.config.steps
        return 0.1 ** ((self.done - begun) / max(self.config.steps - begun, 1))

    def _update_parameters(self, finite: bool, gradients: dict[str, Tensor]) -> None:
        self.bad_steps = 0 if finite else self.bad_steps + 1
        if self.bad_steps >= MAX_BAD_STEPS:
            raise DivergedError(f"no finite loss in {MAX_BAD_STEPS} steps up to step {self.done}")
        if not finite:
            return
        config = self.config
        rates = {"table": config.table_rate, "rotation_rad": config.pose_rate, "shift_m": config.pose_rate / 3}
        # The compiled encoding fills a buffer of ours; its plain twin, for other devices, fills autograd's.
        if "table" in self.parameters and "table" not in gradients:
            gradients = {"table": self.table_gradient} | gradients
        for name, gradient in gradients.items():
            is_pose = name in ("rotation_rad", "shift_m")
            begun = math.ceil(config.pose_start * config.steps) if is_pose else 0
            updates = self.done + 1 - begun
            rate = rates.get(name, config.network_rate) * (self._pose_rate() if is_pose else self._rate())
            moments = self.moments[name]
            adam_step_(self.parameters[name], gradient.contiguous(), *moments, updates, rate, epsilon=1e-15)

    def state(self) -> dict[str, Tensor]:
        """Everything that a resumed run needs."""
        tensors = {"done": torch.tensor(self.done), "bad_steps": torch.tensor(self.bad_steps)}
        tensors |= {"baked.rotation_rad": self.baked_rotation_rad, "baked.shift_m": self.baked_shift_m}
        for name, parameter in self.parameters.items():
            tensors[f"parameter.{name}"] = parameter.detach()
            tensors[f"first.{name}"], tensors[f"second.{name}"] = self.moments[name]
        tensors["pixel_errors"] = torch.from_numpy(self.errors.error)
        return tensors | {f"occupancy.{name}": value for name, value in self.occupancy.state().items()}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `state()`; the next step is the one that the other run would have made."""
        self.done, self.bad_steps = int(tensors["done"]), int(tensors["bad_steps"])
        with torch.no_grad():
            self.poses.rotation_rad.copy_(tensors["baked.rotation_rad"])
            self.poses.shift_m.copy_(tensors["baked.shift_m"])
            self._bake()
            for name, parameter in self.parameters.items():
                parameter.copy_(tensors[f"parameter.{name}"])
                for moment, order in zip(self.moments[name], ("first", "second"), strict=True):
                    moment.copy_(tensors[f"{order}.{name}"])
        self.errors.error[:] = tensors["pixel_errors"].cpu().numpy()
        prefix = "occupancy."
        kept = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
        self.occupancy.load_state(kept)
        self._follow_occupancy()
