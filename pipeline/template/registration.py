"""Non-rigid registration of the template to the surface of a person.

Amberg, Romdhani and Vetter, "Optimal step nonrigid ICP algorithms for surface registration", CVPR 2007: closest points
are searched and a sparse linear system is solved in turns, while the stiffness falls. Correspondences whose normals
disagree or whose distance is large are left out. In place of an affine transform per vertex, the unknown is the
displacement from the fitted body with its bending energy (Botsch and Sorkine, "On linear variational surface
deformation methods", 2008): the body already has the pose and the proportions of the person, and the system has a
quarter of the unknowns. Stiffness is the length over which displacements are smooth.
"""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from pipeline.body.body import Body
from pipeline.geometry.linear_systems import factorise_positive_definite
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import fit_similarity
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.template.face.landmarks import FaceLandmarks
from pipeline.template.regions import Template, load_template


@dataclass(frozen=True)
class RegistrationSettings:
    """Constants of the registration.

    Attributes:
        smoothing_lengths_m: of the displacements, one iteration each.
        held_length_m: smoothing length around lids and lips: their folds move as a whole, so that lids still close.
        held_radius_m: distance from eyeballs and from the inside of the mouth within which skin is held.
        min_normal_cosine: correspondences whose normals differ more are left out.
        max_distance_m: correspondences farther away are left out.
        robust_scale_m: distance at which a correspondence has a quarter of its weight (Geman and McClure).
        landmark_weight_m2: area that a landmark counts for.
        max_unfolding_steps: of smoothing around folded faces.
    """

    smoothing_lengths_m: tuple[float, ...] = (0.10, 0.06, 0.04, 0.025, 0.015, 0.010, 0.007, 0.005, 0.005)
    held_length_m: float = 0.03
    held_radius_m: float = 0.004
    min_normal_cosine: float = 0.5
    max_distance_m: float = 0.12
    robust_scale_m: float = 0.04
    landmark_weight_m2: float = 2e-4
    max_unfolding_steps: int = 12


@dataclass(frozen=True)
class Registration:
    """The template on the surface of a person.

    Attributes:
        vertices: of the whole template, eyeballs and tongue included, m.
        distance_m: of each vertex to the surface.
        has_correspondence: whether the vertex was drawn to the surface; others follow their neighbours: cavities, and
            places under hair, between fingers or in folds.
        flipped_faces: number of faces of the skin that are turned over.
        has_face: whether landmarks of the face took part; without them eyes and mouth are where the fitted body has
            them.
    """

    vertices: Float[np.ndarray, "v 3"]
    distance_m: Float[np.ndarray, "v"]
    has_correspondence: Bool[np.ndarray, "v"]
    flipped_faces: int
    has_face: bool

    def skin(self) -> Mesh:
        """Return the registered template without cavities, eyeballs and tongue; vertices are those of the template."""
        template = load_template()
        return Mesh(self.vertices, template.faces[template.skin_faces])

    def skin_distance_mm(self) -> tuple[float, float]:
        """Return the median and the 95th percentile of the distance of the skin's vertices to the surface, mm."""
        distance_mm = 1e3 * self.distance_m[load_template().skin_vertices]
        return float(np.median(distance_mm)), float(np.quantile(distance_mm, 0.95))


