"""Read and write motion capture in the Biovision BVH text format.

Reference: M. Meredith and S. Maddock, "Motion capture file formats explained", 2001.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
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
        child_positions: relative to the parent, of the other joints that have position channels; they replace offsets.
    """

    joint_names: tuple[str, ...]
    parents: Int[np.ndarray, "j"]
    offsets: Float[np.ndarray, "j 3"]
    rotations: Float[np.ndarray, "n j 3 3"]
    root_positions: Float[np.ndarray, "n 3"]
    fps: float
    child_positions: Mapping[int, Float[np.ndarray, "n 3"]] = field(default_factory=dict)

    def forward_kinematics(
        self, rotations: Float[np.ndarray, "k j 3 3"]
    ) -> tuple[np.ndarray, Float[np.ndarray, "k j 3"]]:
        """Return world rotations (k, j, 3, 3) and joint positions relative to the root (k, j, 3) of local rotations.

        Bones have their length in the rest pose: `child_positions` do not count.
        """
        world = rotations.copy()
        positions = np.zeros(rotations.shape[:3])
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world[:, joint] = world[:, parent] @ rotations[:, joint]
                positions[:, joint] = positions[:, parent] + world[:, parent] @ self.offsets[joint]
        return world, positions

    def trajectory(self, joint: int) -> Float[np.ndarray, "n 3"]:
        """Return the positions of a joint in the axes of the file, with all position channels from the root to it."""
        path = np.zeros_like(self.root_positions)
        while joint > 0:
            parent = int(self.parents[joint])
            path = self.child_positions.get(joint, self.offsets[joint]) + path
            path = np.einsum("nab,nb->na", self.rotations[:, parent], path)
            joint = parent
        return self.root_positions + path


def require_bvh_file(path: Path) -> None:
    """Raise UserError if a path is not that of a file, before anything else is read."""
    if path.is_dir():
        raise UserError(f"motion {path} is a folder; choose a .bvh file in it")
    if not path.is_file():
        raise UserError(f"motion {path} does not exist; choose an existing .bvh file")


def read_bvh(path: Path) -> BvhMotion:
    """Read a file.

    Raises:
        UserError: the file is missing, is not a complete BVH file, or has no frames or more than `MAX_FRAMES`.
    """
    require_bvh_file(path)
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
        rotations, positions = _decode_channels(values, offsets, channels)
    except (StopIteration, ValueError, IndexError) as error:
        raise UserError(f"motion {path} is not a complete BVH file ({error}); export it again") from error
    root_positions = positions.pop(0, np.tile(offsets[0], (count, 1)))
    return BvhMotion(tuple(names), np.array(parents), offsets, rotations, root_positions, 1.0 / frame_time_s, positions)


def write_bvh(path: Path, motion: BvhMotion) -> None:
    """Write a file: rotation channels in the order z, x, y, after the position where a joint has one.

    A joint without children gets an end site of half the length of its bone, or, if its name ends in `_end`, is written
    as the end site of its parent.
    """
    lines = ["HIERARCHY", *_hierarchy_lines(motion, 0, 0)]
    lines += ["MOTION", f"Frames: {len(motion.rotations)}", f"Frame Time: {1.0 / motion.fps:.8f}"]
    order = [joint for joint in _depth_first(motion, 0) if not motion.joint_names[joint].endswith(_END_SITE)]
    positions = {0: motion.root_positions, **motion.child_positions}
    columns = []
    for joint in order:
        angles_deg = Rotation.from_matrix(motion.rotations[:, joint]).as_euler(_EULER_ORDER, degrees=True)
        columns += [positions[joint], angles_deg] if joint in positions else [angles_deg]
    rows = np.concatenate(columns, axis=1)
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
    moves = depth == 0 or joint in motion.child_positions
    channels = f"CHANNELS 6 Xposition Yposition Zposition {rotations}" if moves else f"CHANNELS 3 {rotations}"
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
) -> tuple[Float[np.ndarray, "n j 3 3"], dict[int, Float[np.ndarray, "n 3"]]]:
    """Return local rotations, and positions relative to the parent of the joints that have position channels."""
    rotations = np.tile(np.eye(3), (len(values), len(channels), 1, 1))
    positions: dict[int, np.ndarray] = {}
    column = 0
    for joint, names in enumerate(channels):
        for name in names:
            axis = "XYZ".index(name[0].upper())
            if name.lower().endswith("rotation"):
                turn = Rotation.from_euler("XYZ"[axis], values[:, [column]], degrees=True)
                rotations[:, joint] = rotations[:, joint] @ turn.as_matrix()
            else:
                positions.setdefault(joint, np.tile(offsets[joint], (len(values), 1)))[:, axis] = values[:, column]
            column += 1
    return rotations, positions
