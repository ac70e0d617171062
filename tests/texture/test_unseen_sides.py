"""The back of a person who was filmed from in front has the colours that the same slices have in front."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.body.files import load_body
from pipeline.geometry.atlas import Texels
from pipeline.mesh.files import load_mesh
from pipeline.texture.body_parts import BODY_PARTS
from pipeline.texture.unseen_sides import (
    SLICE_M,
    SLICE_WEIGHT,
    BodySlices,
    add_unseen_colours,
    find_slice_colours,
)

RED, BLUE, WHITE, BLACK = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
TORSO, HANDS = BODY_PARTS.index("torso"), BODY_PARTS.index("left hand")
ANGLES_DEG = np.arange(0.0, 360.0, 5.0)
"""Around the vertical, 0 in front."""
RADIUS_M, HEIGHT_M = 0.15, 0.6


def pillar(part: int = TORSO) -> tuple[np.ndarray, np.ndarray, np.ndarray, BodySlices]:
    """Vertices of a pillar with their angles (degrees) and heights (m), and its slices."""
    angle_deg, height_m = (part.ravel() for part in np.meshgrid(ANGLES_DEG, np.arange(0.0, HEIGHT_M, 0.01)))
    angle = np.deg2rad(angle_deg)
    vertices = np.stack([RADIUS_M * np.sin(angle), height_m, RADIUS_M * np.cos(angle)], axis=1)
    along_m = height_m if part == TORSO else np.full(len(vertices), np.nan)
    return (
        vertices,
        np.minimum(angle_deg, 360.0 - angle_deg),
        height_m,
        BodySlices(np.full(len(vertices), part), along_m),
    )


def filmed(shown: np.ndarray, colour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours, black where nothing is shown, and their weights."""
    return np.where(shown[:, None], colour, BLACK), shown.astype(float)


