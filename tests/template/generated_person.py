"""A generated clothed person with known correspondence to the template, and a body that was not fitted exactly."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from data_tools.synthetic.person.person import make_person
from pipeline.body.body import Body, load_anny
from pipeline.geometry.mesh import Mesh
from pipeline.template.face.landmarks import FACE_LANDMARKS, FaceLandmarks
from pipeline.template.regions import load_template

SHAPE_ERRORS = {"height": 0.02, "muscle": 0.15, "weight": -0.1, "head-width": 0.3, "neck-length": 0.2}
"""Differences of the fitted shape from the person's."""


@dataclass(frozen=True)
class GeneratedPerson:
    """A person and what is known about it.

    surface: the visible surface. all_faces: with cavities, eyeballs and tongue. bare: body without clothes.
    fitted: a body with another shape.
    template_m: where the template's vertices are on the surface.
    """

    surface: Mesh
    all_faces: np.ndarray
    bare: Body
    fitted: Body
    template_m: np.ndarray

    def landmarks(self) -> FaceLandmarks:
        """The true landmarks of the face."""
        vertices = np.array([vertex for _, vertex in FACE_LANDMARKS.values()])
        return FaceLandmarks(vertices, self.template_m[vertices], 0.0)


@lru_cache(maxsize=2)
def generated_person(seed: int = 3) -> GeneratedPerson:
    model, template = load_anny(), load_template()
    subject, bare = make_person(seed, texture_px=64)
    shape = model.shape_defaults.clone()
    for name, value in bare.shape.items():
        shape[model.shape_names.index(name)] = value + SHAPE_ERRORS.get(name, 0.0)
    visible = np.repeat(template.skin_faces, 4)  # each face was split into four
    surface = Mesh(subject.body.vertices, subject.body.faces[visible])
    known_m = subject.body.vertices[: len(bare.vertices)]
    return GeneratedPerson(surface, subject.body.faces, bare, model.at_shape(shape), known_m)
