"""Collect all scores of a comparison with the ground truth, and render them as one HTML page."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from data_tools.evaluate.compare_avatar import (
    compare_ceiling,
    compare_clay,
    compare_heldout_images,
    compare_heldout_surfaces,
    compare_labelled_surfaces,
    compare_matched_surfaces,
    compare_novel_poses,
    compare_novel_views,
    compare_rest_surfaces,
    compare_shown_surface,
    compare_texture,
)
from data_tools.evaluate.comparison import Comparison, ImagePair, load_comparison
from data_tools.evaluate.files import TRUTH_VERSION, save_comparison
from data_tools.synthetic.scene.renderer import FLAT
from data_tools.templates import render_template
from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.core.manifest import read_manifest
from pipeline.metrics.images import (
    composite_on_white,
    composite_premultiplied_on_white,
    foreground_bounding_box,
    foreground_mask,
    mean_scores,
)
from pipeline.report.page import error_map, format_metric, image_tag, metric_table, metric_tile
from pipeline.report.report_json import replace_nonfinite
from pipeline.report.templates import read_asset

PROTOCOL = (
    "Surfaces: before a comparison, the surface of the avatar is aligned to the true surface by rotation, "
    "translation and one scale (scale_to_truth), from iterated closest points in both directions. Distances are "
    "from 20,000 points per surface to the nearest triangle of the other, without faces that are invisible from "
    "outside in the A-pose. normal_angle_deg: angle to the nearest face within 30 mm whose normal is less than 90 "
    "degrees away, mean of both directions; 90 where there is none. far_area_share: share of the avatar's area farther "
    "than 30 mm from the truth. chamfer_unaligned_mm: without alignment and scale, see stature_mm. mesh: A-pose of the "
    "true rig, unaligned standing on the same floor; heldout_poses: held-out frames, each rig in its own pose, "
    "unaligned where its camera sees it; novel_poses: both rigs in poses that the video does not contain, unaligned "
    "with the hips in the same place. In mesh and novel_poses the limbs of both rigs have equal directions; rigs that "
    "place hips, shoulders or ankles differently then differ although their surfaces do not. In mesh_matched and "
    "novel_poses_matched, and in the images of novel views and poses, the rotation of each joint is corrected by the "
    "mean rotation between the two rigs over the frames of the video. mesh_matched_shown: mesh_matched on the part of "
    "the truth that a frame of the video shows (area_share), not the inside of a coat or legs under a skirt. "
    "surface_by_label: the A-pose, on the faces of one garment or body part of the "
    "truth and the points of the avatar nearest to them; area_share of the truth. Joints: after aligning the root, and "
    "without alignment. Images: field and mesh are the held-out scores of the report. upper_bound is the true "
    "mesh and texture with true lighting, rendered in the refined poses by the estimated camera on the same frames,"
    " with the same edge blur as the mesh: its error is the error of poses and camera that no other A-pose shape "
    "can compensate. Squared error prefers a blurred texture to a sharp one at the wrong position, so a blurred "
    "avatar may score higher. These columns use the masks of the frames stage, so parts that are missing in a mask "
    "cost nothing; the columns true_mask use the true masks, and meshes with sharp edges. novel_views and "
    "novel_poses: the avatar in the true poses, aligned to the true surface and rendered by the true cameras, "
    "under the light that was removed from its texture, if any. Their columns ceiling are the true mesh in the same "
    "poses with its best static texture: the true "
    "one times the mean brightness of each vertex in the training frames. colour_error and balanced_colour_error "
    "(after one gain per channel) are mean absolute differences, of 255, on the observed texels."
)
SURFACES = ("mesh", "mesh_matched", "mesh_matched_shown", "heldout_poses", "novel_poses", "novel_poses_matched")
LIT_NOTE = (
    "not flat: the novel views and poses of this capture are lit. The avatar is drawn under the estimated light if "
    "that was removed from its texture, else unlit, and then its light counts against it (--light flat has none)"
)


def write_comparison(out: Path, run_dir: Path, measured: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Compare a finished run with the ground truth, write its folder `compare/`, and return the document.

    Args:
        out: folder of the synthetic capture.
        measured: sections that are already computed (masks, body).

    Raises:
        UserError: the report is not finished.
    """
    report = read_manifest(run_dir / "report")
    if report is None:
        raise UserError(f"{run_dir / 'report'} is not finished; run {format_command('--run', run_dir)}")
    heldout = json.loads((run_dir / "report" / "report.json").read_text(encoding="utf-8"))["heldout"]
    sections, image_pairs = avatar_sections(load_comparison(out, run_dir))
    report_scores = {name: heldout[name] for name in ("field", "mesh")}
    document = replace_nonfinite(
        {
            "version": TRUTH_VERSION,
            "protocol": PROTOCOL,
            **measured,
            **sections,
            "images": report_scores | sections["images"],
        }
    )
    page = comparison_page(run_dir.resolve().name, document, image_pairs)
    save_comparison(run_dir, document, page, report.fingerprint)
    return document


