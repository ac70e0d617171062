"""Labels of the true faces: the garment or the body part that each face shows."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, Shaped

from pipeline.body.body import Body
from pipeline.io.npz import load_npz, save_npz

LABELS_FILE = "labels.npz"

_PART_OF_JOINT = (
    ("head", ("Neck", "Head")),
    ("hands", ("Hand",)),
    ("arms", ("Arm", "ForeArm")),
    ("feet", ("Foot", "ToeBase")),
    ("legs", ("UpLeg", "Leg")),
)
"""Parts by the names of their joints without Left and Right; joints of fingers begin with Hand. All others: trunk."""


@dataclass(frozen=True)
class FaceLabels:
    """names: of the labels, in alphabetical order. of_face: index into the names for each face."""

    names: tuple[str, ...]
    of_face: Int[np.ndarray, "f"]

    def select(self, faces: Shaped[np.ndarray, "f"]) -> "FaceLabels":
        """Return the labels of some of the faces, given as a mask."""
        return FaceLabels(self.names, self.of_face[faces])


def labels_from_names(name_of_face: Shaped[np.ndarray, "f"]) -> FaceLabels:
    """Return the labels for an array with the name of each face."""
    names, of_face = np.unique(name_of_face, return_inverse=True)
    return FaceLabels(tuple(str(name) for name in names), of_face.ravel().astype(np.int32))


def body_part_names(body: Body) -> Shaped[np.ndarray, "f"]:
    """Return the body part of each face: that of the joints with the largest weight, summed over its corners."""
    part_of_joint = np.array([_part(name) for name in body.joint_names])
    parts = np.unique(part_of_joint)
    weights = np.stack([body.skin_weights[:, part_of_joint == part].sum(axis=1) for part in parts], axis=1)
    return parts[weights[body.faces].sum(axis=1).argmax(axis=1)].astype("U16")


def _part(joint_name: str) -> str:
    name = joint_name.removeprefix("Left").removeprefix("Right")
    for part, joints in _PART_OF_JOINT:
        if name in joints or (part == "hands" and name.startswith("Hand")):
            return part
    return "trunk"


def save_labels(folder: Path, labels: FaceLabels) -> None:
    """Write `labels.npz`: `label_names` (k,) text and `face_label` (f,)."""
    save_npz(folder / LABELS_FILE, {"label_names": np.array(labels.names), "face_label": labels.of_face})


def load_labels(folder: Path) -> FaceLabels | None:
    """Read the file of `save_labels`; None if there is none, as in captures made before it was written."""
    if not (folder / LABELS_FILE).is_file():
        return None
    arrays = load_npz(folder / LABELS_FILE)
    return FaceLabels(tuple(arrays["label_names"].tolist()), arrays["face_label"])
