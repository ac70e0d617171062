"""What the report says was modelled, from manifests of a person whose figures are known."""

from dataclasses import replace
from typing import Any

import pytest

from pipeline.core.manifest import Manifest
from pipeline.report.modelled import ModelledPart, modelled_parts
from pipeline.report.page import render_page
from tests.report.report_sample import sample_manifests, sample_page

CONFIGS: dict[str, dict[str, Any]] = {
    "frames": {"max_frames": 200},
    "field": {"max_frames": 120, "settings": {"levels": 5, "finest_cell_px": 2.0, "occupancy": "plain"}},
    "mesh": {"rounds": 3, "max_final_faces": 14500},
    "texture": {"min_texture_px": 512, "max_texture_px": 2048, "light": "auto", "normal_map": False},
}
METRICS: dict[str, dict[str, float | None]] = {
    "frames": {
        "frames_train": 72.0,
        "frames_validation": 12.0,
        "frames_heldout": 12.0,
        "video_frames": 143.0,
        "dropped_duplicates": 47.0,
    },
    "field": {
        "validation_psnr_fitted_db": 29.336,
        "validation_psnr_refined_db": 34.008,
        "poses_kept": 1.0,
        "steps": 750.0,
        "train_frames": 72.0,
        "parameters": 1364864.0,
        "finest_cell_mm": 7.42,
    },
    "mesh": {
        "faces": 14498.0,
        "faces_before_reduction": 54788.0,
        "target_edge_m": 0.0117,
        "accepted_rounds": 2.0,
        "initial_validation_psnr_db": 25.11,
        "refined_validation_psnr_db": 30.57,
        "interpolated_motion_psnr_db": 30.571,
        "aligned_motion_psnr_db": 30.367,
        "aligned_frames": 0.0,
    },
    "texture": {
        "texture_px": 1024.0,
        "light_removed": 1.0,
        "light_explained": 0.2947,
        "light_standard_errors": 9.402,
        "specular_explained": 0.0046,
        "specular_standard_errors": 3.419,
        "specular_regions": 0.0,
    },
    "export": {"glb_bytes": 4040444.0, "faces": 18434.0, "glb_faces": 24476.0, "morph_targets": 67.0},
}


def known_manifests(**changed: dict[str, float | None]) -> dict[str, Manifest]:
    """Manifests of all stages; `changed` replaces metrics of a stage."""
    return {
        name: replace(
            manifest,
            config=CONFIGS.get(name, {}),
            metrics={**manifest.metrics, **METRICS.get(name, {}), **changed.get(name, {})},
        )
        for name, manifest in sample_manifests().items()
    }


def parts(manifests: dict[str, Manifest]) -> dict[str, ModelledPart]:
    return {part.part: part for part in modelled_parts(manifests)}


def test_sizes_name_their_rule_limit_and_cost():
    found = parts(known_manifests())
    assert found["Frames"].choice == "72 to learn from, 12 to decide, 12 to judge, of 143 in the video"
    assert "47 were left out" in found["Frames"].reason
    assert "limited" not in found["Frames"].reason
    field = found["Radiance field"]
    assert field.choice == "5 levels of cells down to 7.4 mm, 1.36 million parameters, 750 steps"
    assert "2 pixels" in field.reason
    assert field.cost == "3 s, 5.5 MB"
    assert found["Frames of the field"].choice == "72 of 72 training frames"
    assert "limited" not in found["Frames of the field"].reason
    assert found["Faces"].choice == "14,498 of 54,788"
    assert "mesh.max_final_faces" in found["Faces"].reason
    assert "12 mm" in found["Faces"].reason
    assert found["Faces"].cost.startswith("4.0 MB")
    assert found["Texture"].choice == "1,024 × 1,024 px"
    assert "allows" not in found["Texture"].reason


def test_limits_are_named_only_where_they_bind():
    changed = {"frames": {"frames_train": 176.0}, "field": {"train_frames": 120.0}, "mesh": {"faces": 9000.0}}
    found = parts(known_manifests(**changed, texture={"texture_px": 2048.0}))
    assert found["Frames of the field"].choice == "120 of 176 training frames"
    assert "field.max_frames" in found["Frames of the field"].reason
    assert "frames.max_frames" in found["Frames"].reason
    assert "limited" not in found["Faces"].reason
    assert "texture.max_texture_px" in found["Texture"].reason


def test_optional_parts_state_decision_figure_and_cost():
    found = parts(known_manifests())
    assert found["Pose corrections"].choice == "kept"
    assert "29.34 dB" in found["Pose corrections"].reason
    assert "34.01 dB" in found["Pose corrections"].reason
    assert found["Poses by the outline"].choice == "dropped"
    assert "30.37 dB" in found["Poses by the outline"].reason
    assert found["Light of the video"].choice == "removed from the texture"
    assert "29 %" in found["Light of the video"].reason
    assert "9.4 standard errors" in found["Light of the video"].reason
    off = found["Highlights"]
    assert off.choice == "off"
    assert "0.5 %" in off.reason
    assert off.cost == "their map would cost about 0.1 MB"
    on = parts(known_manifests(texture={"specular_regions": 3.0, "specular_explained": 0.12}))["Highlights"]
    assert on.choice == "on in 3 regions"
    assert "12 %" in on.reason
    assert "would" not in on.cost
    assert found["Voxel attention"].choice == found["Normal map"].choice == "off"
    assert found["Face that moves"].cost == "6,042 faces, 67 morph targets"


def test_parts_that_are_off_name_who_decided_it():
    """The figures are those of manifests of the texture stage without a light, and of the export without a face."""
    nothing = {"light_removed": 0.0, "specular_explained": 0.0, "specular_standard_errors": 0.0}
    manifests = known_manifests(texture=nothing, export={"morph_targets": 0.0})
    found = parts(manifests)
    assert found["Highlights"].reason.startswith("not tried: no lamp")
    assert found["Face that moves"].reason.startswith("no face was found")
    manifests["texture"] = replace(manifests["texture"], config=CONFIGS["texture"] | {"light": "kept"})
    manifests["export"] = replace(manifests["export"], config={"face": False})
    found = parts(manifests)
    assert found["Highlights"].reason == "not tried: asked for by texture.light=kept"
    assert found["Face that moves"].reason == "asked for by export.face"


@pytest.mark.parametrize("missing", [{"parameters": None}, {}])
def test_a_figure_that_is_missing_leaves_out_its_line(missing):
    manifests = known_manifests(field=missing)
    if not missing:
        del manifests["field"]
    names = list(parts(manifests))
    assert "Radiance field" not in names
    assert "Texture" in names
    assert "Faces" in names
    assert modelled_parts(sample_manifests()) == []


def test_the_page_shows_the_table_escaped():
    content = sample_page()
    row = {"part": "Faces <b>", "choice": "14,498", "reason": "because", "cost": "4 MB"}
    page = render_page(replace(content, report={**content.report, "modelled": [row]}))
    assert "What was modelled, and why" in page
    assert "Faces &lt;b&gt;" in page
    assert "What was modelled" not in render_page(content)
