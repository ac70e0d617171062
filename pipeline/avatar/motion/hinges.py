"""Axes of elbows and knees in a recorded motion: they are fixed in the bones, so they tell how these are twisted."""

import numpy as np
from jaxtyping import Float

_HINGES = {
    "{side}Leg": ("{side}UpLeg", "{side}Foot", ("{side}UpLeg", "{side}Leg", "{side}Foot")),
    "{side}ForeArm": ("{side}Arm", "{side}Hand", ("{side}Arm", "{side}ForeArm")),
}
"""Of each joint that bends about one axis: joints at the other ends of its two bones, and joints to which the axis is
fixed (to the foot up to the movement of the ankle)."""

_MIN_BEND, _MIN_COMMON = np.sin(np.radians(20.0)), 0.9
"""Mean sine of the bend, and length of the mean axis in a bone over the mean length, from which on an axis is known."""
_FRONT, _LEFT = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def recorded_hinge_axes(
    world: Float[np.ndarray, "n s 3 3"], positions: Float[np.ndarray, "n s 3"], recorded_joint_of: dict[str, int]
) -> dict[str, Float[np.ndarray, "3"]]:
    """Return the axis about which elbow or knee bends, in the axes of each recorded joint to which it is fixed.

    Limbs that hardly bend, or about axes that change, have none. The end of the limb bends towards axis × bone: to the
    front in an arm, to the back in a leg.

    Args:
        world: rotations of the recorded joints.
        positions: their places, of any length unit.
        recorded_joint_of: their columns by name of the body's joint.
    """
    axes = {}
    for side in ("Left", "Right"):
        for hinge, (start, end, fixed) in _HINGES.items():
            places = [positions[:, recorded_joint_of[name.format(side=side)]] for name in (start, hinge, end)]
            upper, lower = (_unit(after - before) for before, after in zip(places, places[1:], strict=False))
            normal = np.cross(upper, lower)
            bend = np.linalg.norm(normal, axis=1).mean()
            for name in (joint.format(side=side) for joint in fixed):
                mean = np.einsum("nba,nb->a", world[:, recorded_joint_of[name]], normal) / len(normal)
                if bend > _MIN_BEND and np.linalg.norm(mean) > _MIN_COMMON * bend:
                    axes[name] = _unit(mean)
    return axes


def a_pose_hinge_axis(name: str, bone: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the axis about which elbow or knee of a person in the A-pose bends, canonical axes; bone: of the joint."""
    return np.cross(bone, _FRONT) if name.endswith("Arm") else _LEFT


def twist_rad(bone: Float[np.ndarray, "3"], before: Float[np.ndarray, "3"], after: Float[np.ndarray, "3"]) -> float:
    """Return the angle about a bone that takes one axis to another, both without their part along the bone."""
    along = _unit(bone)
    before, after = (axis - (axis @ along) * along for axis in (before, after))
    return float(np.arctan2(np.cross(before, after) @ along, before @ after))


def frame_of(bone: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return an orthonormal frame, in columns: the bone, the axis without its part along the bone, their product."""
    along = _unit(bone)
    across = _unit(axis - (axis @ along) * along)
    return np.stack([along, across, np.cross(along, across)], axis=1)


def _unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