def add_slice_colours(
    vertices: np.ndarray, slices: BodySlices, colour: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours and weights with those of the slices."""
    found = find_slice_colours(vertices, slices, colour, weight)
    return add_unseen_colours(found.vertices, found.colour, colour, weight)


def test_the_back_has_shirt_and_trousers_with_a_hem_between() -> None:
    vertices, angle_deg, height_m, slices = pillar()
    truth = np.where((height_m > 0.3)[:, None], RED, BLUE)
    colour, weight = add_slice_colours(vertices, slices, *filmed(angle_deg < 90.0, truth))
    back = angle_deg > 120.0
    assert np.all(weight[back] == SLICE_WEIGHT)
    clear_of_hem = np.abs(height_m - 0.3) > 2.0 * SLICE_M
    np.testing.assert_allclose(colour[back & clear_of_hem], truth[back & clear_of_hem], atol=1e-12)


def test_a_hem_between_vertices_is_no_mixture() -> None:
    """One face of the back is 40 cm high. Its texels have the colours of the slices, others no difference."""
    vertices, angle_deg, height_m, slices = pillar()
    truth = np.where((height_m > 0.3)[:, None], RED, BLUE)
    found = find_slice_colours(vertices, slices, *filmed(angle_deg < 90.0, truth))
    colour, weight = add_unseen_colours(found.vertices, found.colour, *filmed(angle_deg < 90.0, truth))

    def vertex(degrees: float, height: float) -> int:
        return int(np.argmin(np.abs(angle_deg - degrees) + 1e3 * np.abs(height_m - height)))

    back = [vertex(180.0, 0.1), vertex(180.0, 0.5), vertex(150.0, 0.1)]
    front = [vertex(0.0, 0.1), vertex(0.0, 0.5), vertex(30.0, 0.1)]
    share = np.linspace(0.0, 1.0, 81)
    barycentric = np.stack([1.0 - share, share, 0.0 * share], axis=1)
    faces = np.array([back, front])
    texels = Texels(128, np.arange(81), np.arange(81), np.zeros(81, np.int32), barycentric)
    taken = weight == SLICE_WEIGHT
    seen = texels.interpolate(faces, colour) + found.between_vertices(faces, texels, taken)
    at_m = 0.1 + 0.4 * share
    expected = np.where((at_m > 0.3)[:, None], RED, BLUE)
    clear_of_hem = np.abs(at_m - 0.3) > 1.5 * SLICE_M
    np.testing.assert_allclose(seen[clear_of_hem], expected[clear_of_hem], atol=1e-6)
    in_front = replace(texels, face=np.ones(81, np.int32))
    assert not found.between_vertices(faces, in_front, taken).any()


def test_a_single_slice_of_another_colour_is_an_outlier() -> None:
    vertices, angle_deg, height_m, slices = pillar()
    dark = (np.abs(height_m - 0.3) < 0.4 * SLICE_M)[:, None]
    colour, _ = add_slice_colours(vertices, slices, *filmed(angle_deg < 90.0, np.where(dark, BLACK, RED)))
    np.testing.assert_allclose(colour[angle_deg > 120.0], np.broadcast_to(RED, (int((angle_deg > 120.0).sum()), 3)))


def test_a_print_on_the_chest_stays_in_front() -> None:
    vertices, angle_deg, _, slices = pillar()
    truth = np.where((angle_deg < 50.0)[:, None], WHITE, RED)
    colour, _ = add_slice_colours(vertices, slices, *filmed(angle_deg < 90.0, truth))
    np.testing.assert_allclose(colour[angle_deg > 120.0], np.broadcast_to(RED, (int((angle_deg > 120.0).sum()), 3)))


def test_what_is_seen_and_small_holes_stay() -> None:
    vertices, angle_deg, height_m, slices = pillar()
    hole = (angle_deg < 15.0) & (np.abs(height_m - 0.4) < 0.03)
    before = filmed(~hole, np.broadcast_to(RED, vertices.shape))
    after = add_slice_colours(vertices, slices, *before)
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)


def test_slices_that_are_not_seen_nearby_have_no_colour() -> None:
    vertices, angle_deg, height_m, slices = pillar()
    _, weight = add_slice_colours(vertices, slices, *filmed((angle_deg < 90.0) & (height_m > 0.4), vertices * 0.0))
    back = angle_deg > 120.0
    assert np.all(weight[back & (height_m < 0.3)] == 0.0)
    assert np.all(weight[back & (height_m > 0.4)] == SLICE_WEIGHT)


def test_given_colours_fill_what_is_not_seen_and_nothing_else() -> None:
    vertices, angle_deg, _, _ = pillar()
    before = filmed(angle_deg < 90.0, np.broadcast_to(RED, vertices.shape))
    rows = np.flatnonzero((angle_deg > 80.0) & (angle_deg < 120.0))
    colour, weight = add_unseen_colours(rows, np.tile(BLUE, (len(rows), 1)), *before)
    unseen = np.isin(np.arange(len(vertices)), rows) & (angle_deg >= 90.0)
    assert np.all(colour[unseen] == BLUE)
    assert np.all(weight[unseen] == SLICE_WEIGHT)
    for old, new in zip(before, (colour, weight), strict=True):
        np.testing.assert_array_equal(old[~unseen], new[~unseen])


def test_what_is_inside_of_a_skirt_takes_no_colour_of_its_slice() -> None:
    vertices, angle_deg, _, slices = pillar()
    inside = angle_deg > 150.0
    seen = filmed(angle_deg < 90.0, np.broadcast_to(RED, vertices.shape))
    hollow = slices.of_hollow_skirt(vertices[:, 1], inside, -np.inf)
    _, weight = add_slice_colours(vertices, hollow, *seen)
    assert np.all(weight[inside] == 0.0)
    assert np.all(weight[(angle_deg > 120.0) & ~inside] == SLICE_WEIGHT)


def test_cloth_and_the_legs_below_its_hem_have_colours_of_their_own() -> None:
    """The axis of a leg is inclined: a slice across the hem has more of the red leg than of the blue cloth."""
    vertices, angle_deg, _, slices = pillar()
    hem_m = float(np.median(vertices[:, 1]))
    inclined = replace(slices, along_m=slices.along_m + 0.2 * (vertices[:, 0] - vertices[:, 0].min()))
    is_cloth, unseen = vertices[:, 1] >= hem_m, angle_deg > 120.0
    seen = filmed(angle_deg < 90.0, np.where(is_cloth[:, None], BLUE, RED))

    def wrong(of: BodySlices) -> float:
        colour, _ = add_slice_colours(vertices, of, *seen)
        return float((np.abs(colour - np.where(is_cloth[:, None], BLUE, RED)).sum(axis=1) > 0.5)[unseen].mean())

    assert wrong(inclined) > 0.01
    assert wrong(inclined.of_hollow_skirt(vertices[:, 1], np.zeros(len(vertices), dtype=bool), hem_m)) == 0.0


def test_hands_and_people_whom_no_frame_shows_stay_as_they_are() -> None:
    vertices, angle_deg, _, slices = pillar(HANDS)
    before = filmed(angle_deg < 90.0, np.broadcast_to(RED, vertices.shape))
    assert np.array_equal(add_slice_colours(vertices, slices, *before)[1], before[1])
    vertices, _, _, slices = pillar()
    assert not add_slice_colours(vertices, slices, vertices * 0.0, np.zeros(len(vertices)))[1].any()


def test_slices_follow_limbs_and_the_hairline(smoke_run: Path) -> None:
    body, skinned = load_body(smoke_run / "body" / "body.npz"), load_mesh(smoke_run / "mesh")
    vertices = skinned.mesh.vertices
    slices = BodySlices.of_vertices(vertices, skinned.joint_indices, skinned.joint_weights, body)
    arm = slices.part == BODY_PARTS.index("left arm")
    along = np.linalg.norm(vertices[arm] - body.joints_m[body.joint("LeftArm")], axis=1)
    assert np.corrcoef(along, slices.along_m[arm])[0, 1] > 0.98
    head = np.flatnonzero(slices.part == BODY_PARTS.index("head"))
    joint = body.joints_m[body.joint("Head")]

    def slice_at(up_m: float, forward_m: float) -> float:
        place = joint + np.array([0.0, up_m, forward_m], dtype=np.float32)
        return float(slices.along_m[head[np.linalg.norm(vertices[head] - place, axis=1).argmin()]])

    chin, forehead, nape, crown = slice_at(-0.02, 0.1), slice_at(0.13, 0.1), slice_at(0.0, -0.08), slice_at(0.2, -0.05)
    assert chin < min(nape, forehead) <= max(nape, forehead) < crown
    assert abs(nape - forehead) < 4.0 * SLICE_M
    assert np.isnan(slices.along_m[slices.part == HANDS]).all()
