"""Skirts and hair that hang freely: found where they are known to be, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pipeline.body.body import Body, load_anny
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.mesh.files import MeshArtifact
from pipeline.template.chains import smooth
from pipeline.template.loose_parts import body_colliders, find_loose_parts
from pipeline.template.sections import cut_at_height
from pipeline.template.skirt import hem_step
from tests.avatar.formats.skirt_avatar import SKIRT_VERTICES, clothed

HAIR, SKIN, SHIRT = (0.15, 0.1, 0.08), (0.8, 0.6, 0.5), (0.75, 0.1, 0.1)


@pytest.mark.parametrize(
    ("flare_m", "least_share"), [(0.07, 0.9), pytest.param(0.0, 0.3, marks=pytest.mark.slow, id="straight")]
)
def test_a_skirt_is_found_with_its_hem(flare_m: float, least_share: float) -> None:
    """Where a straight skirt lies on the thighs, it moves with them in part."""
    skinned, body = clothed(0, "skirt", flare_m)
    (part,) = find_loose_parts(body, skinned)
    skirt_m = skinned.mesh.vertices[-SKIRT_VERTICES:]
    assert part.kind == "skirt"
    assert len(part.chains) == 8
    for chain in part.chains:
        assert chain.parent == "Hips"
        assert chain.joints_m[0, 1] > chain.joints_m[1, 1] > chain.joints_m[-1, 1]
        assert abs(chain.joints_m[-1, 1] - skirt_m[:, 1].min()) < 0.02
        nearest_m = np.linalg.norm(skirt_m - chain.joints_m[-1], axis=1).min()
        assert nearest_m < 0.015
    share = part.weights.sum(axis=1)
    low = skirt_m[:, 1] < skirt_m[:, 1].min() + 0.1
    assert share.max() <= 1.0 + 1e-9
    assert np.quantile(share[-SKIRT_VERTICES:][low], 0.05) > least_share
    assert np.median(share[-SKIRT_VERTICES:][low]) > 0.9
    assert not share[:-SKIRT_VERTICES][skinned.mesh.vertices[:-SKIRT_VERTICES, 1] < skirt_m[:, 1].min() - 0.05].any()
    assert not share[skinned.mesh.vertices[:, 1] > body.joints_m[body.joint("Spine"), 1]].any()


def from_in_front(skinned: MeshArtifact, body: Body) -> MeshArtifact:
    """The skirt as a frontal video gives it: behind, it lies on the legs; in front, a fold goes in for 5 cm."""
    vertices = skinned.mesh.vertices.astype(np.float64).copy()
    skirt = vertices[-SKIRT_VERTICES:]
    middle_z = float(body.joints_m[[body.joint("LeftUpLeg"), body.joint("LeftLeg")], 2].mean())
    behind = (skirt[:, 2] < middle_z) & (skirt[:, 1] < body.joints_m[body.joint("LeftUpLeg"), 1])
    nearest_m = closest_points_on_mesh(skirt[behind], Mesh(body.vertices, body.faces))
    corners = body.vertices[body.faces[nearest_m[1]]].astype(np.float64)
    skirt[behind] = np.einsum("vk,vkc->vc", nearest_m[2], corners)
    in_fold = (np.abs(skirt[:, 0]) < 0.05) & (skirt[:, 2] > middle_z) & (np.abs(skirt[:, 1] - 0.77) < 0.025)
    skirt[in_fold, 2] = middle_z + 0.65 * (skirt[in_fold, 2] - middle_z)
    return replace(skinned, mesh=Mesh(vertices.astype(np.float32), skinned.mesh.faces))


def test_a_skirt_filmed_from_in_front_has_chains_all_around() -> None:
    skinned, body = clothed(0, "skirt", 0.07)
    frontal = from_in_front(skinned, body)
    (part,) = find_loose_parts(body, frontal)
    assert len(part.chains) == 8
    skirt_m = frontal.mesh.vertices[-SKIRT_VERTICES:]
    hem_m, top_m = skinned.mesh.vertices[-SKIRT_VERTICES:, 1].min(), part.chains[0].joints_m[0, 1]
    tips_m = np.array([chain.joints_m[-1] for chain in part.chains])
    angles_deg = np.rad2deg(np.unwrap(np.arctan2(tips_m[:, 0], tips_m[:, 2] - tips_m[:, 2].mean())))
    assert (np.diff(angles_deg) > 20.0).all()
    assert np.abs(tips_m[:, 1] - hem_m).max() < 0.02
    share = part.weights.sum(axis=1)[-SKIRT_VERTICES:]
    behind, height = skirt_m[:, 2] < body.joints_m[body.joint("LeftUpLeg"), 2] - 0.02, skirt_m[:, 1]
    half_way = np.abs(height - 0.5 * (hem_m + top_m)) < 0.02
    assert np.median(share[behind & half_way]) == pytest.approx(0.5, abs=0.15)
    assert np.median(share[behind & (height < hem_m + 0.02)]) < 0.2
    assert np.median(share[(skirt_m[:, 2] > 0.1) & (height < hem_m + 0.1)]) > 0.9


def test_a_hem_is_a_step_of_the_hull_and_legs_go_on() -> None:
    """A cone frustum of known radii over two legs: the step is the ratio of the areas; trousers have none."""
    skinned, body = clothed(0, "skirt", 0.07)
    skirt_m = skinned.mesh.vertices[-SKIRT_VERTICES:].astype(np.float64)
    hem_m = float(skirt_m[:, 1].min()) + 0.01
    low = skirt_m[np.abs(skirt_m[:, 1] - hem_m) < 0.01][:, [0, 2]]
    legs_m = body.vertices[np.abs(body.vertices[:, 1] - (hem_m - 0.07)) < 0.02][:, [0, 2]]
    ratio = ConvexHull(low).volume / ConvexHull(legs_m).volume
    on_arms = skinned.joint_weights * np.isin(
        skinned.joint_indices, [k for k, name in enumerate(body.joint_names) if "Arm" in name or "Hand" in name]
    )
    trunk = Mesh(skinned.mesh.vertices, skinned.mesh.faces[(on_arms.sum(axis=1) < 0.5)[skinned.mesh.faces].all(axis=1)])
    assert hem_step(trunk, body, hem_m) == pytest.approx(ratio, rel=0.1)
    trousers, wearer = clothed(3, "trousers", 0.07)
    crotch_m = float(wearer.joints_m[wearer.joint("LeftUpLeg"), 1]) - 0.08
    assert hem_step(trousers.mesh, wearer, crotch_m - 0.13) < 1.2


def test_diffused_weights_do_not_depend_on_the_size_of_the_faces() -> None:
    """A step across a plane becomes exp(-d / length) / 2 on either side, the solution of u - length^2 u'' = step."""
    for spacing_m in (0.005, 0.01):
        count = round(0.4 / spacing_m) + 1
        x_m, z_m = np.meshgrid(np.linspace(-0.2, 0.2, count), np.arange(7) * spacing_m, indexing="ij")
        row, column = np.divmod(np.arange((count - 1) * 6), 6)
        a = row * 7 + column
        faces = np.concatenate([np.stack([a, a + 1, a + 8], 1), np.stack([a, a + 8, a + 7], 1)])
        points = np.stack([x_m.ravel(), np.zeros(x_m.size), z_m.ravel()], axis=1).astype(np.float32)
        found = smooth((x_m.ravel() > 1e-6).astype(float), Mesh(points, faces.astype(np.int32))).reshape(count, 7)[:, 3]
        d_m = x_m[:, 3] - 0.5 * spacing_m
        exact = np.where(d_m > 0.0, 1.0 - 0.5 * np.exp(-d_m / 0.03), 0.5 * np.exp(d_m / 0.03))
        assert np.abs(found - exact).max() < 0.03


def test_trousers_have_nothing_that_hangs() -> None:
    skinned, body = clothed(3, "trousers", 0.07)
    assert find_loose_parts(body, skinned) == []


def long_haired(colour: tuple[float, float, float]) -> tuple[MeshArtifact, object]:
    """The built-in body with a sheet of hair: skin behind neck and upper back stands off up to 9 cm, down to 20 cm."""
    model = load_anny()
    body = model.at_shape(model.shape_defaults)
    vertices, neck_m = body.vertices.astype(np.float64).copy(), body.joints_m[body.joint("Neck")]
    height = vertices[:, 1] - neck_m[1]
    inside = (np.abs(vertices[:, 0] - neck_m[0]) < 0.08) & (vertices[:, 2] < neck_m[2]) & (height > -0.2)
    inside &= height < 0.25
    vertices[inside, 2] -= 0.09 * np.clip((0.08 - np.abs(vertices[inside, 0] - neck_m[0])) / 0.03, 0.0, 1.0)
    colours = np.tile(np.float32(SKIN), (len(vertices), 1))
    colours[inside] = colour
    colours[height > 0.12] = HAIR
    mesh = Mesh(vertices.astype(np.float32), body.faces)
    return MeshArtifact(mesh, *top_k_weights(body.skin_weights), colours), body


def test_long_hair_is_found_and_hangs_from_the_head() -> None:
    skinned, body = long_haired(HAIR)
    (part,) = find_loose_parts(body, skinned)
    assert part.kind == "hair"
    assert {chain.parent for chain in part.chains} == {"Head"}
    low_m = body.joints_m[body.joint("Neck"), 1] - 0.2
    assert abs(min(chain.joints_m[-1, 1] for chain in part.chains) - low_m) < 0.03
    moved = part.weights.sum(axis=1) > 0.5
    assert moved.sum() > 20
    assert (skinned.mesh.vertices[moved, 2] < body.joints_m[body.joint("Neck"), 2]).all()


def test_a_hood_of_another_colour_and_a_bare_body_are_no_hair() -> None:
    skinned, body = long_haired(SHIRT)
    assert find_loose_parts(body, skinned) == []
    bare = replace(skinned, mesh=Mesh(body.vertices, body.faces))
    assert find_loose_parts(body, bare) == []


def test_colliders_are_inside_the_body_and_as_thick_as_its_limbs() -> None:
    _, body = clothed(3, "trousers", 0.07)
    radius_m = {(collider.start, collider.end): collider.radius_m for collider in body_colliders(body)}
    assert 0.05 < radius_m["LeftUpLeg", "LeftLeg"] < 0.11
    assert radius_m["LeftLeg", "LeftFoot"] < radius_m["LeftUpLeg", "LeftLeg"]
    assert len(radius_m) == 7


def test_a_section_of_a_cylinder_is_its_circle() -> None:
    import trimesh

    cylinder = trimesh.creation.cylinder(radius=0.3, height=2.0, sections=256)
    mesh = Mesh(np.asarray(cylinder.vertices)[:, [1, 2, 0]], np.asarray(cylinder.faces))  # its axis is y
    section = cut_at_height(mesh, 0.123)
    np.testing.assert_allclose(section.depth_range_m(0.18), (-0.24, 0.24), atol=2e-4)
    towards = np.array([0.6, 0.8])
    np.testing.assert_allclose(section.exit_point_m(np.zeros(2), towards), 0.3 * towards, atol=1e-4)
    assert cut_at_height(mesh, 5.0).exit_point_m(np.zeros(2), towards) is None
    assert np.isnan(section.depth_range_m(0.5)).all()
