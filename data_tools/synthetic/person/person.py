"""Generate the built-in clothed person from the parametric body model Anny; no download is needed."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from torch import Tensor

from data_tools.synthetic.person.anatomy import measure_anatomy
from data_tools.synthetic.person.dressing import add_clothing, surface_names
from data_tools.synthetic.person.fingers import with_finger_width
from data_tools.synthetic.person.heels import with_raised_heels
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.person.outfit import Outfit, choose_outfit
from data_tools.synthetic.person.painting import paint_texture
from data_tools.synthetic.rig.labels import labels_from_names
from data_tools.synthetic.rig.subject import Subject
from pipeline.body.body import AnnyBody, Body, load_anny
from pipeline.io.image import to_uint8
from pipeline.kernels.common.thread_pool import torch_threads

_PHENOTYPES = {
    "gender": (0.12, 0.5),
    "height": (0.40, 0.15),
    "muscle": (0.55, 0.2),
    "weight": (0.48, 0.2),
    "proportions": (0.6, 0.2),
    "caucasian": (0.6, 0.0),
}
"""Mean and half range over seeds of each Anny phenotype; values are clipped to [0, 1]."""


def make_person(
    seed: int,
    texture_px: int = 2048,
    outfit: Outfit | None = None,
    finger_width_m: float | None = None,
    phenotypes: Mapping[str, float] | None = None,
) -> tuple[Subject, Body]:
    """Return the clothed, textured person of a seed, and the body without clothes.

    Equal arguments give equal arrays, whatever the number of threads.

    texture_px: side of the texture. outfit: None: that of the seed (`choose_outfit`), and so with finger_width_m.
    phenotypes: of Anny, each in [0, 1]; others are those of the seed.
    """
    model, noise = load_anny(), ValueNoise(seed)
    outfit = outfit or choose_outfit(seed)
    with torch_threads(1):
        bare = model.at_shape(_shape(model, seed, phenotypes or {}))
    if finger_width_m is not None:
        bare = with_finger_width(bare, finger_width_m)
    if outfit.heel_m:
        bare = with_raised_heels(bare, outfit.heel_m)
    anatomy = measure_anatomy(model, bare)
    clothed = add_clothing(model, bare, anatomy, outfit, noise)
    texture = to_uint8(paint_texture(clothed, anatomy, outfit, noise, texture_px))
    labels = labels_from_names(surface_names(clothed, anatomy, outfit))
    return Subject(clothed.body, clothed.uv, clothed.faces_uv, texture, labels), bare


def _shape(model: AnnyBody, seed: int, phenotypes: Mapping[str, float]) -> Float[Tensor, "p"]:
    """Return the shape parameters of a seed; seed 0 has the mean phenotypes, others vary around them."""
    shape = model.shape_defaults.clone()
    random = np.random.default_rng([seed, 1])
    for name, (middle, spread) in _PHENOTYPES.items():
        offset = spread * random.uniform(-1.0, 1.0) if seed else 0.0
        shape[model.shape_names.index(name)] = float(np.clip(middle + offset, 0.0, 1.0))
    for name, value in phenotypes.items():
        shape[model.shape_names.index(name)] = value
    return shape
