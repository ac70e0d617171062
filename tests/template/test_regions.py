"""The outer surface of the built-in body."""

import numpy as np
import trimesh

from pipeline.body.body import load_anny
from pipeline.geometry.surface import signed_distance_m
from pipeline.template.regions import load_template, outer_surface


def test_the_outer_surface_is_closed_and_solid_behind_lips_and_lids() -> None:
    """A surface below the skin has no hole where the body has cavities."""
    model = load_anny()
    body, template = model.at_shape(model.shape_defaults), load_template()
    outer = outer_surface(body)
    solid = trimesh.Trimesh(outer.vertices, outer.faces, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    behind = [template.vertices_of(part) for part in (template.mouth_faces, *template.eye_faces)]
    middles = np.stack([body.vertices[part].mean(axis=0) for part in behind])
    assert (signed_distance_m(middles, outer) < -0.01).all()
    skin = body.faces[template.skin_faces]
    np.testing.assert_array_equal(outer.faces[: len(skin)], skin)
