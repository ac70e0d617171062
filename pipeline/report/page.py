"""The report as one HTML file that contains its images, charts and 3D viewer and loads nothing from a network."""

import base64
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup

from pipeline.report.charts import bar_chart, legend, line_chart
from pipeline.report.embed import compress_glb_textures, coverage_data_uri, webp_data_uri
from pipeline.report.report_json import POSE_FITTED_SUFFIX
from pipeline.report.templates import read_asset, render_macro, render_template

ERROR_MAP_MAX_LEVELS = 64
"""Mean absolute difference, in levels of 255, that error maps show in their brightest colour."""

MAX_IMAGE_PX = 1600


@dataclass(frozen=True)
class FrameImages:
    """One held-out frame on white, cropped to the person, and its two renders; all of one size."""

    index: int
    video: UInt8[np.ndarray, "h w 3"]
    field: UInt8[np.ndarray, "h w 3"]
    mesh: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class PageContent:
    """The data of the page.

    report: the document of report.json.
    frames: held-out frames to show.
    turntable: for each row its title and its views, RGBA of one height, evenly spaced over a full turn.
    images: caption and pixels of further images.
    glb: the bytes of avatar.glb.
    levels: the bytes of coarser levels of detail, finest first.
    coverage: confidence that the video shows a texel; row 0 is v = 1.
    """

    title: str
    report: Mapping[str, Any]
    frames: Sequence[FrameImages]
    turntable: Sequence[tuple[str, Sequence[UInt8[np.ndarray, "_ _ 4"]]]]
    images: Sequence[tuple[str, UInt8[np.ndarray, "_ _ 3"]]]
    glb: bytes
    levels: Sequence[bytes] = ()
    coverage: UInt8[np.ndarray, "th tw"] | None = None


def render_page(content: PageContent) -> str:
    """Return the HTML text of the report page; pictures are encoded side by side."""
    report = content.report
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        turntable = list(pool.map(lambda row: (row[0], _turntable_rows(*row)), content.turntable))
        frames = list(pool.map(partial(_frame_card, report=report), content.frames))
        images = list(pool.map(lambda each: (image_tag(_shrunk(each[1]), each[0]), each[0]), content.images))
    return render_template(
        "report.html.j2",
        title=content.title,
        summary=_summary_text(report),
        style=Markup(read_asset("report.css")),
        headline=_headline_metrics(report),
        warnings=report["warnings"],
        turntable=turntable,
        protocol=f"{report['heldout']['protocol']} LPIPS: {report['heldout']['lpips']}.",
        error_map_max_levels=ERROR_MAP_MAX_LEVELS,
        frames=frames,
        error_charts=_error_charts(report["heldout"]["frames"]),
        cost_charts=_cost_charts(report),
        images=images,
        modelled=report["modelled"],
        risks=report["risks"],
        tables=_tables(report),
        footer=_footer(report["environment"]),
        glb=_embedded_glb(content.glb),
        levels=[_embedded_glb(level) for level in content.levels],
        coverage=None if content.coverage is None else coverage_data_uri(content.coverage),
        viewer_script=Markup(read_asset("viewer.min.js")),
        page_script=Markup(read_asset("report.js")),
    )


def _embedded_glb(glb: bytes) -> Markup:
    return Markup(base64.b64encode(compress_glb_textures(glb)).decode())