def avatar_sections(comparison: Comparison) -> tuple[dict[str, Any], dict[str, list[ImagePair]]]:
    """Compute all sections that need a finished avatar, and the image pairs of novel views, novel poses and clay."""
    document: dict[str, Any] = {
        "mesh": compare_rest_surfaces(comparison),
        "mesh_matched": compare_matched_surfaces(comparison),
        "mesh_matched_shown": compare_shown_surface(comparison),
        "heldout_poses": compare_heldout_surfaces(comparison),
    }
    if parts := compare_labelled_surfaces(comparison):
        document["surface_by_label"] = parts
    images = compare_heldout_images(comparison)
    image_pairs = {}
    if (comparison.folder / "novel_poses").is_dir():
        surfaces, image_pairs["novel_poses"] = compare_novel_poses(comparison)
        document |= surfaces
    if (comparison.folder / "novel_views").is_dir():
        image_pairs["novel_views"] = compare_novel_views(comparison)
    images |= {name: mean_scores(image_pair.scores() for image_pair in row) for name, row in image_pairs.items()}
    images |= compare_ceiling(comparison)
    image_pairs["clay"] = compare_clay(comparison)
    document["light"] = "flat" if comparison.truth.light == FLAT else LIT_NOTE
    return document | {"texture": compare_texture(comparison), "images": images}, image_pairs


def comparison_page(title: str, document: Mapping[str, Any], image_pairs: Mapping[str, Sequence[ImagePair]]) -> str:
    """Render the HTML page, in the style of the report."""
    surfaces = {name: document[name] for name in SURFACES if name in document}
    tables = [metric_table("Surfaces", surfaces)]
    if "surface_by_label" in document:
        tables.append(metric_table("Surface of each part, A-pose", document["surface_by_label"]))
    tables.append(metric_table("Images", document["images"]))
    tables += [
        metric_table(name.capitalize(), {"": document[name]})
        for name in ("masks", "body", "texture")
        if name in document
    ]
    return render_template(
        "data_tools.evaluate",
        "comparison.html.j2",
        title=title,
        style=read_asset("report.css"),
        protocol=f"{document['protocol']} Light of the capture: {document['light']}.",
        tiles=[metric_tile(*texts) for texts in _headline_metrics(document)],
        tables=tables,
        image_rows=[
            (name.replace("_", " "), _row_images(name.replace("_", " "), row)) for name, row in image_pairs.items()
        ],
    )


def _headline_metrics(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return (value, unit, label) of each tile."""
    mesh, images = document["mesh"], document["images"]
    return [
        (format_metric(mesh["chamfer_mm"]), "mm", "Chamfer distance, A-pose"),
        (format_metric(mesh["f_score"]), "", "F-score at 5 mm"),
        (format_metric(mesh["normal_angle_deg"]), "°", "mean angle between normals"),
        (format_metric(images["mesh"]["psnr_body"]), "dB", "mesh, held-out frames, body pixels"),
        (format_metric(images["upper_bound"]["psnr_body"]), "dB", "upper bound: true mesh in the estimated poses"),
    ]


def _row_images(title: str, image_pairs: Sequence[ImagePair]) -> list[tuple[str, str]]:
    """Return caption and image element of truth, avatar and error map, cropped to the person."""
    images: list[tuple[str, str]] = []
    for number, image_pair in enumerate(image_pairs):
        box = foreground_bounding_box(foreground_mask(image_pair.truth[..., 3]))
        truth = composite_on_white(image_pair.truth[..., :3], image_pair.truth[..., 3])[box]
        avatar = composite_premultiplied_on_white(image_pair.avatar)[box]
        for kind, pixels in (("truth", truth), ("avatar", avatar), ("error", error_map(avatar, truth))):
            images.append((f"{number}, {kind}", image_tag(pixels, f"{title} {number}, {kind}")))
    return images
