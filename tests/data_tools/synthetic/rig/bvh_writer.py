"""Write a BVH motion of the person of `glb_writer`, in centimetres."""

from pathlib import Path

import numpy as np

from tests.data_tools.synthetic.rig.glb_writer import RIG

JOINT_POSITIONS = {name: np.array(place) for name, _, place in RIG}


def write_test_bvh(path: Path, root_m: np.ndarray, left_arm_deg: np.ndarray, fps: float = 10.0) -> None:
    """Write the T-pose with hips at `root_m` (n, 3) and the left arm raised by an angle (n) about +Z."""
    lines = ["HIERARCHY", *_joint("Hips", None), "MOTION", f"Frames: {len(root_m)}", f"Frame Time: {1 / fps}"]
    order = [line.split()[1] for line in lines if line.split()[0] in ("ROOT", "JOINT")]
    for place, angle in zip(100.0 * root_m, left_arm_deg, strict=True):
        turns = [angle if name == "LeftArm" else 0.0 for name in order]
        lines.append(" ".join(map(str, [*place, *(value for turn in turns for value in (turn, 0.0, 0.0))])))
    path.write_text("\n".join(lines) + "\n")


def _joint(name: str, parent: str | None) -> list[str]:
    """Return the lines of a joint and its descendants."""
    offset = 100.0 * (JOINT_POSITIONS[name] - (JOINT_POSITIONS[parent] if parent else 0.0))
    positions = "" if parent else "Xposition Yposition Zposition "
    lines = [f"{'JOINT' if parent else 'ROOT'} {name}", "{", "OFFSET " + " ".join(map(str, offset))]
    lines.append(f"CHANNELS {3 if parent else 6} {positions}Zrotation Xrotation Yrotation")
    for child, its_parent, _ in RIG:
        lines += _joint(child, name) if its_parent == name else []
    return [*lines, "}"]