def error_map(a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the mean absolute difference of the channels in magma colours, RGB.

    Black is no difference; the brightest colour is `ERROR_MAP_MAX_LEVELS` levels of 255 and more.
    """
    difference = np.abs(a.astype(np.float32) - b).mean(axis=2)
    steps = np.clip(difference * (255.0 / ERROR_MAP_MAX_LEVELS), 0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(steps, cv2.COLORMAP_MAGMA), cv2.COLOR_BGR2RGB)


def format_metric(value: object) -> str:
    """Format a metric: at most four significant digits, yes or no for booleans, a dash for None."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def metric_tile(value: str, unit: str, label: str) -> Markup:
    """Return one large number with its unit and label."""
    return render_macro("metric_tile", value, unit, label)


def image_tag(pixels: UInt8[np.ndarray, "h w c"], alt: str, kind: str | None = None) -> Markup:
    """Return an `img` element that contains an RGB or RGBA image. kind: value of its `data-kind` attribute."""
    height, width = pixels.shape[:2]
    return render_macro("image_tag", webp_data_uri(pixels), alt, width, height, kind)


def metric_table(title: str, columns: Mapping[str, Mapping[str, object]]) -> Markup:
    """Return a card with one row for each metric of the first column and one column for each of `columns`.

    A single column without a name gets no heading.
    """
    headings = [name.replace("_", " ") for name in columns] if any(columns) else []
    names = next(iter(columns.values()))
    rows = [(name, [format_metric(column.get(name)) for column in columns.values()]) for name in names]
    return render_macro("metric_table", title, headings, rows)


def _summary_text(report: Mapping[str, Any]) -> str:
    seconds = report["seconds"]["total"]
    duration = f"{seconds / 60:.1f} minutes" if seconds >= 90 else f"{seconds:.0f} seconds"
    made = (
        f"A textured, rigged mesh of {report['mesh']['faces']:,} triangles, reconstructed from "
        f"{report['masks']['count']} frames of one person in {duration}."
    )
    return f"{made} {report['template']}" if report.get("template") else made


def _headline_metrics(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return (value, unit, label) of each tile."""
    field, mesh, health = report["heldout"]["field"], report["heldout"]["mesh"], report["mesh"]
    closed = "watertight, manifold" if health["watertight"] and health["manifold"] else "not watertight or not manifold"
    return [
        (_format_db(mesh["psnr_full"]), "dB", "mesh, full held-out image"),
        (_format_db(mesh["psnr_body"]), "dB", "mesh, body pixels"),
        (_format_db(field["psnr_full"]), "dB", "field, full held-out image"),
        (_format_db(field["psnr_body"]), "dB", "field, body pixels"),
        (format_metric(mesh["ssim_full"]), "SSIM", "mesh, full held-out image"),
        (format_metric(report["body"]["silhouette_iou"]), "IoU", "fitted body with clothes, and masks"),
        (f"{health['faces']:,}", "faces", closed),
        (f"{report['seconds']['total']:.0f}", "s", "all stages"),
        (f"{max(report['peak_rss_mib'].values()):,.0f}", "MiB", "peak memory"),
        (f"{report['export']['glb_bytes'] / 1e6:.1f}", "MB", "avatar.glb"),
    ]


def _format_db(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"


def _turntable_rows(title: str, views: Sequence[UInt8[np.ndarray, "_ _ 4"]]) -> list[list[tuple[Markup, str]]]:
    """Return the views in two rows, each as (image, aspect ratio)."""
    degrees = (round(360 * number / len(views)) for number in range(len(views)))
    cells = [
        (image_tag(view, f"{title}, {angle} degrees"), f"{view.shape[1] / view.shape[0]:.3f}")
        for view, angle in zip(views, degrees, strict=True)
    ]
    half = (len(cells) + 1) // 2
    return [cells[:half], cells[half:]]


def _frame_card(frame: FrameImages, report: Mapping[str, Any]) -> dict[str, Any]:
    scores = next(row for row in report["heldout"]["frames"] if row["index"] == frame.index)
    images = [
        ("video", "video", frame.video),
        ("field", "field", frame.field),
        ("mesh", "textured mesh", frame.mesh),
        ("field-error", "error of the field", error_map(frame.field, frame.video)),
        ("mesh-error", "error of the mesh", error_map(frame.mesh, frame.video)),
    ]
    return {
        "index": frame.index,
        "scores": [
            f"{name} {_format_db(scores[name]['psnr_full'])} dB, body {_format_db(scores[name]['psnr_body'])} dB"
            for name in ("field", "mesh")
        ],
        "images": [
            (image_tag(pixels, f"frame {frame.index}, {caption}", kind), caption) for kind, caption, pixels in images
        ],
    }


def _error_charts(frames: Sequence[Mapping[str, Any]]) -> list[tuple[str, Markup, Markup]]:
    """Return (title, legend, chart) of each score over the video."""
    charts = []
    for score, title in (("psnr_full", "PSNR, full image on white (dB)"), ("psnr_body", "PSNR, body pixels (dB)")):
        series = {
            name: [(float(row["index"]), math.nan if row[name][score] is None else row[name][score]) for row in frames]
            for name in ("field", "mesh")
        }
        charts.append((title, legend(list(series)), line_chart(series, "frame of the video", "dB")))
    return charts


def _cost_charts(report: Mapping[str, Any]) -> list[tuple[str, Markup]]:
    charts = []
    for key, title, unit in (("seconds", "Time per stage", "s"), ("peak_rss_mib", "Peak memory per stage", "MiB")):
        rows = [(stage, float(value)) for stage, value in report[key].items() if stage != "total"]
        charts.append((title, bar_chart(rows, unit)))
    return charts


def _shrunk(pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    scale = MAX_IMAGE_PX / max(pixels.shape[:2])
    if scale >= 1.0:
        return pixels
    height, width = pixels.shape[:2]
    return cv2.resize(pixels, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)


def _tables(report: Mapping[str, Any]) -> list[Markup]:
    renders = {name: scores for name, scores in report["heldout"].items() if isinstance(scores, Mapping)}
    pose_fitted = {name: scores for name, scores in renders.items() if name.endswith(POSE_FITTED_SUFFIX)}
    held_out = {name: scores for name, scores in renders.items() if name not in pose_fitted}
    tables = [metric_table("Held-out frames", held_out)]
    tables += [metric_table("Poses fitted to these frames: not held out", pose_fitted)] if pose_fitted else []
    return tables + [
        metric_table(name.capitalize(), {"": report[name]}) for name in ("mesh", "body", "export", "masks")
    ]


def _footer(environment: Mapping[str, Any]) -> str:
    parts = [f"{environment[name]}" for name in ("cpu", "gpu") if environment.get(name)]
    if environment.get("cores"):
        parts.append(f"{environment['cores']} cores")
    parts += [f"{name} {environment[name]}" for name in ("python", "commit") if environment.get(name)]
    return " · ".join(parts)