@dataclass
class _System:
    """The bending energy of displacements, and the area of each vertex."""

    laplacian: sparse.csc_matrix
    neighbours: sparse.csr_matrix
    area_m2: Float[np.ndarray, "n"]
    held: Bool[np.ndarray, "n"]

    def solve(
        self, length_m: Float[np.ndarray, "n"], weight: Float[np.ndarray, "n"], target: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the displacements that are smooth over `length_m` and near the weighted targets."""
        bending = self.laplacian.T @ sparse.diags(length_m**4 / self.area_m2) @ self.laplacian
        # The second term fixes components of the solution that no target holds.
        diagonal = weight + 1e-6 * self.area_m2
        factor = factorise_positive_definite(bending + sparse.diags(diagonal))
        return np.asarray(factor.solve(weight[:, None] * target))


def register_template(
    body: Body,
    mesh: Mesh,
    landmarks: FaceLandmarks | None = None,
    settings: RegistrationSettings | None = None,
) -> Registration:
    """Fit the surface of the built-in body to a mesh.

    Args:
        body: the fitted built-in body in the A-pose.
        mesh: the person's closed surface in the A-pose, same frame.
        landmarks: of the face; without them the face is where the fitted body has it.
        settings: constants.
    """
    settings, template = settings or RegistrationSettings(), load_template()
    rows = np.flatnonzero(template.surface_vertices)
    index = np.full(len(body.vertices), -1)
    index[rows] = np.arange(len(rows))
    faces = index[template.faces[template.surface_vertices[template.faces].all(axis=1)]]
    rest = body.vertices[rows].astype(np.float64)
    system = _build_system(rest, faces, _held_vertices(template, body, settings)[rows])
    on_skin = template.skin_vertices[rows]
    placed = np.zeros_like(rest) if landmarks is None else _head_displacement(body, rows, landmarks)
    at, displacement = index[landmarks.vertices] if landmarks else np.zeros(0, int), placed
    surface_normals, weight = mesh.face_normals(), np.zeros(len(rest))
    for length_m in settings.smoothing_lengths_m:
        current = rest + displacement
        distance_m, face, barycentric = closest_points_on_mesh(current, mesh)
        nearest = np.einsum("nk,nkc->nc", barycentric, mesh.vertices[mesh.faces[face]])
        cosine = np.sum(Mesh(current, faces).vertex_normals() * surface_normals[face], axis=1)
        used = on_skin & (cosine > settings.min_normal_cosine) & (distance_m < settings.max_distance_m)
        weight = system.area_m2 * used / (1.0 + (distance_m / settings.robust_scale_m) ** 2) ** 2
        target = nearest - rest
        if landmarks is not None:
            weight[at] = settings.landmark_weight_m2
            target[at] = landmarks.positions_m - rest[at]
        lengths_m = np.where(system.held, max(length_m, settings.held_length_m), length_m)
        displacement = placed + system.solve(lengths_m, weight, target - placed)
    displacement = _unfold(rest, displacement, faces, on_skin, system, settings)
    vertices = body.vertices.astype(np.float64).copy()
    vertices[rows] = rest + displacement
    _move_loose_parts(template, body.vertices, vertices)
    has_correspondence = np.zeros(len(vertices), dtype=bool)
    has_correspondence[rows] = weight > 0.0
    flipped = count_flipped_faces(rest, rest + displacement, faces[on_skin[faces].all(axis=1)])
    distance_m = closest_points_on_mesh(vertices, mesh)[0]
    return Registration(vertices, distance_m, has_correspondence, flipped, landmarks is not None)


def count_flipped_faces(
    before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> int:
    """Return how many faces are turned over: their normal turned by more than 90 degrees."""
    return int(_flipped(before, after, faces).sum())


def _flipped(before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> Bool[np.ndarray, "f"]:
    old, new = Mesh(before, faces).face_normals(), Mesh(after, faces).face_normals()
    return np.asarray(np.sum(old * new, axis=1) < 0.0)


def _build_system(rest: np.ndarray, faces: np.ndarray, held: np.ndarray) -> _System:
    laplacian = sparse.csc_matrix(igl.cotmatrix(rest, faces.astype(np.int64)))
    area_m2 = np.maximum(igl.massmatrix(rest, faces.astype(np.int64), igl.MASSMATRIX_TYPE_VORONOI).diagonal(), 1e-9)
    return _System(laplacian, sparse.csr_matrix(abs(laplacian)), area_m2, held)


def _held_vertices(template: Template, body: Body, settings: RegistrationSettings) -> Bool[np.ndarray, "v"]:
    """Return the vertices of lids and lips and of the cavities behind them."""
    inside = template.vertices_of(template.mouth_faces | template.socket_faces.any(axis=0))
    held = inside.copy()
    vertices, skin = body.vertices, np.flatnonzero(template.skin_vertices)
    cavity = Mesh(vertices, template.faces[template.mouth_faces | template.eye_faces.any(axis=0)])
    near = closest_points_on_mesh(vertices[skin], cavity)[0] < settings.held_radius_m
    held[skin[near]] = True
    return held


def _head_displacement(body: Body, rows: np.ndarray, landmarks: FaceLandmarks) -> Float[np.ndarray, "n 3"]:
    """Return the similarity transform of the face's landmarks as displacements, blended by the head's skin weights."""
    moved = fit_similarity(body.vertices[landmarks.vertices], landmarks.positions_m)(body.vertices[rows])
    return body.skin_weights[rows, body.joint("Head"), None] * (moved - body.vertices[rows])


def _unfold(
    rest: np.ndarray,
    displacement: np.ndarray,
    faces: np.ndarray,
    on_skin: np.ndarray,
    system: _System,
    settings: RegistrationSettings,
) -> Float[np.ndarray, "n 3"]:
    """Smooth the displacements around faces of the skin that are turned over, until there are none."""
    skin_faces = faces[on_skin[faces].all(axis=1)]
    length_m = np.full(len(rest), 1e-4)
    for step in range(settings.max_unfolding_steps):
        flipped = _flipped(rest, rest + displacement, skin_faces)
        if not flipped.any():
            break
        near = np.zeros(len(rest), dtype=bool)
        near[skin_faces[flipped]] = True
        for _ in range(step + 2):  # a wider ring each time: folds that their surroundings force open up as well
            near = np.asarray(system.neighbours @ near > 0)
        length_m = np.where(near, np.maximum(1.5 * length_m, settings.smoothing_lengths_m[-1]), length_m)
        displacement = system.solve(length_m, system.area_m2, displacement)
    return displacement


def _move_loose_parts(template: Template, before: np.ndarray, after: np.ndarray) -> None:
    """Move each eyeball with its socket and the tongue with the mouth, by similarity transforms; changes `after`."""
    parts = [(template.eye_faces[side], template.socket_faces[side]) for side in range(2)]
    for part, surroundings in (*parts, (template.tongue_faces, template.mouth_faces)):
        moved, guide = template.vertices_of(part), template.vertices_of(surroundings)
        after[moved] = fit_similarity(before[guide], after[guide])(before[moved])
