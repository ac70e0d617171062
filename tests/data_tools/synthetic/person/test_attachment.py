"""An attachment is a closed surface that overlaps the person, leaves the face free, and moves with head or chest."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from data_tools.synthetic.person.anatomy import Anatomy, measure_anatomy
from data_tools.synthetic.person.attachment import ATLAS_HEIGHT_FRACTION, ATTACHMENTS, build_attachment
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.person.outfit import choose_outfit
from data_tools.synthetic.person.person import make_person
from pipeline.body.body import Body, load_anny
from pipeline.geometry.surface import signed_distance_m


@pytest.fixture(scope="module")
def bare() -> tuple[Body, Anatomy]:
    model = load_anny()
    body = model.at_shape(model.shape_defaults)
    return body, measure_anatomy(model, body)


@pytest.mark.parametrize("kind", sorted(ATTACHMENTS))
def test_an_attachment_is_closed_and_leaves_the_face_free(kind: str, bare: tuple[Body, Anatomy]) -> None:
    body, anatomy = bare
    made = build_attachment(kind, body, anatomy, ValueNoise(0))
    mesh = trimesh.Trimesh(made.vertices, made.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0.0
    assert (signed_distance_m(made.vertices.astype(np.float64), body.mesh()) < -0.01).any()
    for point_m in (*anatomy.eyes_m, anatomy.mouth_m):
        ahead = (np.abs(made.vertices[:, :2] - point_m[:2]) < 0.015).all(axis=1) & (made.vertices[:, 2] > point_m[2])
        assert not ahead.any()

    assert made.faces_uv.shape == made.faces.shape
    assert made.uv[:, 1].min() > 1.0 - ATLAS_HEIGHT_FRACTION
    assert made.uv.max() < 1.0

    np.testing.assert_allclose(made.skin_weights.sum(axis=1), 1.0, atol=1e-6)
    head = made.skin_weights[:, body.joint("Head")]
    assert (head[made.vertices[:, 1] > anatomy.mouth_m[1]] == 1.0).all()
    assert (head < 0.1).any() == (kind in ("long-hair", "ponytail", "backpack"))


def test_the_faces_of_a_cap_are_labelled_and_have_its_colour() -> None:
    subject, bare = make_person(0, 128, replace(choose_outfit(0), attachment="cap"))
    assert subject.labels is not None
    assert "cap" in subject.labels.names
    is_cap = np.array(subject.labels.names)[subject.labels.of_face] == "cap"
    brim_m = subject.body.vertices[subject.body.faces[is_cap]].reshape(-1, 3)[:, 2].max()
    nose_m = bare.vertices[bare.skin_weights[:, bare.joint("Head")] > 0.5, 2].max()
    assert brim_m > nose_m + 0.03
    uv = subject.uv[subject.faces_uv[is_cap]].mean(axis=1)
    rows, columns = ((1.0 - uv[:, 1]) * 128).astype(int), (uv[:, 0] * 128).astype(int)
    colours = subject.texture[rows, columns].astype(float)
    assert np.median(np.abs(colours - np.multiply(choose_outfit(0).stripe, 255.0))) < 20.0
