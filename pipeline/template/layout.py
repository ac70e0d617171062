"""The texture layout of the template, the same for every person: a file of the package.

`python -m data_tools.template_layout` makes it.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.io.npz import load_npz
from pipeline.template.regions import ASSETS

LAYOUT_NPZ = "layout.npz"


@dataclass(frozen=True)
class TemplateLayout:
    """Charts of the template's skin in the unit square, origin bottom-left.

    Attributes:
        uv: texture coordinates.
        faces_uv: corners of `Template.faces` as indices into `uv`; -1 outside of the skin.
        chart: of each face; -1 outside of the skin.
        half: of each face, 0 or 1: the two sides of a cut within a chart (the back of the head, fingers) differ.
        reserved: left, bottom, right and top of the square for parts of a person that have no place on the body.
    """

    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    chart: Int[np.ndarray, "f"]
    half: Int[np.ndarray, "f"]
    reserved: tuple[float, float, float, float]

    def is_reserved(self, size_px: int) -> Bool[np.ndarray, "s s"]:
        """Return a texture that is True in the reserved square; row 0 is v = 1."""
        left, bottom, right, top = self.reserved
        at = (np.arange(size_px) + 0.5) / size_px
        return ((1.0 - at > bottom) & (1.0 - at < top))[:, None] & ((at > left) & (at < right))[None, :]


@lru_cache(maxsize=1)
def load_layout() -> TemplateLayout:
    """Return the layout, read once per process."""
    arrays = load_npz(ASSETS / LAYOUT_NPZ)
    left, bottom, right, top = arrays["reserved"].tolist()
    return TemplateLayout(
        arrays["uv"].astype(np.float64),
        arrays["faces_uv"].astype(np.int64),
        arrays["chart"].astype(np.int64),
        arrays["half"].astype(np.int64),
        (left, bottom, right, top),
    )
