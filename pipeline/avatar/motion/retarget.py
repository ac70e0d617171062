"""Retarget motion capture to another skeleton so that bones have the directions of the recorded bones.

Notation: R_j(t) world rotation of a recorded joint, R_j(0) that of the reference pose, A rotation from the reference
pose to the canonical frame, W rotation from the BVH world to the world, S_j the rotation from the A-pose of a bone to
the recorded bone in the reference pose. The world rotation of the joint is W R_j(t) R_j(0)^T A^T S_j. The axes, rolls
and rest pose of the recorded skeleton cancel. The reference is the pose most similar to the A-pose, of the rest pose of
the file and the recorded poses; for arms and hands, it is the rest pose if that is a T-pose. In an A-pose and a T-pose
palms face the body or the floor, which determines the twist of the arms. Other reference poses may be twisted: people
who stand with their legs turned out have none with knees to the front. Elbows and knees that bend about other axes than
those of the A-pose tell (`pipeline.avatar.motion.hinges`), and their axes then determine the twist of the limb.
"""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from pipeline.avatar.motion.feet import find_contacts, lowest_foot_offset_m
from pipeline.avatar.motion.hinges import a_pose_hinge_axis, frame_of, recorded_hinge_axes, twist_rad
from pipeline.avatar.rig import build_rig
from pipeline.avatar.rig_names import match_names
from pipeline.body.body import Body, Motion
from pipeline.body.fit.ground_contact import SOLE_JOINTS
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import rotation_between
from pipeline.geometry.skinning import local_quaternions
from pipeline.io.bvh import BvhMotion

_LIMBS = {
    "{side}Arm": "{side}ForeArm",
    "{side}ForeArm": "{side}Hand",
    "{side}UpLeg": "{side}Leg",
    "{side}Leg": "{side}Foot",
}
_FINGERS = {
    f"{{side}}Hand{f}{k}": f"{{side}}Hand{f}{k + 1}" for f in ("Index", "Middle", "Ring", "Pinky") for k in (1, 2)
}
_BONE_CHILD = {**_LIMBS, "{side}Hand": "{side}HandMiddle1", **_FINGERS}
"""Child joint at the end of a bone. Positions of spine, collar and foot joints differ between skeletons, so the
directions of those bones are not comparable: their S is the identity (S of the parent for joints of hands and toes)."""
_FOOT_CHILD = {"{side}Foot": "{side}ToeBase"}
"""Bones that are compared where the leg is twisted in the reference pose: then the foot is not that of an A-pose."""

_REQUIRED_JOINTS = (
    "Hips",
    "Head",
    "LeftArm",
    "RightArm",
    "LeftForeArm",
    "RightForeArm",
    "LeftUpLeg",
    "RightUpLeg",
    "LeftLeg",
    "RightLeg",
    "LeftFoot",
    "RightFoot",
)
_T_POSE_COSINE = 0.97
"""Mean cosine between the limbs of the file's rest pose and of a T-pose above which the rest pose is a T-pose."""

_UPRIGHT_COSINE = np.cos(np.radians(25.0))
"""Of legs to the trunk of a rest pose that stands, and of a recorded trunk to its up axis."""

_MAX_TWIST_RAD = np.radians(15.0)
"""Twist by which the axes of elbow or knee may contradict the reference pose: no joint bends about one axis exactly."""

_MIN_FLAT_FRAMES = 5
"""Frames in which ankle and ball of a foot stand, for an estimate of the pitch of the foot's bones."""


def retarget(bvh_motion: BvhMotion, body: Body, ground_m: Float[np.ndarray, "3"], in_place: bool) -> Motion:
    """Retarget the recorded motion to another body; see `retarget_with_contacts`."""
    return retarget_with_contacts(bvh_motion, body, ground_m, in_place)[0]


