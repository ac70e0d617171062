"""The report as one HTML file: pictures, charts and the 3D viewer inside, nothing fetched from anywhere."""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.report.charts import bar_chart, legend, line_chart
from pipeline.report.embed import compress_glb_textures, webp_data_uri
from pipeline.report.report_json import POSE_FITTED_SUFFIX

ASSETS_DIR = Path(__file__).parent / "assets"
ERROR_MAP_MAX_LEVELS = 64
"""Mean absolute difference, in steps of 255, that the error maps show in their brightest colour."""

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
    """What the page shows.

    report: the document of report.json.
    frames: held-out frames to show; `turntable`: title and views (RGBA, all of one height, evenly spread over a full
    turn) of each row; `pictures`: caption and image.
    """

    title: str
    report: Mapping[str, Any]
    frames: Sequence[FrameImages]
    turntable: Sequence[tuple[str, Sequence[UInt8[np.ndarray, "_ _ 4"]]]]
    pictures: Sequence[tuple[str, UInt8[np.ndarray, "_ _ 3"]]]
    glb: bytes


def render_page(content: PageContent) -> str:
    """The whole HTML text."""
    report = content.report
    return Template(read_asset("report.html")).substitute(
        title=escape(content.title),
        lead=escape(_summary_text(report)),
        style=read_asset("report.css"),
        tiles="".join(metric_tile(*texts) for texts in _headline_metrics(report)),
        warnings=_warnings(report["warnings"]),
        turntable="".join(_turntable_row(title, views) for title, views in content.turntable),
        protocol=escape(f"{report['heldout']['protocol']} LPIPS: {report['heldout']['lpips']}.") + _scale_note(),
        frames="".join(_frame_row(frame, report) for frame in content.frames),
        error_charts=_error_charts(report["heldout"]["frames"]),
        cost_charts=_cost_charts(report),
        pictures="".join(_image_figure(caption, pixels) for caption, pixels in content.pictures),
        tables=_tables(report),
        footer=escape(_footer(report["environment"])),
        glb=base64.b64encode(compress_glb_textures(content.glb)).decode(),
        viewer_script=read_asset("viewer.min.js"),
        page_script=read_asset("report.js"),
    )


