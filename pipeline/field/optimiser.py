"""Adam optimiser of field and poses, its learning-rate schedules, and the detection of divergence.

Gradients of the poses are averaged over time before Adam's step (`PoseCorrection.averaging_weights`): a step shows few
of the frames, and errors of neighbouring frames are alike (a Sobolev gradient: Neuberger, "Sobolev Gradients and
Differential Equations", 1997).
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from pipeline.body.pose_correction import PoseCorrection
from pipeline.field.config import FieldConfig
from pipeline.field.field import RadianceField
from pipeline.kernels.adam import adam_step_

WARMUP_STEPS = 20
MAX_NONFINITE_STEPS = 20
POSE_PARAMETERS = ("rotation_rad", "shift_m")
SHIFT_LEARNING_RATE_RATIO = 3
"""Learning rate of the joint rotations, rad, divided by that of the translations, m."""
FINAL_POSE_LEARNING_RATE_RATIO = 0.1
ADAM_EPSILON = 1e-15
"""As in Instant-NGP: rows of the hash table with few samples have small gradients."""


class DivergedError(ArithmeticError):
    """The loss of many consecutive steps was not finite."""


def learning_rate_factor(step: int, config: FieldConfig) -> float:
    """Return the factor of the field's learning rates at a step: linear warm-up times exponential decay."""
    warmup = min(1.0, (step + 1) / WARMUP_STEPS)
    return warmup * config.settings.final_learning_rate_ratio ** (step / config.steps)


def pose_learning_rate_factor(step: int, config: FieldConfig) -> float:
    """Return the factor of the poses' learning rates: 1 when the refinement starts, 0.1 at the end."""
    start_step = config.settings.pose_start_fraction * config.steps
    return FINAL_POSE_LEARNING_RATE_RATIO ** ((step - start_step) / max(config.steps - start_step, 1))


class FieldOptimiser:
    """Parameters of field, poses and occupancy grid with their Adam moments.

    `grad_table` accumulates the gradient of the hash table, which the compiled encoding computes outside of autograd.
    """

    def __init__(
        self, field: RadianceField, poses: PoseCorrection, attention: Mapping[str, Tensor], config: FieldConfig
    ) -> None:
        """attention: parameters of the occupancy grid by name, with `attention_learning_rate`; other names than the
        field's and the poses'."""
        self.config, self.attention_names = config, tuple(attention)
        self.parameters: dict[str, Tensor] = dict(field.named_parameters())
        self.parameters |= {"rotation_rad": poses.rotation_rad, "shift_m": poses.shift_m, **attention}
        self.moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in self.parameters.items()}
        self.grad_table = torch.zeros_like(field.table)
        self.pose_averaging = poses.averaging_weights(config.settings.pose_correlation_time_s)
        self.nonfinite_steps = 0

    def gradients(
        self, loss: Tensor, names: tuple[str, ...] | None = None, others: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Return the gradients of a loss by parameter (`names`, or all), without parameters it does not depend on.

        others: further leaves of autograd whose gradients are wanted, by name.
        """
        leaves = {name: self.parameters[name] for name in names or self.parameters} | dict(others or {})
        gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        return {name: gradient for name, gradient in zip(leaves, gradients, strict=True) if gradient is not None}

    def step(self, step: int, gradients: dict[str, Tensor], is_finite: bool) -> None:
        """Update all parameters that have a gradient; skip the step if the loss is not finite.

        step: steps completed before this one.

        Raises:
            DivergedError: `MAX_NONFINITE_STEPS` consecutive steps had no finite loss.
        """
        self.nonfinite_steps = 0 if is_finite else self.nonfinite_steps + 1
        if self.nonfinite_steps >= MAX_NONFINITE_STEPS:
            raise DivergedError(f"no finite loss in {MAX_NONFINITE_STEPS} steps up to step {step}")
        if not is_finite:
            return
        if "table" in self.parameters and "table" not in gradients:
            # The reference encoding on other devices passes the table's gradient through autograd.
            gradients = {"table": self.grad_table} | gradients
        for name, gradient in gradients.items():
            is_pose = name in POSE_PARAMETERS
            if is_pose:
                gradient = torch.einsum("nm,m...->n...", self.pose_averaging, gradient)
            start_step = math.ceil(self.config.settings.pose_start_fraction * self.config.steps) if is_pose else 0
            adam_step_(
                self.parameters[name],
                gradient.contiguous(),
                *self.moments[name],
                step + 1 - start_step,
                self._learning_rate(name, step),
                epsilon=ADAM_EPSILON,
            )

    def _learning_rate(self, name: str, step: int) -> float:
        settings = self.config.settings
        rates = {
            "table": settings.table_learning_rate,
            "rotation_rad": settings.pose_learning_rate,
            "shift_m": settings.pose_learning_rate / SHIFT_LEARNING_RATE_RATIO,
            **dict.fromkeys(self.attention_names, settings.attention_learning_rate),
        }
        schedule = pose_learning_rate_factor if name in POSE_PARAMETERS else learning_rate_factor
        return rates.get(name, settings.network_learning_rate) * schedule(step, self.config)

    def state_dict(self) -> dict[str, Tensor]:
        """Return parameters and moments, and the count of steps without a finite loss."""
        tensors = {"nonfinite_steps": torch.tensor(self.nonfinite_steps)}
        for name, parameter in self.parameters.items():
            tensors[f"parameter.{name}"] = parameter.detach()
            tensors[f"first.{name}"], tensors[f"second.{name}"] = self.moments[name]
        return tensors

    @torch.no_grad()
    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state that `state_dict` returned, in place."""
        self.nonfinite_steps = int(tensors["nonfinite_steps"])
        for name, parameter in self.parameters.items():
            parameter.copy_(tensors[f"parameter.{name}"])
            for moment, order in zip(self.moments[name], ("first", "second"), strict=True):
                moment.copy_(tensors[f"{order}.{name}"])
