"""Transfer of skin weights: weights of the body itself, a gap between limbs, and the exported influences."""

import numpy as np

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import isosurface
from pipeline.mesh.skin_transfer import transfer_skin, transfer_skin_weights
from tests.mesh.capsule import capsule_body


def test_weights_of_the_body_itself_are_kept() -> None:
    body = capsule_body()
    weights = transfer_skin_weights(body.mesh(), body, smoothing_steps=0)
    np.testing.assert_allclose(weights, body.skin_weights, atol=1e-5)


def test_four_influences_per_vertex_are_kept() -> None:
    body = capsule_body()
    random = np.random.default_rng(0).dirichlet(np.ones(6), size=len(body.vertices)).astype(np.float32)
    six_joints = Body(
        joint_names=tuple("abcdef"),
        parents=np.arange(-1, 5, dtype=np.int32),
        joints_m=np.zeros((6, 3), dtype=np.float32),
        vertices=body.vertices,
        faces=body.faces,
        skin_weights=random,
        shape={},
    )
    weights = transfer_skin(body.mesh(), six_joints).weights.numpy()
    assert ((weights > 0).sum(axis=1) == 4).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)


def test_weights_are_not_taken_across_a_gap() -> None:
    """A trunk and an arm side by side: the inner side of a sleeve is closer to the trunk but must follow the arm."""
    trunk = isosurface(*tube_values((0.0, 0.0)))
    arm = isosurface(*tube_values((0.24, 0.0)))
    body = Body(
        joint_names=("Hips", "LeftArm"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.zeros((2, 3), dtype=np.float32),
        vertices=np.concatenate([trunk.vertices, arm.vertices]),
        faces=np.concatenate([trunk.faces, arm.faces + len(trunk.vertices)]).astype(np.int32),
        skin_weights=np.repeat(np.eye(2, dtype=np.float32), [len(trunk.vertices), len(arm.vertices)], axis=0),
        shape={},
    )
    sleeve = isosurface(*tube_values((0.24, 0.0), radius=0.14))
    inner = sleeve.vertices[:, 0] < 0.12
    closer_to_trunk = np.linalg.norm(sleeve.vertices[inner][:, [0, 2]], axis=1) - 0.08 < 0.06
    assert closer_to_trunk.any()
    weights = transfer_skin_weights(sleeve, body)
    assert weights[:, 1].min() > 0.99
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)


def test_the_hem_of_a_wide_skirt_moves_with_the_leg_below_it() -> None:
    """A trunk above a leg, and a cone whose hem is 12 cm and more from the leg: it does not follow the trunk there."""
    tube = isosurface(*tube_values((0.0, 0.0)))
    leg_weight = np.clip(0.5 - tube.vertices[:, 1] / 0.1, 0.0, 1.0).astype(np.float32)
    body = Body(
        joint_names=("Hips", "LeftUpLeg"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.zeros((2, 3), dtype=np.float32),
        vertices=tube.vertices,
        faces=tube.faces,
        skin_weights=np.stack([1.0 - leg_weight, leg_weight], axis=1),
        shape={},
    )
    widening = np.interp(tube.vertices[:, 1], (-0.3, 0.2), (3.0, 1.1))[:, None]
    cone = Mesh((tube.vertices * np.where([True, False, True], widening, 1.0)).astype(np.float32), tube.faces)
    hem = (np.abs(cone.vertices[:, 1] + 0.2) < 0.03) & (np.hypot(cone.vertices[:, 0], cone.vertices[:, 2]) > 0.2)
    assert hem.any()
    assert transfer_skin_weights(cone, body)[hem, 1].min() > 0.95


def tube_values(centre_xz: tuple[float, float], radius: float = 0.08) -> tuple[np.ndarray, float, np.ndarray, float]:
    """Arguments of `isosurface` for a vertical capsule."""
    origin = np.array([centre_xz[0] - 0.2, -0.5, centre_xz[1] - 0.2])
    index = np.stack(np.meshgrid(np.arange(21), np.arange(51), np.arange(21), indexing="ij"), axis=-1)
    points = origin + 0.02 * index - np.array([centre_xz[0], 0.0, centre_xz[1]])
    points[..., 1] -= np.clip(points[..., 1], -0.25, 0.25)
    return radius - np.linalg.norm(points, axis=-1), 0.0, origin, 0.02
