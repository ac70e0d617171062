"""Motion capture in Biovision's BVH text format."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.core.errors import UserError


@dataclass(frozen=True)
class BvhMotion:
    """A skeleton in the file's own axes and units, and its motion.

    offsets: of each joint from its parent. rotations: local, composed in the file's channel order.
    root_positions: of joint 0; zero rotations are the file's own rest pose.
    """

    joint_names: tuple[str, ...]
    parents: Int[np.ndarray, "j"]
    offsets: Float[np.ndarray, "j 3"]
    rotations: Float[np.ndarray, "n j 3 3"]
    root_positions: Float[np.ndarray, "n 3"]
    fps: float

    def forward_kinematics(
        self, rotations: Float[np.ndarray, "k j 3 3"]
    ) -> tuple[np.ndarray, Float[np.ndarray, "k j 3"]]:
        """World rotations (k, j, 3, 3) and positions relative to the root (k, j, 3) of local rotations."""
        world = rotations.copy()
        positions = np.zeros(rotations.shape[:3])
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world[:, joint] = world[:, parent] @ rotations[:, joint]
                positions[:, joint] = positions[:, parent] + world[:, parent] @ self.offsets[joint]
        return world, positions


def read_bvh(path: Path) -> BvhMotion:
    """Read a whole file.

    Raises:
        UserError: the file is missing or is no complete BVH.
    """
    if not path.is_file():
        raise UserError(f"motion {path} does not exist; give a .bvh file")
    tokens = iter(path.read_text(errors="replace").split())
    try:
        names, parents, offsets, channels = _parse_hierarchy(tokens)
        if next(tokens) != "Frames:":
            raise ValueError("no frame count")
        count = int(next(tokens))
        next(tokens), next(tokens)
        frame_time_s = float(next(tokens))
        width = sum(map(len, channels))
        values = np.array([float(word) for word in tokens])[: count * width].reshape(count, width)
    except (StopIteration, ValueError) as error:
        raise UserError(f"motion {path} is no complete BVH file ({error}); give another") from error
    rotations, root_positions = _decode_channels(values, offsets, channels)
    return BvhMotion(tuple(names), np.array(parents), offsets, rotations, root_positions, 1.0 / frame_time_s)


def _parse_hierarchy(tokens: Iterator[str]) -> tuple[list[str], list[int], np.ndarray, list[list[str]]]:
    """Names, parents, offsets and channel names of the joints, in the order of their channels.

    End sites become joints without channels named `<parent>_end`: they tell which way the last bones point.
    """
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    open_joints: list[int] = []
    for word in tokens:
        if word in ("ROOT", "JOINT", "End"):
            parent = open_joints[-1] if open_joints else -1
            name = next(tokens)
            names.append(f"{names[parent]}_end" if word == "End" else name)
            parents.append(parent)
            channels.append([])
        elif word == "{":
            open_joints.append(len(names) - 1)
        elif word == "}":
            open_joints.pop()
        elif word == "OFFSET":
            offsets.append([float(next(tokens)) for _ in range(3)])
        elif word == "CHANNELS":
            channels[open_joints[-1]] = [next(tokens) for _ in range(int(next(tokens)))]
        elif word == "MOTION":
            break
    if not names or len(offsets) != len(names):
        raise ValueError("no skeleton")
    return names, parents, np.array(offsets), channels


def _decode_channels(
    values: Float[np.ndarray, "n c"], offsets: Float[np.ndarray, "j 3"], channels: list[list[str]]
) -> tuple[Float[np.ndarray, "n j 3 3"], Float[np.ndarray, "n 3"]]:
    """Local rotations and root positions; translations of joints other than the root are ignored."""
    rotations = np.tile(np.eye(3), (len(values), len(channels), 1, 1))
    root_positions = np.tile(offsets[0], (len(values), 1))
    column = 0
    for joint, names in enumerate(channels):
        for name in names:
            axis = "XYZ".index(name[0].upper())
            if name.lower().endswith("rotation"):
                rotations[:, joint] = rotations[:, joint] @ _axis_rotation(axis, np.radians(values[:, column]))
            elif joint == 0:
                root_positions[:, axis] = values[:, column]
            column += 1
    return rotations, root_positions


def _axis_rotation(axis: int, angle: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations about a coordinate axis, radians."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.tile(np.eye(3), (len(angle), 1, 1))
    matrices[:, i, i] = matrices[:, j, j] = np.cos(angle)
    matrices[:, j, i] = np.sin(angle)
    matrices[:, i, j] = -np.sin(angle)
    return matrices
