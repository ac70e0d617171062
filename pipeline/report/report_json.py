"""The document of report.json: what all stages cost and how good the result is, for programs and for the page."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest
from pipeline.metrics.images import mean_scores
from pipeline.metrics.lpips import MIN_SIDE_PX
from pipeline.report.lpips_weights import WEIGHTS_MISSING_NOTE as LPIPS_ABSENT

PROTOCOL = (
    "{count} frames, those that the video's split.json names or else those whose index in the video is divisible by "
    "eight, were held out: field, mesh and texture never saw their pixels, and nothing of them was decided on these. "
    "Their poses are fitted to landmarks and outline, never to their colours: the body stage finds the pose of every "
    "frame, and the one shape and camera, from the landmarks and the masks of all frames, held-out ones too; the "
    "field's corrections of the poses are interpolated in time between training frames and held beyond them. Frames "
    "are laid over white by the mask that the frames stage found, so that what it leaves out costs nothing, renders by "
    "their own coverage, both rounded to 8 bits. Of psnr, ssim and flip (67 "
    "pixels a degree, lower is better), _full counts the whole image, _body the pixels of the mask, _box the smallest "
    "box around it; each is the mean over frames. field is the radiance field, mesh the exported mesh with its "
    "diffuse map, unlit, its outline blurred until it is as soft as the masks (masks.edge_spread_px, measured on "
    "frames that are not scored); mesh_sharp is the mesh as square pixels give it."
)
UNREFINED_NOTE = " The rows named unrefined use the body stage's poses alone."
LPIPS_NOTE = (
    "AlexNet, version 0.1, full image on white, colours scaled to [-1, 1] as its authors' code wants them. "
    "InstantAvatar's evaluation gives it colours in [0, 1], so LPIPS published after that do not compare"
)
LPIPS_MISSING_NOTE = f"{LPIPS_ABSENT}; frames with a side below {MIN_SIDE_PX} px have none either way"
POSE_FITTED_SUFFIX = "_pose_fitted"
POSE_FITTED_NOTE = (
    " The rows named pose_fitted are no held-out scores: there the pose of each frame was fitted to that frame's own "
    "image and mask through the mesh. They say how much of the error is the pose's."
)


def build_report(
    manifests: Mapping[str, Manifest],
    frames: Sequence[Mapping[str, Any]],
    metric_sections: Mapping[str, Mapping[str, float | int | bool]],
    environment: Mapping[str, Any],
    cost: tuple[float, float],
) -> dict[str, Any]:
    """Everything the report says.

    Args:
        manifests: of the stages before the report, in order.
        frames: a row a held-out frame, `index` and the scores of each render by name.
        figures: sections that the report measures: `mesh` (health), `export` (glb_bytes, texture_px), `masks` (count).
        cost: the report's own seconds and peak memory (MiB) until now.

    Raises:
        UserError: the body stage's manifest lacks a figure.
    """
    seconds = {name: manifest.seconds for name, manifest in manifests.items()} | {"report": round(cost[0], 3)}
    peaks = {name: manifest.peak_rss_mib for name, manifest in manifests.items()} | {"report": round(cost[1], 1)}
    renders = [name for name in frames[0] if name != "index"]
    protocol = PROTOCOL.format(count=len(frames))
    protocol += UNREFINED_NOTE * any(name.endswith("_unrefined") for name in renders)
    protocol += POSE_FITTED_NOTE * any(name.endswith(POSE_FITTED_SUFFIX) for name in renders)
    has_lpips = "lpips_full" in frames[0][renders[0]]
    return {
        "seconds": seconds | {"total": round(sum(seconds.values()), 3)},
        "peak_rss_mib": peaks | {"total": max(peaks.values())},
        "heldout": {name: mean_scores([row[name] for row in frames]) for name in renders}
        | {
            "protocol": protocol,
            "lpips": LPIPS_NOTE if has_lpips else LPIPS_MISSING_NOTE,
            "frames": list(frames),
        },
        **{name: dict(section) for name, section in metric_sections.items()},
        "body": {name: _manifest_metric(manifests["body"], name) for name in ("landmark_error_px", "silhouette_iou")},
        "stages": {name: dict(manifest.metrics) for name, manifest in manifests.items()},
        "warnings": [f"{name}: {text}" for name, manifest in manifests.items() for text in manifest.warnings],
        "environment": {name: value for name, value in environment.items() if name != "packages"},
    }


def report_to_json(report: Mapping[str, Any]) -> str:
    """JSON text of the document; a figure that is not finite (the PSNR of equal images) becomes null."""
    return json.dumps(replace_nonfinite(report), indent=2, allow_nan=False) + "\n"


def replace_nonfinite(value: Any) -> Any:
    """The same document with None in place of infinities and NaN."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: replace_nonfinite(inner) for key, inner in value.items()}
    return [replace_nonfinite(inner) for inner in value] if isinstance(value, list | tuple) else value


def _manifest_metric(manifest: Manifest, name: str) -> float | None:
    if name not in manifest.metrics:
        raise UserError(
            f"the manifest of stage {manifest.stage} has no figure {name}: "
            f"run it again with python -m stages.{manifest.stage} RUN --force"
        )
    return manifest.metrics[name]
