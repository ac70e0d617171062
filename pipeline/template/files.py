"""The template on a person, an artifact of the texture stage: the registered vertices and the correspondence."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core.command import rerun_command
from pipeline.core.errors import UserError
from pipeline.io.npz import load_npz, save_npz
from pipeline.template.correspondence import LABELS, Correspondence
from pipeline.template.registration import Registration

TEMPLATE_NPZ = "template.npz"


@dataclass(frozen=True)
class FittedTemplate:
    """The registered template, and where the vertices of the textured mesh lie on it."""

    registration: Registration
    correspondence: Correspondence


def save_template(folder: Path, fitted: FittedTemplate | None) -> None:
    """Write template.npz; without arrays for a body of a model file, which has another topology."""
    arrays: dict[str, np.ndarray] = {}
    if fitted is not None:
        registration, points = fitted.registration, fitted.correspondence
        arrays = {
            "template_vertices": registration.vertices.astype(np.float32),
            "template_distance_m": registration.distance_m.astype(np.float32),
            "template_has_correspondence": registration.has_correspondence,
            "flipped_faces": np.array(registration.flipped_faces),
            "has_face": np.array(registration.has_face),
            "face": points.face.astype(np.int32),
            "barycentric": points.barycentric.astype(np.float32),
            "distance_m": points.distance_m.astype(np.float32),
            "offset_m": points.offset_m.astype(np.float32),
            "label": points.label.astype(np.uint8),
            "label_names": np.array(LABELS),
        }
    save_npz(folder / TEMPLATE_NPZ, arrays)


def load_fitted_template(folder: Path) -> FittedTemplate | None:
    """Read what `save_template` wrote; None for a body of a model file.

    Raises:
        UserError: the file is missing, is no npz, or has not the arrays of a template.
    """
    path = folder / TEMPLATE_NPZ
    again = f"run {rerun_command('texture', folder)}"
    if not path.is_file():
        raise UserError(f"{path} is missing, the texture is of an earlier version; {again}")
    arrays = load_npz(path)
    if not arrays:
        return None
    try:
        registration = Registration(
            arrays["template_vertices"].astype(np.float64),
            arrays["template_distance_m"].astype(np.float64),
            arrays["template_has_correspondence"],
            int(arrays["flipped_faces"]),
            bool(arrays["has_face"]),
        )
        correspondence = Correspondence(
            arrays["face"].astype(np.int64),
            arrays["barycentric"].astype(np.float64),
            arrays["distance_m"].astype(np.float64),
            arrays["offset_m"].astype(np.float64),
            arrays["label"].astype(np.int64),
        )
    except KeyError as error:
        raise UserError(f"{path} lacks the array {error}; {again}") from None
    return FittedTemplate(registration, correspondence)
