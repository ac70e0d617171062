"""Skirts and hair that hang freely: found where they are known to be, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.body.body import load_anny
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.mesh.files import MeshArtifact
from pipeline.template.loose_parts import body_colliders, find_loose_parts
from pipeline.template.sections import cut_at_height
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