def retarget_with_contacts(
    bvh_motion: BvhMotion, body: Body, ground_m: Float[np.ndarray, "3"], in_place: bool
) -> tuple[Motion, Bool[np.ndarray, "n 4"]]:
    """Retarget the recorded motion to another body, which faces +Z in the first frame.

    Distances are scaled by the ratio of the leg lengths. The 30th percentile of the lowest foot height is on the
    ground; frames with a lower foot are raised to the ground.

    Args:
        ground_m: world position below the middle of the trajectory.
        in_place: remove the horizontal root translation.

    Returns:
        The motion, and where each sole of the recorded person stands (`find_contacts`); a missing toe stands with its
        ankle.

    Raises:
        UserError: the motion lacks a required joint.
    """
    recorded_joint_of = match_joints(bvh_motion, body)
    world, positions = bvh_motion.forward_kinematics(bvh_motion.rotations)
    reference = _reference_pose(bvh_motion, body, recorded_joint_of, world, positions)
    axes = _body_axes(positions, recorded_joint_of)
    bvh_to_world = _bvh_to_world(_up_axis(bvh_motion, recorded_joint_of, axes[:, 1]), axes[0])
    soles = [recorded_joint_of.get(name, recorded_joint_of[name.replace("ToeBase", "Foot")]) for name in SOLE_JOINTS]
    hips = recorded_joint_of["Hips"]
    root = bvh_motion.trajectory(hips) @ bvh_to_world.T
    soles_m = (positions[:, soles] - positions[:, [hips]]) @ bvh_to_world.T + root[:, None]
    scale_to_m = _scale_to_m(bvh_motion, body, recorded_joint_of)
    soles_m, root = scale_to_m * soles_m, scale_to_m * root
    time_s = np.arange(len(positions)) / bvh_motion.fps
    contact = find_contacts(soles_m, time_s)
    hinges = recorded_hinge_axes(world, positions, recorded_joint_of)
    rotations = retarget_rotations(body, recorded_joint_of, world, reference, bvh_to_world, hinges)
    _flatten_standing_feet(body, rotations, contact)
    middle_m = 0.5 * (root.min(axis=0) + root.max(axis=0))
    root[:, [0, 2]] += ground_m[[0, 2]] - (root[:, [0, 2]] if in_place else middle_m[[0, 2]])
    local = local_quaternions(rotations, body.parents)
    motion = Motion(np.arange(len(local), dtype=np.int32), time_s, local, root.astype(np.float32))
    lowest_foot_height_m = lowest_foot_offset_m(body, motion)
    standing_height_m = float(np.percentile(lowest_foot_height_m, 30.0))
    root[:, 1] += ground_m[1] - standing_height_m + np.maximum(standing_height_m - lowest_foot_height_m, 0.0)
    return motion.with_pose(motion.rotations_wxyz, root), contact


def match_joints(bvh_motion: BvhMotion, body: Body) -> dict[str, int]:
    """Return the index of the recorded joint by name of the body's joint, for joints that have one.

    Raises:
        UserError: a required joint is missing.
    """
    matched = match_names(bvh_motion.joint_names)
    found = {name: matched[name] for name in body.joint_names if name in matched}
    missing = [name for name in _REQUIRED_JOINTS if name not in found]
    if missing:
        raise UserError(
            f"the motion has no joint for {missing[0]}; rename its joints to the names of Mixamo, CMU, Unity, VRM or "
            "Unreal"
        )
    return found


def resample_motion(motion: Motion, start_s: float, frame_count: int, fps: float) -> Motion:
    """Select the nearest recorded pose at each of `frame_count` times from `start_s`.

    Raises:
        UserError: the motion is too short.
    """
    rows = np.rint((start_s + np.arange(frame_count) / fps) / (motion.time_s[1] - motion.time_s[0])).astype(int)
    if rows[-1] >= len(motion.time_s):
        raise UserError(
            f"the motion ends at {motion.time_s[-1]:.2f} s, but {frame_count} frames from {start_s} s need "
            f"{start_s + (frame_count - 1) / fps:.2f} s; reduce --frames or increase --fps"
        )
    chosen = motion.select(rows)
    return Motion(
        np.arange(frame_count, dtype=np.int32),
        np.arange(frame_count) / fps,
        chosen.rotations_wxyz,
        chosen.root_translation_m,
    )


