"""The template's layout on generated people: injective, the same places for both, loose parts in their own charts."""

from functools import lru_cache

import numpy as np
import pytest

from data_tools.synthetic.person.outfit import choose_outfit
from data_tools.synthetic.person.person import make_person
from pipeline.geometry.atlas import Atlas, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.template.layout import load_layout
from pipeline.template.regions import load_template, template_quads
from pipeline.template.registration import register_template
from pipeline.template.template_atlas import INSIDE_SCALE, TemplateAtlas, build_template_atlas
from tests.template.generated_person import generated_person

SIZE_PX = 512
SEEDS = (3, 5)


@lru_cache(maxsize=2)
def laid_out(seed: int) -> tuple[TemplateAtlas, Mesh]:
    person = generated_person(seed)
    registration = register_template(person.fitted, person.surface, person.landmarks())
    found = build_template_atlas(person.surface, registration, SIZE_PX, 4)
    return found, found.cut.apply(person.surface)


def signed_areas(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (uv[faces[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a) / 2


def test_the_layout_has_no_folds_and_no_overlaps() -> None:
    layout, template = load_layout(), load_template()
    skin = template.skin_faces
    assert ((layout.chart >= 0) == skin).all()
    areas = signed_areas(layout.uv, layout.faces_uv[skin])
    assert areas.min() > 0.0
    atlas = Atlas(layout.uv.astype(np.float32), layout.faces_uv[skin].astype(np.int32), np.zeros(len(layout.uv), int))
    covered = len(rasterize_texels(atlas, 1024).face) / 1024**2
    assert covered == pytest.approx(areas.sum(), rel=0.005)  # overlaps would cover less than their sum
    left, bottom, right, top = layout.reserved
    inside = ((layout.uv > [left, bottom]) & (layout.uv < [right, top])).all(axis=1)
    assert not inside.any()
    assert layout.uv.min() > 0.0
    assert layout.uv.max() < 1.0


def test_the_face_has_twice_the_texels_and_quads_are_whole() -> None:
    layout, template = load_layout(), load_template()
    chart = layout.chart
    assert (chart[0::2] == chart[1::2]).all()
    quads = template_quads()
    for k in range(2):
        assert (np.isin(template.faces[k::2], quads[:, :]).all(axis=1)).all()
    body = generated_person(3).bare
    per_m2 = [
        np.median(signed_areas(layout.uv, layout.faces_uv[rows]) / body.mesh().face_areas_m2()[rows])
        for rows in (chart == chart[_face_at(294)], chart == chart[_face_at_back(body)])
    ]
    assert np.sqrt(per_m2[0] / per_m2[1]) > 1.7


def _face_at(vertex: int) -> int:
    return int(np.flatnonzero((load_template().faces == vertex).any(axis=1) & load_template().skin_faces)[0])


def _face_at_back(body) -> int:  # type: ignore[no-untyped-def]
    """A face of the skin at the navel's height, at the back."""
    middle = body.vertices[load_template().faces].mean(axis=1)
    target = np.array([0.0, body.joints_m[body.joint("Spine"), 1], -0.2])
    return int(np.linalg.norm(middle - target, axis=1).argmin())


@pytest.mark.slow
def test_a_person_lies_on_it_without_folds() -> None:
    found, surface = laid_out(SEEDS[0])
    atlas = found.atlas
    np.testing.assert_array_equal(atlas.vertex_of_uv[atlas.faces_uv], surface.faces)
    areas = signed_areas(atlas.uv, atlas.faces_uv)[~found.loose_faces]
    assert -areas[areas < 0.0].sum() < 2e-4 * areas.sum()
    assert (areas <= 0.0).mean() < 0.005
    assert found.loose_share < 0.05
    texels = rasterize_texels(atlas, 1024)
    areas = np.abs(signed_areas(atlas.uv, atlas.faces_uv)).sum()
    assert len(texels.face) / 1024**2 == pytest.approx(areas, rel=0.01)
    # a chart is one piece but for its cuts: as many corners as vertices, and some more along borders
    assert len(atlas.uv) < 1.15 * len(surface.vertices)


@pytest.mark.slow
def test_one_place_of_the_texture_is_the_same_place_on_two_people() -> None:
    found = []
    for seed in SEEDS:
        (laid, surface), person = laid_out(seed), generated_person(seed)
        texels = rasterize_texels(laid.atlas, SIZE_PX)
        texels = texels.select(~laid.loose_faces[texels.face])
        points_m = texels.interpolate(surface.faces, surface.vertices)
        image = np.full((SIZE_PX, SIZE_PX, 3), np.nan)
        image[texels.rows, texels.columns] = points_m
        found.append((image, person))
    (first, here), (second, there) = found
    both = np.isfinite(first[..., 0]) & np.isfinite(second[..., 0])
    skin = load_template().faces[load_template().skin_faces]
    _, face, barycentric = closest_points_on_mesh(first[both], Mesh(here.template_m, skin))
    known_m = np.einsum("nk,nkc->nc", barycentric, there.template_m[skin[face]])
    error_mm = 1e3 * np.linalg.norm(second[both] - known_m, axis=1)
    print("place error, mm", np.median(error_mm), np.quantile(error_mm, 0.95))
    assert both.sum() > 0.95 * np.isfinite(first[..., 0]).sum()
    assert np.median(error_mm) < 8.0
    assert np.quantile(error_mm, 0.95) < 25.0


@pytest.mark.slow
def test_a_skirt_gets_charts_in_the_reserved_square() -> None:
    template = load_template()
    subject, bare = make_person(SEEDS[0], 64, choose_outfit(SEEDS[0], "skirt"))
    visible = np.ones(len(subject.body.faces), dtype=bool)
    visible[: 4 * len(template.skin_faces)] = np.repeat(template.skin_faces, 4)
    surface = Mesh(subject.body.vertices, subject.body.faces[visible])
    found = build_template_atlas(surface, register_template(bare, surface), SIZE_PX, 4)
    left, bottom, right, top = load_layout().reserved
    corners = found.atlas.uv[found.atlas.faces_uv[found.loose_faces]]
    assert found.loose_share > 0.02
    assert ((corners >= [left, bottom]) & (corners <= [right, top])).all()
    areas = signed_areas(found.atlas.uv, found.atlas.faces_uv)[~found.loose_faces]
    assert -areas[areas < 0.0].sum() < 1e-3 * areas.sum()


@pytest.mark.slow
def test_what_is_inside_of_a_skirt_has_small_charts_in_the_reserved_square() -> None:
    """A band of one shin stands for the inside: it would have a place on the layout."""
    person = generated_person(SEEDS[0])
    registration = register_template(person.fitted, person.surface, person.landmarks())
    at_m = person.surface.vertices
    inside = (at_m[:, 1] > 0.25) & (at_m[:, 1] < 0.4) & (at_m[:, 0] > 0.0)
    usual = build_template_atlas(person.surface, registration, SIZE_PX, 4)
    found = build_template_atlas(person.surface, registration, SIZE_PX, 4, is_inside=inside)
    surface = found.cut.apply(person.surface)
    flags = found.cut.extend_flags(inside)[surface.faces]
    faces, beside = flags.all(axis=1), flags.any(axis=1) & ~flags.all(axis=1)
    np.testing.assert_array_equal(found.loose_faces[beside], usual.loose_faces[beside])
    assert not usual.loose_faces[faces].all()
    assert found.loose_faces[faces].all()
    left, bottom, right, top = load_layout().reserved
    corners = found.atlas.uv[found.atlas.faces_uv[faces]]
    assert ((corners >= [left, bottom]) & (corners <= [right, top])).all()
    per_m2 = np.abs(signed_areas(found.atlas.uv, found.atlas.faces_uv)) / surface.face_areas_m2()
    others = found.loose_faces & ~faces
    assert np.median(per_m2[faces]) / np.median(per_m2[others]) == pytest.approx(INSIDE_SCALE**2, rel=0.2)
