"""Parts of the built-in body, and its outer surface."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from data_tools import template_assets, template_layout
from data_tools.template_assets import main
from pipeline.body.body import load_anny
from pipeline.geometry.surface import signed_distance_m
from pipeline.io.npz import load_npz
from pipeline.template.face.units import FACE_UNITS_NPZ
from pipeline.template.regions import ASSETS, PARTS_NPZ, load_template, outer_surface


def test_the_parts_of_the_package_are_those_of_the_library(tmp_path) -> None:
    main([str(tmp_path)])
    for name in (PARTS_NPZ, FACE_UNITS_NPZ):
        made, kept = load_npz(tmp_path / name), load_npz(ASSETS / name)
        assert made.keys() == kept.keys()
        for key, array in made.items():
            np.testing.assert_array_equal(kept[key], array, err_msg=f"{name}: {key}", strict=True)


@pytest.mark.parametrize("tool", [template_assets, template_layout])
def test_help_is_shown_and_nothing_is_written(tool, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(f"{tool.__name__}.load_anny", lambda: pytest.fail("the model is not needed"))
    with pytest.raises(SystemExit) as ended:
        tool.main(["--help"])
    assert ended.value.code == 0
    assert f"usage: python -m {tool.__name__}" in capsys.readouterr().out
    assert not list(Path.cwd().iterdir())


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
