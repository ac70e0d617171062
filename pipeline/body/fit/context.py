"""What stays the same during a fit: body model, its clothing, landmarks and priors."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import Body, ParametricBody
from pipeline.body.fit.landmark_regressor import LandmarkRegressor, landmark_regressor
from pipeline.body.fit.linear_body import LinearBody, linearise_body
from pipeline.body.fit.prior.clothing import clothing_offsets, dress, fill_clothes, with_clothing
from pipeline.body.fit.prior.priors import PosePrior, ShapePrior, pose_prior, shape_prior
from pipeline.body.settings import FitSettings


@dataclass(frozen=True)
class FitContext:
    """Constants of a fit.

    default: the body at the default shape.
    clothing_m: from `prior.clothing.clothing_offsets`; without columns, the body is bare. The shape parameters of the
        fit are those of the body followed by those of the clothing.
    hem: of a skirt, see `FitOptions`.
    """

    body: ParametricBody
    regressor: LandmarkRegressor
    pose_prior: PosePrior
    shape_prior: ShapePrior
    default: LinearBody
    clothing_m: Float[Tensor, "v 3 c"]
    curls_rad: Float[np.ndarray, "2 4"]
    settings: FitSettings
    hem: float | None = None

    @classmethod
    def of(
        cls, body: ParametricBody, curls_rad: Float[np.ndarray, "2 4"], settings: FitSettings, has_clothing: bool
    ) -> "FitContext":
        """Return the context of a body."""
        bare = linearise_body(body, body.shape_defaults, curls_rad)
        clothing_m = clothing_offsets(bare) if has_clothing else bare.vertices_m.new_zeros(*bare.vertices_m.shape, 0)
        count = clothing_m.shape[2]
        default = dress(bare, clothing_m, clothing_m.new_zeros(count))
        prior = with_clothing(shape_prior(body.shape_names, body.shape_defaults), count)
        return cls(
            body, landmark_regressor(default), pose_prior(default), prior, default, clothing_m, curls_rad, settings
        )

    def linearise(self, shape: Float[Tensor, "s"]) -> LinearBody:
        """Return the clothed body linearised around a shape."""
        bare, clothing = self._split(shape)
        return dress(self._linearise_bare(bare), self.clothing_m, clothing)

    def filled_body(self, clothed: LinearBody) -> Body:
        """Return the bare body that fills the clothes of a body from `linearise` and keeps its joints."""
        bare, clothing = self._split(clothed.shape)
        if len(clothing) > 0:
            prior = ShapePrior(*(values[: len(bare)] for values in vars(self.shape_prior).values()))
            bare = fill_clothes(clothed, bare, prior, self._linearise_bare)
        return self.body.at_shape(bare.float())

    def bare_body(self, clothed: LinearBody) -> Body:
        """Return the body below the clothes of a body from `linearise`."""
        return self.body.at_shape(self._split(clothed.shape)[0].float())

    def _linearise_bare(self, bare: Float[Tensor, "s"]) -> LinearBody:
        """Return the bare body linearised around a shape."""
        return linearise_body(self.body, bare, self.curls_rad)

    def _split(self, shape: Float[Tensor, "s"]) -> tuple[Tensor, Tensor]:
        """Return the parameters of body and clothing."""
        bare, clothing = torch.tensor_split(shape.double(), [len(shape) - self.clothing_m.shape[2]])
        return bare, clothing