def error_map(a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Mean absolute difference of the channels in the magma colours: black is equal, bright is ERROR_RANGE and more."""
    difference = np.abs(a.astype(np.float32) - b).mean(axis=2)
    steps = np.clip(difference * (255.0 / ERROR_MAP_MAX_LEVELS), 0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(steps, cv2.COLORMAP_MAGMA), cv2.COLOR_BGR2RGB)


def format_metric(value: object) -> str:
    """A figure of the report for people: at most four significant digits, yes or no for truth values."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _summary_text(report: Mapping[str, Any]) -> str:
    seconds = report["seconds"]["total"]
    spent = f"{seconds / 60:.1f} minutes" if seconds >= 90 else f"{seconds:.0f} seconds"
    return (
        f"{report['masks']['count']} frames of one person became a textured, rigged mesh of "
        f"{report['mesh']['faces']:,} triangles in {spent}."
    )


def _headline_metrics(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(value, unit, label) of each tile."""
    field, mesh, health = report["heldout"]["field"], report["heldout"]["mesh"], report["mesh"]
    whole = "watertight, manifold" if health["watertight"] and health["manifold"] else "not watertight or not manifold"
    return [
        (_format_db(mesh["psnr_full"]), "dB", "mesh, full held-out image"),
        (_format_db(mesh["psnr_body"]), "dB", "mesh, body pixels alone"),
        (_format_db(field["psnr_full"]), "dB", "field, full held-out image"),
        (_format_db(field["psnr_body"]), "dB", "field, body pixels alone"),
        (format_metric(mesh["ssim_full"]), "SSIM", "mesh, full held-out image"),
        (format_metric(report["body"]["silhouette_iou"]), "IoU", "body against the masks"),
        (f"{health['faces']:,}", "faces", whole),
        (f"{report['seconds']['total']:.0f}", "s", "all stages"),
        (f"{max(report['peak_rss_mib'].values()):,.0f}", "MiB", "peak memory"),
        (f"{report['export']['glb_bytes'] / 1e6:.1f}", "MB", "avatar.glb"),
    ]


def _format_db(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"


def metric_tile(value: str, unit: str, label: str) -> str:
    """One large figure."""
    return f'<div class="tile"><b>{escape(value)} <small>{escape(unit)}</small></b><span>{escape(label)}</span></div>'


def _warnings(messages: Sequence[str]) -> str:
    if not messages:
        return ""
    return f'<div class="warnings"><ul>{"".join(f"<li>{escape(message)}</li>" for message in messages)}</ul></div>'


def _turntable_row(title: str, views: Sequence[UInt8[np.ndarray, "_ _ 4"]]) -> str:
    degrees = (round(360 * number / len(views)) for number in range(len(views)))
    images = [
        f'<span style="flex:{view.shape[1] / view.shape[0]:.3f}">{image_tag(view, f"{title}, {angle} degrees")}</span>'
        for view, angle in zip(views, degrees, strict=True)
    ]
    half = (len(images) + 1) // 2
    rows = "".join(f"<div>{''.join(part)}</div>" for part in (images[:half], images[half:]))
    return f'<div class="card turntable"><h3>{escape(title)}</h3>{rows}</div>'


def _scale_note() -> str:
    return f' Error maps: <i class="scale"></i> 0 to {ERROR_MAP_MAX_LEVELS} of 255 and more, mean over channels.'


def _frame_row(frame: FrameImages, report: Mapping[str, Any]) -> str:
    scores = next(row for row in report["heldout"]["frames"] if row["index"] == frame.index)
    pictures = [
        ("video", "video", frame.video),
        ("field", "field", frame.field),
        ("mesh", "textured mesh", frame.mesh),
        ("field-error", "error of the field", error_map(frame.field, frame.video)),
        ("mesh-error", "error of the mesh", error_map(frame.mesh, frame.video)),
    ]
    figures = "".join(
        f"<figure>{image_tag(pixels, f'frame {frame.index}, {caption}', kind)}"
        f"<figcaption>{caption}</figcaption></figure>"
        for kind, caption, pixels in pictures
    )
    values = "".join(
        f"<span>{name} {_format_db(scores[name]['psnr_full'])} dB, body "
        f"{_format_db(scores[name]['psnr_body'])} dB</span>"
        for name in ("field", "mesh")
    )
    return f'<div class="card frame" data-frame="{frame.index}"><h3>Frame {frame.index} {values}</h3>{figures}</div>'


def _error_charts(frames: Sequence[Mapping[str, Any]]) -> str:
    charts = []
    for score, title in (("psnr_full", "PSNR, full image on white"), ("psnr_body", "PSNR, body pixels")):
        series = {
            name: [(float(row["index"]), math.nan if row[name][score] is None else row[name][score]) for row in frames]
            for name in ("field", "mesh")
        }
        chart = line_chart(series, "frame of the video", "dB")
        charts.append(f'<div class="card"><h3>{title} (dB)</h3>{legend(list(series))}{chart}</div>')
    return "".join(charts)


def _cost_charts(report: Mapping[str, Any]) -> str:
    charts = []
    for key, title, unit in (("seconds", "Time a stage", "s"), ("peak_rss_mib", "Peak memory a stage", "MiB")):
        rows = [(stage, float(value)) for stage, value in report[key].items() if stage != "total"]
        charts.append(f'<div class="card"><h3>{title}</h3>{bar_chart(rows, unit)}</div>')
    return "".join(charts)


def _image_figure(caption: str, pixels: UInt8[np.ndarray, "h w 3"]) -> str:
    scale = MAX_IMAGE_PX / max(pixels.shape[:2])
    if scale < 1.0:
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return f'<figure class="card">{image_tag(pixels, caption)}<figcaption>{escape(caption)}</figcaption></figure>'


def image_tag(pixels: UInt8[np.ndarray, "h w c"], alt: str, kind: str | None = None) -> str:
    """A picture inside the page."""
    mark = f' data-kind="{kind}"' if kind else ""
    height, width = pixels.shape[:2]
    return f'<img src="{webp_data_uri(pixels)}" alt="{escape(alt)}" width="{width}" height="{height}"{mark}>'


def _tables(report: Mapping[str, Any]) -> str:
    renders = {name: scores for name, scores in report["heldout"].items() if isinstance(scores, Mapping)}
    pose_fitted = {name: scores for name, scores in renders.items() if name.endswith(POSE_FITTED_SUFFIX)}
    held_out = {name: scores for name, scores in renders.items() if name not in pose_fitted}
    tables = [metric_table("Held-out frames", held_out)]
    tables += [metric_table("Poses fitted to these frames: not held out", pose_fitted)] if pose_fitted else []
    tables += [metric_table(name.capitalize(), {"": report[name]}) for name in ("mesh", "body", "export", "masks")]
    return "".join(tables)


def metric_table(title: str, columns: Mapping[str, Mapping[str, object]]) -> str:
    """A card with a row for each figure of the first column, and a column for each of `columns`; one nameless column
    has no heading."""
    names = next(iter(columns.values()))
    head = "".join(f"<td>{escape(name.replace('_', ' '))}</td>" for name in columns)
    lines = [f"<tr><th></th>{head}</tr>"] if any(columns) else []
    for name in names:
        cells = "".join(f"<td>{escape(format_metric(column.get(name)))}</td>" for column in columns.values())
        lines.append(f"<tr><th>{escape(name)}</th>{cells}</tr>")
    return f'<div class="card"><h3>{escape(title)}</h3><table>{"".join(lines)}</table></div>'


def _footer(environment: Mapping[str, Any]) -> str:
    parts = [f"{environment[name]}" for name in ("cpu", "gpu") if environment.get(name)]
    if environment.get("cores"):
        parts.append(f"{environment['cores']} cores")
    parts += [f"{name} {environment[name]}" for name in ("python", "commit") if environment.get(name)]
    return " · ".join(parts)


def read_asset(name: str) -> str:
    """Text of a template, style or script."""
    return (ASSETS_DIR / name).read_text(encoding="utf-8")
