"""Regions of one material: they end where the colour changes, and are not larger than a part of a garment."""

import numpy as np

from pipeline.texture.lighting.material_regions import material_regions


def test_a_region_has_one_colour_and_one_place() -> None:
    random = np.random.default_rng(0)
    vertices = random.uniform(0.0, 1.5, size=(4000, 3)) * [0.3, 1.0, 0.2]
    red = vertices[:, 1] + 0.05 * np.sin(20.0 * vertices[:, 0]) > 0.75
    albedo = np.where(red[:, None], [0.8, 0.2, 0.2], [0.2, 0.3, 0.7]) + 0.02 * random.normal(size=(4000, 3))
    region = material_regions(albedo, vertices, regions=12)
    assert 8 <= region.max() + 1 <= 12
    for label in range(region.max() + 1):
        members = region == label
        share = red[members].mean()
        assert min(share, 1.0 - share) < 0.02
        assert np.ptp(vertices[members, 1]) < 0.8


def test_fewer_vertices_than_regions() -> None:
    region = material_regions(np.eye(3), np.eye(3), regions=40)
    assert sorted(region.tolist()) == [0, 1, 2]
