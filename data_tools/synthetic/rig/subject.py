"""A textured, rigged person, the subject of a synthetic capture, and its files."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from data_tools.synthetic.rig.labels import FaceLabels, load_labels, save_labels
from pipeline.body.body import Body
from pipeline.body.files import load_body, save_body
from pipeline.io.image import read_rgb, to_float, write_rgb
from pipeline.io.npz import load_npz, save_npz


@dataclass(frozen=True)
class Subject:
    """A clothed surface bound to a skeleton in the canonical A-pose, with its texture.

    Attributes:
        uv: origin bottom-left; row 0 of the texture is at v = 1.
        faces_uv: indices into `uv` of the corners of `body.faces`.
        texture: sRGB.
        labels: of the faces; None if unknown.
    """

    body: Body
    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    texture: UInt8[np.ndarray, "th tw 3"]
    labels: FaceLabels | None = None

    @cached_property
    def _texture_tensor(self) -> Tensor:
        return torch.from_numpy(to_float(self.texture))

    def texture_tensor(self) -> Float[Tensor, "th tw 3"]:
        """Return the texture as sRGB in [0, 1], converted once."""
        return self._texture_tensor


def save_subject(folder: Path, subject: Subject) -> None:
    """Write `clothed.npz` (a Body), `uv.npz`, `texture.png`, and `labels.npz` if the labels are known."""
    save_body(folder / "clothed.npz", subject.body)
    save_npz(folder / "uv.npz", {"uv": subject.uv, "faces_uv": subject.faces_uv})
    write_rgb(folder / "texture.png", subject.texture)
    if subject.labels is not None:
        save_labels(folder, subject.labels)


def load_subject(folder: Path) -> Subject:
    """Read the files of `save_subject`. UserError if a file other than `labels.npz` is missing."""
    layout = load_npz(folder / "uv.npz")
    body = load_body(folder / "clothed.npz")
    texture, labels = read_rgb(folder / "texture.png"), load_labels(folder)
    return Subject(body, layout["uv"], layout["faces_uv"], texture, labels)
