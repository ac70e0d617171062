"""`report/truth.json` and `report/truth.html`: all that a comparison with the truth found, on one page."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

from data_tools.evaluate.compare_avatar import (
    Comparison,
    ImagePair,
    compare_heldout_images,
    compare_heldout_surfaces,
    compare_novel_poses,
    compare_novel_views,
    compare_rest_surfaces,
    compare_texture,
    load_comparison,
)
from data_tools.evaluate.files import TRUTH_FILES, TRUTH_VERSION
from pipeline.core.atomic import atomic_path
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE, digest_file, read_manifest, write_manifest
from pipeline.metrics.images import (
    composite_on_white,
    composite_premultiplied_on_white,
    foreground_bounding_box,
    foreground_mask,
    mean_scores,
)
from pipeline.report.page import error_map, format_metric, image_tag, metric_table, metric_tile, read_asset
from pipeline.report.report_json import replace_nonfinite

PROTOCOL = (
    "Surfaces are laid over the truth by rotation, shift and one scale, found by iterated closest points in both "
    "directions, before they are compared (20,000 points a surface, nearest triangle, without faces that cannot be "
    "seen from outside in the A-pose): mesh in the true rig's A-pose, filmed in some held-out frames, each rig in its "
    "own pose, novel_poses while both rigs do a motion that was never filmed. scale_to_truth is that scale. Joints "
    "are compared root-aligned and absolute, without any other alignment. Pictures: field and mesh are the held-out "
    "rows of the report. ceiling is the true mesh and texture, truly lit, drawn in the refined poses by the fitted "
    "camera, on the same frames with outlines as soft as the mesh's: what is missing there is the fault of pose and "
    "camera, after all that another shape of the A-pose could make good. Squared error prefers a blur to a sharp print "
    "in the wrong place, so a blurred avatar may score above it. Those rows cut the frames out by the mask that the "
    "pipeline found, so that what it leaves out costs nothing; the rows named true_mask cut them out by the true one, "
    "meshes with sharp outlines. novel_views and novel_poses are the avatar whose limbs point where the true ones do, "
    "laid over the true surface and seen by the true cameras, unlit while the truth is lit. colour_error and "
    "balanced_colour_error (one gain a channel) are mean absolute differences of 255 on the texels that the video "
    "showed."
)
STYLE = ".frame { grid-template-columns: repeat(6, 1fr); }"


def write_comparison(out: Path, run: Path, found: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Compare the finished avatar, write the two files into the run's report, and return the document.

    Args:
        out: the synthetic capture. found: sections that were measured before (masks, body).

    Raises:
        UserError: the report is not finished.
    """
    report = run / "report"
    manifest = read_manifest(report)
    if manifest is None:
        raise UserError(f"{report} is not finished; run python -m stages --run {run}")
    heldout = json.loads((report / "report.json").read_text(encoding="utf-8"))["heldout"]
    document, pictures = avatar_sections(load_comparison(out, run))
    report_scores = {name: heldout[name] for name in ("field", "mesh")}
    document = replace_nonfinite(
        {
            "version": TRUTH_VERSION,
            "protocol": PROTOCOL,
            **found,
            **document,
            "images": report_scores | document["images"],
        }
    )
    page = comparison_page(run.resolve().name, document, pictures)
    for name, text in zip(TRUTH_FILES, (page, json.dumps(document, indent=2, allow_nan=False) + "\n"), strict=True):
        with atomic_path(report / name) as path:
            path.write_text(text, encoding="utf-8")
    outputs = manifest.outputs | {name: digest_file(report / name) for name in TRUTH_FILES}
    with atomic_path(report / MANIFEST_FILE) as path:  # so that --verify knows the two files
        write_manifest(replace(manifest, outputs=outputs), path)
    return document


def avatar_sections(comparison: Comparison) -> tuple[dict[str, Any], dict[str, list[ImagePair]]]:
    """All sections that need a finished avatar, and the pictures of held-out cameras and motions."""
    document: dict[str, Any] = {
        "mesh": compare_rest_surfaces(comparison),
        "heldout_poses": compare_heldout_surfaces(comparison),
    }
    images = compare_heldout_images(comparison)
    pictures = {}
    if (comparison.folder / "novel_poses").is_dir():
        document["novel_poses"], pictures["novel_poses"] = compare_novel_poses(comparison)
    if (comparison.folder / "novel_views").is_dir():
        pictures["novel_views"] = compare_novel_views(comparison)
    images |= {name: mean_scores(picture.scores() for picture in row) for name, row in pictures.items()}
    return document | {"texture": compare_texture(comparison), "images": images}, pictures


def comparison_page(title: str, document: Mapping[str, Any], pictures: Mapping[str, Sequence[ImagePair]]) -> str:
    """The whole HTML text, in the style of the report."""
    surfaces = {name: document[name] for name in ("mesh", "heldout_poses", "novel_poses") if name in document}
    tables = [metric_table("Surfaces against truth", surfaces), metric_table("Pictures", document["images"])]
    tables += [
        metric_table(name.capitalize(), {"": document[name]})
        for name in ("masks", "body", "texture")
        if name in document
    ]
    rows = "".join(_row(name.replace("_", " "), row) for name, row in pictures.items())
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}: truth</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<style>{read_asset('report.css')}{STYLE}</style></head><body><header><h1>{escape(title)} against "
        "its truth</h1>"
        f'<p class="lead">The rest is in <a href="index.html">the report</a>.</p></header><main>'
        f'<section class="tiles">{"".join(metric_tile(*texts) for texts in _headline(document))}</section>'
        f'<section><h2>All figures</h2><p class="note">{escape(document["protocol"])}</p>'
        f'<div class="tables">{"".join(tables)}</div></section><section><h2>Held-out cameras and motions</h2>{rows}'
        f"</section></main></body></html>\n"
    )


def _headline(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(value, unit, label) of each tile."""
    mesh, images = document["mesh"], document["images"]
    return [
        (format_metric(mesh["chamfer_mm"]), "mm", "Chamfer distance, A-pose"),
        (format_metric(mesh["f_score"]), "", "F-score at 5 mm"),
        (format_metric(mesh["normal_angle_deg"]), "°", "normals, mean"),
        (format_metric(images["mesh"]["psnr_body"]), "dB", "mesh, held out, body pixels"),
        (format_metric(images["upper_bound"]["psnr_body"]), "dB", "true mesh in the fitted poses"),
    ]


def _row(title: str, pictures: Sequence[ImagePair]) -> str:
    """Truth, avatar and error of each picture, cropped to the person."""
    figures = []
    for number, image_pair in enumerate(pictures):
        box = foreground_bounding_box(foreground_mask(image_pair.truth[..., 3]))
        truth = composite_on_white(image_pair.truth[..., :3], image_pair.truth[..., 3])[box]
        avatar = composite_premultiplied_on_white(image_pair.avatar)[box]
        for caption, pixels in (("truth", truth), ("avatar", avatar), ("error", error_map(avatar, truth))):
            image = image_tag(pixels, f"{title} {number}, {caption}")
            figures.append(f"<figure>{image}<figcaption>{number}, {caption}</figcaption></figure>")
    return f'<div class="card frame"><h3>{escape(title.capitalize())}</h3>{"".join(figures)}</div>'
