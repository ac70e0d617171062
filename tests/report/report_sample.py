"""A small report document and page content that tests share."""

import math
from typing import Any

import numpy as np

from pipeline.avatar.gltf import encode_glb
from pipeline.avatar.rig import build_rig
from pipeline.capture.frame_selection import INTERLEAVED_RULE
from pipeline.core.manifest import Manifest
from pipeline.report.page import FrameImages, PageContent
from pipeline.report.report_json import SplitNote, build_report, replace_nonfinite
from tests.avatar.avatar_sample import sample_body, sample_maps, sample_motion, sample_skinned_mesh

STAGES = ("frames", "body", "field", "mesh", "texture", "export")
SCORES = ("psnr_full", "psnr_body", "psnr_box", "ssim_full", "ssim_box", "mask_iou")


def sample_manifests() -> dict[str, Manifest]:
    """Manifests of all stages: 1, 2, 3 ... seconds, 100, 200 ... MiB."""
    metrics = {"body": {"landmark_error_px": 4.5, "silhouette_iou": 0.93}}
    return {
        name: Manifest(name, 1, "", {}, {}, {}, metrics.get(name, {}), number, 100.0 * number)
        for number, name in enumerate(STAGES, start=1)
    }


def sample_rows(first_psnr: float = 30.0) -> list[dict[str, Any]]:
    """Two frames; the mesh is one unit worse in everything."""
    return [
        {"index": index, "field": dict.fromkeys(SCORES, value), "mesh": dict.fromkeys(SCORES, value - 1.0)}
        for index, value in ((0, first_psnr), (8, 20.0))
    ]


def sample_report(first_psnr: float = 30.0, manifests: dict[str, Manifest] | None = None) -> dict[str, Any]:
    health = {"vertices": 10, "faces": 16, "watertight": True, "manifold": True, "components": 1}
    metric_sections = {"mesh": health, "export": {"glb_bytes": 1_234_567, "texture_px": 64}, "masks": {"count": 9}}
    environment = {"cpu": "a <processor>", "cores": 2, "packages": {"torch": "2"}}
    rows = sample_rows(first_psnr)
    return replace_nonfinite(
        build_report(
            manifests or sample_manifests(),
            rows,
            metric_sections,
            environment,
            (7.0, 700.0),
            SplitNote(INTERLEAVED_RULE, 2),
        )
    )


def sample_page() -> PageContent:
    random = np.random.default_rng(3)
    video, field, mesh = (random.integers(0, 255, (40, 24, 3)).astype(np.uint8) for _ in range(3))
    views = [random.integers(0, 255, (30, 10 + number, 4)).astype(np.uint8) for number in range(4)]
    body = sample_body()
    motion = sample_motion(np.arange(0, 24, 4))
    return PageContent(
        title="run <one>",
        report=sample_report(math.inf),
        frames=[FrameImages(index, video, field, mesh) for index in (0, 8)],
        turntable=[("A-pose", views)],
        images=[("Diffuse map", video)],
        glb=encode_glb(sample_skinned_mesh(body)[0], build_rig(body), {"capture": motion}, sample_maps()),
    )
