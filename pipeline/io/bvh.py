"""Read and write motion capture in the Biovision BVH text format.

Reference: M. Meredith and S. Maddock, "Motion capture file formats explained", 2001.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from pipeline.core.errors import UserError

MAX_FRAMES = 100_000
"""Frames of a file: 14 minutes at 120 frames per second."""

MIN_FRAME_TIME_S = 1e-6
"""Shorter frames have no finite rate, and no recording has them."""

_MAX_BYTES = 1 << 28
_END_SITE = "_end"
_EULER_ORDER = "ZXY"


@dataclass(frozen=True)
class BvhMotion:
    """A skeleton and its motion, in the axes and units of the file; zero rotations are its rest pose.

    Attributes:
        offsets: of each joint from its parent.
        rotations: local, composed in the channel order of the file.
        root_positions: of joint 0.
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
        """Return world rotations (k, j, 3, 3) and joint positions relative to the root (k, j, 3) of local rotations."""
        world = rotations.copy()
        positions = np.zeros(rotations.shape[:3])
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world[:, joint] = world[:, parent] @ rotations[:, joint]
                positions[:, joint] = positions[:, parent] + world[:, parent] @ self.offsets[joint]
        return world, positions


def read_bvh(path: Path) -> BvhMotion:
    """Read a file.

    Raises:
        UserError: the file is missing, is not a complete BVH file, or has no frames or more than `MAX_FRAMES`.
    """
    if not path.is_file():
        raise UserError(f"motion {path} does not exist; choose an existing .bvh file")
    if path.stat().st_size > _MAX_BYTES:
        raise UserError(f"motion {path} has {path.stat().st_size} bytes; cut it to at most {MAX_FRAMES} frames")
    tokens = iter(path.read_text(errors="replace").split())
    try:
        names, parents, offsets, channels = _parse_hierarchy(tokens)
        if next(tokens) != "Frames:":
            raise ValueError("no frame count")
        count = int(next(tokens))
        if not 1 <= count <= MAX_FRAMES:
            raise UserError(f"motion {path} has {count} frames; supply a clip of 1 to {MAX_FRAMES} frames")
        next(tokens), next(tokens)
        frame_time_s = float(next(tokens))
        if not MIN_FRAME_TIME_S <= frame_time_s < np.inf:
            raise ValueError(f"frame time {frame_time_s}")
        width = sum(map(len, channels))
        values = np.array([float(token) for token in tokens])[: count * width].reshape(count, width)
        if not (np.isfinite(values).all() and np.isfinite(offsets).all()):
            raise UserError(f"motion {path} has values that are not finite; export it again")
        rotations, root_positions = _decode_channels(values, offsets, channels)
    except (StopIteration, ValueError, IndexError) as error:
        raise UserError(f"motion {path} is not a complete BVH file ({error}); export it again") from error
    return BvhMotion(tuple(names), np.array(parents), offsets, rotations, root_positions, 1.0 / frame_time_s)


def write_bvh(path: Path, motion: BvhMotion) -> None:
    """Write a file: rotation channels in the order z, x, y, for the root after its position.

    A joint without children gets an end site of half the length of its bone, or, if its name ends in `_end`, is written
    as the end site of its parent.
    """
    lines = ["HIERARCHY", *_hierarchy_lines(motion, 0, 0)]
    lines += ["MOTION", f"Frames: {len(motion.rotations)}", f"Frame Time: {1.0 / motion.fps:.8f}"]
    order = [joint for joint in _depth_first(motion, 0) if not motion.joint_names[joint].endswith(_END_SITE)]
    angles_deg = Rotation.from_matrix(motion.rotations[:, order].reshape(-1, 3, 3)).as_euler(_EULER_ORDER, degrees=True)
    rows = np.concatenate([motion.root_positions, angles_deg.reshape(len(motion.rotations), -1)], axis=1)
    lines += [" ".join(f"{value:.6f}" for value in row) for row in rows.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _children(motion: BvhMotion, joint: int) -> list[int]:
    return np.flatnonzero(motion.parents == joint).tolist()


def _depth_first(motion: BvhMotion, joint: int) -> Iterator[int]:
    yield joint
    for child in _children(motion, joint):
        yield from _depth_first(motion, child)


def _hierarchy_lines(motion: BvhMotion, joint: int, depth: int) -> list[str]:
    """Return the lines of a joint and its descendants, indented by tabs."""
    name, children = motion.joint_names[joint], _children(motion, joint)
    offset = "OFFSET " + " ".join(f"{value:.6f}" for value in motion.offsets[joint])
    if name.endswith(_END_SITE):
        body = ["End Site", "{", f"\t{offset}", "}"]
        return ["\t" * depth + line for line in body]
    rotations = " ".join(f"{axis}rotation" for axis in _EULER_ORDER)
    channels = f"CHANNELS 3 {rotations}" if depth else f"CHANNELS 6 Xposition Yposition Zposition {rotations}"
    lines = [f"{'JOINT' if depth else 'ROOT'} {name}", "{", f"\t{offset}", f"\t{channels}"]
    lines = ["\t" * depth + line for line in lines]
    for child in children:
        lines += _hierarchy_lines(motion, child, depth + 1)
    if not children:
        end = " ".join(f"{value:.6f}" for value in 0.5 * motion.offsets[joint])
        lines += ["\t" * (depth + 1) + line for line in ("End Site", "{", f"\tOFFSET {end}", "}")]
    return [*lines, "\t" * depth + "}"]


def _parse_hierarchy(tokens: Iterator[str]) -> tuple[list[str], list[int], np.ndarray, list[list[str]]]:
    """Return names, parents, offsets and channel names of the joints, in file order.

    End sites become joints without channels, named `<parent>_end`; they define the direction of the last bones.
    """
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    open_joints: list[int] = []
    for token in tokens:
        if token in ("ROOT", "JOINT", "End"):
            parent = open_joints[-1] if open_joints else -1
            name = next(tokens)
            names.append(f"{names[parent]}{_END_SITE}" if token == "End" else name)
            parents.append(parent)
            channels.append([])
        elif token == "{":
            if not names:
                raise ValueError("a bracket without a joint")
            open_joints.append(len(names) - 1)
        elif token == "}":
            open_joints.pop()
        elif token == "OFFSET":
            offsets.append([float(next(tokens)) for _ in range(3)])
        elif token == "CHANNELS":
            channels[open_joints[-1]] = [next(tokens) for _ in range(int(next(tokens)))]
        elif token == "MOTION":
            break
    if not names or len(offsets) != len(names):
        raise ValueError("no skeleton")
    return names, parents, np.array(offsets), channels


def _decode_channels(
    values: Float[np.ndarray, "n c"], offsets: Float[np.ndarray, "j 3"], channels: list[list[str]]
) -> tuple[Float[np.ndarray, "n j 3 3"], Float[np.ndarray, "n 3"]]:
    """Return local rotations and root positions; translation channels of other joints are ignored."""
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


def _axis_rotation(axis: int, angle_rad: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
    """Return rotation matrices about a coordinate axis (0, 1, 2)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.tile(np.eye(3), (len(angle_rad), 1, 1))
    matrices[:, i, i] = matrices[:, j, j] = np.cos(angle_rad)
    matrices[:, j, i] = np.sin(angle_rad)
    matrices[:, i, j] = -np.sin(angle_rad)
    return matrices