def _common_bones(table: dict[str, str], names: tuple[str, ...], recorded_joint_of: dict[str, int]) -> dict[str, str]:
    """Return the child joint of each bone of a table that both skeletons have."""
    bones = {
        name.format(side=side): child.format(side=side) for name, child in table.items() for side in ("Left", "Right")
    }
    return {
        n: c
        for n, c in bones.items()
        if n in recorded_joint_of and c in recorded_joint_of and n in names and c in names
    }


def _body_axes(positions: Float[np.ndarray, "k j 3"], recorded_joint_of: dict[str, int]) -> Float[np.ndarray, "k 3 3"]:
    """Return rotations from BVH axes to the axes of the body; rows are left, up and front of the person."""
    up = positions[:, recorded_joint_of["Head"]] - 0.5 * (
        positions[:, recorded_joint_of["LeftUpLeg"]] + positions[:, recorded_joint_of["RightUpLeg"]]
    )
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = positions[:, recorded_joint_of["LeftUpLeg"]] - positions[:, recorded_joint_of["RightUpLeg"]]
    left -= (left * up).sum(axis=1, keepdims=True) * up
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _up_axis(
    bvh_motion: BvhMotion, recorded_joint_of: dict[str, int], trunk: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3"]:
    """Return the axis of the file that is up: of a rest pose that stands, if a recorded trunk is near it.

    Else the axis nearest to the mean trunk: rest poses may be no pose of a person, or have other axes than the motion.

    trunk: unit vectors from the hips to the head, axes of the file.
    """
    _, rest = bvh_motion.forward_kinematics(np.tile(np.eye(3), (1, len(bvh_motion.parents), 1, 1)))
    rest_trunk = _body_axes(rest, recorded_joint_of)[0, 1]
    ends = [[recorded_joint_of[side + part] for side in ("Left", "Right")] for part in ("UpLeg", "Foot")]
    legs = rest[0, ends[0]] - rest[0, ends[1]]
    stands = legs @ rest_trunk > _UPRIGHT_COSINE * np.linalg.norm(legs, axis=1)
    up = _nearest_axis(rest_trunk)
    if stands.all() and (trunk @ up).max() > _UPRIGHT_COSINE:
        return up
    return _nearest_axis(trunk.mean(axis=0))


def _nearest_axis(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the axis of the file, with its sign, nearest to a direction."""
    axis = int(np.abs(direction).argmax())
    return np.asarray(np.sign(direction[axis]) * np.eye(3)[axis])


def _bvh_to_world(up: Float[np.ndarray, "3"], first: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return W: it maps `up` to +Y and the front of the first frame to +Z, with its trunk turned up on the short arc.

    The front of a trunk that lies may be vertical itself.
    """
    _, trunk, front = first
    front = front - (front @ up) / max(1.0 + trunk @ up, 1e-9) * (trunk + up)
    front -= (front @ up) * up
    front /= np.linalg.norm(front)
    return np.stack([np.cross(up, front), up, front])


def _reference_pose(
    bvh_motion: BvhMotion, body: Body, recorded_joint_of: dict[str, int], world: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return R(0)^T A^T (j, 3, 3) and canonical joint positions (j, 3) of the reference pose.

    Candidates are the rest pose of the file and every tenth frame.
    """
    rest_world, rest_positions = bvh_motion.forward_kinematics(np.tile(np.eye(3), (1, len(bvh_motion.parents), 1, 1)))
    worlds, canonical_positions = (
        np.concatenate([rest_world, world[::10]]),
        np.concatenate([rest_positions, positions[::10]]),
    )
    to_canonical = _body_axes(canonical_positions, recorded_joint_of)
    canonical_positions = np.einsum("kab,kjb->kja", to_canonical, canonical_positions)
    bones = _common_bones(_BONE_CHILD, body.joint_names, recorded_joint_of)
    best = int(_mean_cosine(canonical_positions, recorded_joint_of, bones, body, body.joints_m).argmax())
    inverse, reference_positions = worlds[best].transpose(0, 2, 1) @ to_canonical[best].T, canonical_positions[best]
    limbs = _common_bones(_LIMBS, body.joint_names, recorded_joint_of)
    t_pose_m = build_rig(body, rest_pose="t").rest_matrices()[:, :3, 3]
    if _mean_cosine(canonical_positions[:1], recorded_joint_of, limbs, body, t_pose_m)[0] > _T_POSE_COSINE:
        arms = [joint for name, joint in recorded_joint_of.items() if "Arm" in name or "Hand" in name]
        inverse[arms] = (worlds[0].transpose(0, 2, 1) @ to_canonical[0].T)[arms]
        reference_positions[arms] = canonical_positions[0, arms]
    return inverse, reference_positions


def _mean_cosine(
    positions: Float[np.ndarray, "k s 3"],
    recorded_joint_of: dict[str, int],
    bones: dict[str, str],
    body: Body,
    joints_m: Float[np.ndarray, "j 3"],
) -> Float[np.ndarray, "k"]:
    """Return the mean cosine between bones of recorded poses and of a pose of the body; -inf without lengths."""
    cosines = np.zeros(len(positions))
    for name, child in bones.items():
        bone = joints_m[body.joint(child)] - joints_m[body.joint(name)]
        recorded = positions[:, recorded_joint_of[child]] - positions[:, recorded_joint_of[name]]
        cosines += recorded @ bone / np.maximum(np.linalg.norm(recorded, axis=1) * np.linalg.norm(bone), 1e-9)
    return np.nan_to_num(cosines / len(bones), nan=-np.inf)


def retarget_rotations(
    body: Body,
    recorded_joint_of: dict[str, int],
    world: Float[np.ndarray, "n s 3 3"],
    reference: tuple[np.ndarray, np.ndarray],
    bvh_to_world: Float[np.ndarray, "3 3"],
    hinges: Mapping[str, Float[np.ndarray, "3"]] | None = None,
) -> Float[np.ndarray, "n j 3 3"]:
    """Return the world rotation of each joint of the body; joints without a recorded joint follow their parent.

    Args:
        recorded_joint_of: column of `world` by name of the body's joint.
        world: world rotations of the recorded joints.
        reference: inverse rotations of the reference pose, and its joint positions in canonical axes.
        hinges: from `recorded_hinge_axes`; None: the reference pose is an A-pose, or a T-pose in the arms.
    """
    inverse_reference, _ = reference
    from_a_pose = _rotations_from_a_pose(body, recorded_joint_of, reference, hinges or {})
    rotations = np.tile(np.eye(3), (len(world), len(body.joint_names), 1, 1))
    for joint, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if name in recorded_joint_of:
            rotations[:, joint] = (
                bvh_to_world
                @ world[:, recorded_joint_of[name]]
                @ inverse_reference[recorded_joint_of[name]]
                @ from_a_pose[joint]
            )
        else:
            rotations[:, joint] = rotations[:, parent]
    return rotations


def _rotations_from_a_pose(
    body: Body,
    recorded_joint_of: dict[str, int],
    reference: tuple[np.ndarray, np.ndarray],
    hinges: Mapping[str, Float[np.ndarray, "3"]],
) -> Float[np.ndarray, "j 3 3"]:
    """Return S of each joint, see the notation of the module."""
    inverse_reference, canonical_positions = reference
    bones = _common_bones(_BONE_CHILD | _FOOT_CHILD, body.joint_names, recorded_joint_of)
    result, twisted = np.tile(np.eye(3), (len(body.joint_names), 1, 1)), set()
    for joint, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if "Hand" in name or "Toe" in name:
            result[joint] = result[parent]
        if name not in bones:
            continue
        bone = (body.joints_m[body.joint(bones[name])] - body.joints_m[joint]).astype(np.float64)
        recorded = canonical_positions[recorded_joint_of[bones[name]]] - canonical_positions[recorded_joint_of[name]]
        limb_is_twisted = body.joint_names[parent] in twisted
        if not name.endswith("Foot"):
            result[joint] = _bone_rotation(name, bone, recorded, result[joint], limb_is_twisted)
        if name not in hinges:
            continue
        axis, wanted = a_pose_hinge_axis(name, bone), inverse_reference[recorded_joint_of[name]].T @ hinges[name]
        if name.endswith("Foot"):
            if limb_is_twisted:
                result[joint] = frame_of(recorded, wanted) @ frame_of(bone, axis).T
            continue
        angle_rad = twist_rad(recorded, result[joint] @ axis, wanted)
        if limb_is_twisted or abs(angle_rad) > _MAX_TWIST_RAD:
            twist = Rotation.from_rotvec(angle_rad * recorded / np.linalg.norm(recorded))
            result[joint] = twist.as_matrix() @ result[joint]
            twisted.add(name)
    return result


def _bone_rotation(
    name: str,
    bone: Float[np.ndarray, "3"],
    recorded: Float[np.ndarray, "3"],
    start: Float[np.ndarray, "3 3"],
    limb_is_twisted: bool,
) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from a bone of the A-pose to a recorded one, which continues `start`.

    Arms and hands also take the inner side of the elbow to the inner side: perpendicular to the bone and to the front,
    which is the axis of the elbow and the normal of the palm in an A-pose and a T-pose. Others take the shortest arc,
    as hands do whose arm was twisted in the reference pose.
    """
    if name.endswith(("Arm", "Hand")) and not limb_is_twisted:
        frames = [_arm_axes(direction) for direction in (bone, recorded)]
        if frames[0] is not None and frames[1] is not None:
            return frames[1] @ frames[0].T
    arc = rotation_between(torch.from_numpy(start @ bone), torch.from_numpy(recorded))
    return arc.numpy() @ start


def _arm_axes(bone: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"] | None:
    """Return an orthonormal frame of an arm's bone; None for one that points to the front or back."""
    inner = a_pose_hinge_axis("Arm", bone)
    return frame_of(bone, inner) if np.linalg.norm(inner) >= 0.5 * np.linalg.norm(bone) else None


def _flatten_standing_feet(
    body: Body, rotations: Float[np.ndarray, "n j 3 3"], contact: Bool[np.ndarray, "n 4"]
) -> None:
    """Turn feet and toes so that they are flat on average where they stand, in place, by a constant in their own axes.

    The pitch of the bones of a foot differs between skeletons, and feet need not be flat in the reference pose.
    """
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    for side, columns in (("Left", contact[:, :2]), ("Right", contact[:, 2:])):
        stands = columns.all(axis=1)
        if stands.sum() < _MIN_FLAT_FRAMES:
            continue
        for name in (f"{side}Foot", f"{side}ToeBase"):
            joint = body.joint(name)
            floor_normal = torch.from_numpy(rotations[stands, joint, 1].mean(axis=0))
            rotations[:, joint] = rotations[:, joint] @ rotation_between(up, floor_normal).numpy()


def _scale_to_m(bvh_motion: BvhMotion, body: Body, recorded_joint_of: dict[str, int]) -> float:
    """Return the ratio of the lengths of the left leg."""
    _, rest = bvh_motion.forward_kinematics(np.tile(np.eye(3), (1, len(bvh_motion.parents), 1, 1)))
    bones = (("LeftUpLeg", "LeftLeg"), ("LeftLeg", "LeftFoot"))
    leg_m = sum(np.linalg.norm(body.joints_m[body.joint(b)] - body.joints_m[body.joint(a)]) for a, b in bones)
    recorded = sum(np.linalg.norm(rest[0, recorded_joint_of[b]] - rest[0, recorded_joint_of[a]]) for a, b in bones)
    if recorded <= 0.0:
        raise UserError("the motion has legs of zero length; export its skeleton with offsets")
    return float(leg_m / recorded)
