"""Operations on closed surfaces: isosurface, repair, remeshing, subdivision, smoothing, closest points, distances."""

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.meshlab import add_to_meshset, from_meshset, to_meshset

MAX_REPAIR_ITERATIONS = 4
MAX_INTERSECTION_ITERATIONS = 20


class OpenSurfaceError(ValueError):
    """A surface has holes that `repair` could not close."""


def largest_solid(inside: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Return the largest 6-connected component of a grid with its cavities filled.

    A cavity is an empty region that is not connected to the border of the grid.
    """
    labels, count = ndimage.label(inside)
    if count == 0:
        return inside
    sizes = np.bincount(labels.ravel())[1:]
    largest = labels == 1 + int(np.argmax(sizes))
    del labels  # 32 bits a sample
    return ndimage.binary_fill_holes(largest)


def isosurface(
    values: Float[np.ndarray, "x y z"], isovalue: float, origin_m: Float[np.ndarray, "3"], spacing_m: float
) -> Mesh:
    """Extract the surface of `values >= isovalue` by marching cubes (Lewiner et al. 2003).

    The surface is closed at the border of the grid; faces are counter-clockwise seen from outside.

    Args:
        values: samples of the scalar field.
        isovalue: threshold of the field.
        origin_m: position of sample [0, 0, 0], m.
        spacing_m: distance of neighbouring samples, m.

    Raises:
        ValueError: no sample reaches the isovalue.
    """
    padding_value = min(float(values.min()), isovalue) - 1.0
    padded = np.pad(values, 1, constant_values=padding_value)
    if not (padded >= isovalue).any():
        largest = float(values.max())
        raise ValueError(f"no sample of the grid reaches the isovalue {isovalue:g}; the largest is {largest:g}")
    # A sample equal to the isovalue gives faces without area, which make vertices non-manifold.
    padded[(padded > isovalue - 1e-6) & (padded < isovalue + 1e-6)] = isovalue + 1e-6
    vertices, faces, _, _ = marching_cubes(padded, isovalue, gradient_direction="ascent", allow_degenerate=False)
    vertices_m = (vertices - 1.0) * spacing_m + np.asarray(origin_m)
    return Mesh(vertices_m.astype(np.float32), faces.astype(np.int32))


def remove_unreferenced_vertices(mesh: Mesh) -> Mesh:
    """Return the mesh without the vertices that no face uses; the order of the others is kept."""
    used, flat = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[used], flat.reshape(-1, 3).astype(mesh.faces.dtype))


def weld_vertices(mesh: Mesh) -> Mesh:
    """Return the mesh with one vertex at each position, without the faces that are a line then.

    Files have a vertex several times where texture coordinates or normals change: the surface is open there.
    """
    vertices, flat = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = flat.reshape(-1)[mesh.faces].astype(mesh.faces.dtype)
    is_triangle = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return remove_unreferenced_vertices(Mesh(vertices, faces[is_triangle]))


def largest_component(mesh: Mesh) -> Mesh:
    """Return the connected component with the largest area."""
    component = igl.vertex_components(mesh.faces.astype(np.int64))[mesh.faces[:, 0]]
    areas_m2 = np.bincount(component, mesh.face_areas_m2())
    return remove_unreferenced_vertices(Mesh(mesh.vertices, mesh.faces[component == int(np.argmax(areas_m2))]))


def split_nonmanifold_vertices(mesh: Mesh) -> Mesh:
    """Duplicate each non-manifold vertex, so that every fan of faces around it has its own copy.

    Edges must have at most two faces. A mesh with manifold vertices is returned unchanged (the same object).
    `igl.split_nonmanifold` takes twice the time, also changes the winding, and orders the vertices differently.
    """
    count = len(mesh.faces)
    corner = np.arange(3 * count).reshape(count, 3)
    starts, ends = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    start_corner, end_corner = corner.ravel(), corner[:, [1, 2, 0]].ravel()
    flipped = starts > ends
    low_corner, high_corner = np.where(flipped, end_corner, start_corner), np.where(flipped, start_corner, end_corner)
    key = np.minimum(starts, ends).astype(np.int64) * len(mesh.vertices) + np.maximum(starts, ends)
    order = np.argsort(key, kind="stable")
    twin = np.flatnonzero(key[order][1:] == key[order][:-1])
    left, right = order[twin], order[twin + 1]
    pairs = np.concatenate(
        [np.stack([low_corner[left], low_corner[right]]), np.stack([high_corner[left], high_corner[right]])], axis=1
    )
    graph = coo_array((np.ones(pairs.shape[1], dtype=bool), pairs), shape=(3 * count, 3 * count))
    fan = connected_components(graph, directed=False)[1]
    _, first_corner, vertex_of_corner = np.unique(fan, return_index=True, return_inverse=True)
    if len(first_corner) == len(np.unique(mesh.faces)):
        return mesh
    return Mesh(mesh.vertices[starts[first_corner]], vertex_of_corner.reshape(-1, 3).astype(mesh.faces.dtype))


def is_closed_manifold(mesh: Mesh) -> bool:
    """Return whether the mesh is watertight and has one fan of faces around every vertex in use."""
    return mesh.is_watertight() and split_nonmanifold_vertices(mesh) is mesh


def count_self_intersecting_faces(mesh: Mesh) -> int:
    """Return the number of faces that intersect another face."""
    return int(_self_intersection_mask(mesh).sum())


def resolve_self_intersections(mesh: Mesh) -> Mesh:
    """Move the vertices of self-intersecting faces to the mean of their neighbours until no face intersects another.

    All other vertices stay. Intersections that are left after `MAX_INTERSECTION_ITERATIONS` iterations remain. A mesh
    without self-intersections is returned unchanged (the same object).
    """
    operator = laplacian(mesh)
    for _ in range(MAX_INTERSECTION_ITERATIONS):
        intersecting = _self_intersection_mask(mesh)
        if not intersecting.any():
            break
        intersecting_vertices = np.unique(mesh.faces[intersecting])
        vertices = mesh.vertices.copy()
        vertices[intersecting_vertices] -= (operator[intersecting_vertices] @ mesh.vertices).astype(vertices.dtype)
        mesh = Mesh(vertices, mesh.faces)
    return mesh


def _self_intersection_mask(mesh: Mesh) -> Bool[np.ndarray, "f"]:
    meshes = to_meshset(mesh)
    meshes.compute_selection_by_self_intersections_per_face()
    return np.asarray(meshes.current_mesh().face_selection_array(), dtype=bool)


def repair(mesh: Mesh) -> Mesh:
    """Make the largest component of a mesh watertight and manifold: remove invalid faces, close the holes.

    Raises:
        OpenSurfaceError: holes remain after `MAX_REPAIR_ITERATIONS` iterations.
    """
    for _ in range(MAX_REPAIR_ITERATIONS):
        mesh = largest_component(split_nonmanifold_vertices(_remove_invalid_faces(mesh)))
        if is_closed_manifold(mesh):
            return mesh
        meshes = to_meshset(mesh)
        meshes.meshing_re_orient_faces_coherently()
        meshes.meshing_close_holes(maxholesize=len(mesh.faces), selfintersection=False)
        mesh = from_meshset(meshes)
    raise OpenSurfaceError(f"a surface still has holes after {MAX_REPAIR_ITERATIONS} repair iterations")


def _remove_invalid_faces(mesh: Mesh) -> Mesh:
    """Remove faces with a repeated vertex, repeated faces, and the faces at edges with more than two faces."""
    faces, count = mesh.faces, len(mesh.vertices)
    low, middle, high = np.sort(faces, axis=1).astype(np.int64).T
    # One number instead of a row is sorted five times as fast; edges are numbered first, so that it fits into 64 bits.
    _, shortest = np.unique(low * count + middle, return_inverse=True)
    _, first = np.unique(shortest * count + high, return_index=True)
    single = np.zeros(len(faces), dtype=bool)
    single[first] = True
    faces = faces[(low != middle) & (middle != high) & single]
    starts, ends = faces.astype(np.int64), faces[:, [1, 2, 0]].astype(np.int64)
    _, edge, uses = np.unique(
        np.minimum(starts, ends) * count + np.maximum(starts, ends), return_inverse=True, return_counts=True
    )
    return Mesh(mesh.vertices, faces[(uses[edge.ravel()].reshape(-1, 3) <= 2).all(axis=1)])


def remesh_isotropic(
    mesh: Mesh,
    target_edge_m: float,
    iterations: int = 5,
    selected: Bool[np.ndarray, "f"] | None = None,
    tolerance_m: float | None = None,
) -> Mesh:
    """Remesh to equilateral triangles: isotropic explicit remeshing (Hoppe et al. 1993) of VCGlib.

    Each iteration splits, collapses and flips edges, smooths the vertices and projects them back to the surface.

    Args:
        mesh: the surface, m.
        target_edge_m: edge length to reach, m.
        iterations: number of iterations.
        selected: only these faces change, and their border stays; all faces if None.
        tolerance_m: no change moves the surface by more than this distance, m, so that thin parts keep short edges;
            None: not checked, which takes a third of the time.

    Raises:
        OpenSurfaceError: the result could not be repaired.
    """
    from pymeshlab import PureValue  # imported here for the reason given in `pipeline.geometry.meshlab`

    meshes = to_meshset(mesh, selected)
    meshes.meshing_isotropic_explicit_remeshing(
        iterations=iterations,
        selectedonly=selected is not None,
        targetlen=PureValue(target_edge_m),
        checksurfdist=tolerance_m is not None,
        # Unchecked, it limits the projection back to the surface.
        maxsurfdist=PureValue(target_edge_m if tolerance_m is None else tolerance_m),
    )
    return repair(from_meshset(meshes))


def collapse_edges(mesh: Mesh, selected: Bool[np.ndarray, "f"], face_count: int, shape_weight: float = 0.6) -> Mesh:
    """Reduce a part of a closed surface by edge collapses with the smallest quadric error (VCGlib).

    Args:
        mesh: the surface, m.
        selected: the part; the other faces stay.
        face_count: number of its faces to reach.
        shape_weight: weight of well-shaped triangles, in [0, 1]. `fast_simplification` has none: at equal faces its
            normals are half a degree worse.

    Raises:
        OpenSurfaceError: the result could not be repaired.
    """
    meshes = to_meshset(mesh, selected)
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=face_count,
        qualitythr=shape_weight,
        preservenormal=True,
        planarquadric=True,
        selected=True,
        # In MeshLab the defaults of these are the values of the last call in the process.
        preserveboundary=False,
        boundaryweight=1.0,
        preservetopology=False,
        optimalplacement=True,
        planarweight=0.001,
        qualityweight=False,
    )
    return repair(from_meshset(meshes))


def subtract(mesh: Mesh, other: Mesh) -> Mesh:
    """Return what of a closed surface is outside another one (exact boolean difference, libigl in MeshLab).

    Raises:
        OpenSurfaceError: the result could not be repaired.
    """
    meshes = to_meshset(mesh)
    add_to_meshset(meshes, other)
    meshes.generate_boolean_difference(first_mesh=0, second_mesh=1)
    return repair(from_meshset(meshes))


def subdivide(mesh: Mesh, marked: Bool[np.ndarray, "f"]) -> tuple[Mesh, Int[np.ndarray, "n 2"]]:
    """Subdivide the marked faces at their edge midpoints, and their neighbours so that the mesh stays conforming.

    A face with three split edges becomes 4 faces, with two 3, with one 2. Watertight manifold meshes stay so.

    Returns:
        The subdivided mesh, with the old vertices first and then one vertex per split edge; and the two end vertices
        (n, 2) of each split edge. A vertex attribute `a` of the new mesh is
        `np.concatenate([a, (a[ends[:, 0]] + a[ends[:, 1]]) / 2])`.
    """
    faces = mesh.faces.astype(np.int64)
    half_edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    ends, edge = np.unique(half_edges.reshape(-1, 2), axis=0, return_inverse=True)
    edge = edge.reshape(-1, 3)
    split = np.zeros(len(ends), dtype=bool)
    split[edge[marked]] = True
    midpoint = np.where(split, len(mesh.vertices) + np.cumsum(split) - 1, -1)
    new_faces = _split_faces(faces, midpoint[edge])
    vertices = np.concatenate([mesh.vertices, mesh.vertices[ends[split]].mean(axis=1)]).astype(mesh.vertices.dtype)
    return Mesh(vertices, new_faces.astype(mesh.faces.dtype)), ends[split]


def _split_faces(faces: Int[np.ndarray, "f 3"], middle: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "g 3"]:
    """Split faces at the midpoint vertices of their edges k = (corner k, corner k + 1); -1 marks an unsplit edge."""
    count = (middle >= 0).sum(axis=1)
    # Rotate the corners so that the split edges come first; of two split edges the unsplit edge becomes the last.
    turn = np.where(count == 1, np.argmax(middle >= 0, axis=1), np.where(count == 2, np.argmin(middle, axis=1) + 1, 0))
    columns = (np.arange(3) + turn[:, None]) % 3
    corner, middle = np.take_along_axis(faces, columns, axis=1), np.take_along_axis(middle, columns, axis=1)
    (a, b, c), (ab, bc, ca) = corner.T, middle.T
    one, two, three = count == 1, count == 2, count == 3
    parts = [faces[count == 0]]
    parts += [np.stack(t, axis=1)[one] for t in ((a, ab, c), (ab, b, c))]
    parts += [np.stack(t, axis=1)[two] for t in ((ab, b, bc), (a, ab, bc), (a, bc, c))]
    parts += [np.stack(t, axis=1)[three] for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(parts)


def adjacency(mesh: Mesh, edge_weights: Float[np.ndarray, "e"]) -> csr_array:
    """Return the symmetric adjacency matrix (v, v) with a weight for each edge of `mesh.edges()`, float64."""
    ends, count = mesh.edges(), len(mesh.vertices)
    both = np.concatenate([ends, ends[:, ::-1]])
    return coo_array((np.concatenate([edge_weights, edge_weights]), both.T), shape=(count, count)).tocsr()


def laplacian(mesh: Mesh) -> csr_array:
    """Return the uniform Laplacian I - D^-1 A, (v, v) float64.

    Applied to positions, it gives each vertex minus the mean of its neighbours. A is the adjacency matrix, D the
    diagonal matrix of the degrees.
    """
    neighbours = adjacency(mesh, np.ones(len(mesh.edges())))
    degree = np.maximum(neighbours.sum(axis=1), 1.0)
    return csr_array(diags_array(np.ones(len(mesh.vertices))) - diags_array(1.0 / degree) @ neighbours)


def smooth_taubin(mesh: Mesh, steps: int, taubin_lambda: float = 0.5, taubin_nu: float = 0.52) -> Mesh:
    """Smooth a surface without shrinking it (Taubin, "A signal processing approach to fair surface design", 1995).

    Each step moves the vertices towards the mean of their neighbours by the fraction `taubin_lambda`, then away from it
    by `taubin_nu`.
    """
    operator, vertices = laplacian(mesh), mesh.vertices.astype(np.float64)
    for _ in range(steps):
        vertices = vertices - taubin_lambda * (operator @ vertices)
        vertices = vertices + taubin_nu * (operator @ vertices)
    return Mesh(vertices.astype(np.float32), mesh.faces)


def closest_points_on_mesh(
    points: Float[np.ndarray, "n 3"], mesh: Mesh
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Return the closest point of a mesh for each query point.

    Returns:
        Distance (m), index of the closest face, and barycentric coordinates (>= 0, sum 1) of the closest point in it.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    squared, face, nearest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, dtype=np.float64), vertices, faces
    )
    a, b, c = (vertices[faces[face, k]] for k in range(3))
    barycentric = np.clip(_barycentric(nearest, a, b, c), 0.0, 1.0)
    barycentric /= barycentric.sum(axis=1, keepdims=True)
    return np.sqrt(np.maximum(squared, 0.0)), face.astype(np.int64), barycentric


class MeshAABBTree:
    """A tree of axis-aligned bounding boxes of one mesh, for repeated closest-point queries.

    Building the tree takes longer than some thousand queries.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._arrays = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
        self._tree = igl.AABB()
        self._tree.init(*self._arrays)

    def closest_points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the closest point of the mesh for each point, m."""
        query = np.ascontiguousarray(points, np.float64)
        closest: np.ndarray = self._tree.squared_distance(*self._arrays, query)[2]
        return closest


def _barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Return barycentric coordinates of points in the planes of triangles.

    A triangle without area gives (1, 0, 0), where `igl.barycentric_coordinates` gives NaN.
    """
    normal = np.cross(b - a, c - a)
    squared = np.maximum(np.sum(normal**2, axis=1), 1e-30)
    second = np.sum(np.cross(p - a, c - a) * normal, axis=1) / squared
    third = np.sum(np.cross(b - a, p - a) * normal, axis=1) / squared
    return np.stack([1.0 - second - third, second, third], axis=1)


def is_inside(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> Bool[np.ndarray, "n"]:
    """Return which points are inside a closed mesh: the generalised winding number is above one half.

    Barill et al., "Fast winding numbers for soups and clouds", 2018.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    query = np.ascontiguousarray(points, dtype=np.float64)
    return np.asarray(igl.fast_winding_number(vertices, faces, query) > 0.5)


def signed_distance_m(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> Float[np.ndarray, "n"]:
    """Return the distance (m) to a closed mesh, negative inside (`is_inside`)."""
    query = np.ascontiguousarray(points, dtype=np.float64)
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    squared, _, _ = igl.point_mesh_squared_distance(query, vertices, faces)
    return np.where(is_inside(query, mesh), -1.0, 1.0) * np.sqrt(np.maximum(squared, 0.0))
