"""Which of the known failures (docs/stress.md) a capture runs into, in plain words, from the manifests of the stages.

A manifest without a metric (an older version, or a stage that did not measure it) leaves its line out.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.core.manifest import Manifest

LOW, SOME, HIGH = "low", "some", "high"
LEVELS = (HIGH, SOME, LOW)
"""Levels in the order of the page."""


@dataclass(frozen=True)
class Risk:
    """One known failure.

    Attributes:
        name: of the failure.
        level: `LOW`, `SOME` or `HIGH`.
        finding: what this capture shows, with its figure.
        advice: what it does to the avatar, and what helps; empty at level `LOW`.
        row: row of the stress test that measures the failure.
    """

    name: str
    level: str
    finding: str
    advice: str
    row: str


@dataclass(frozen=True)
class _Check:
    """How a metric becomes a risk: at or beyond `some` and `high` (below them if `high` is the smaller one).

    finding: with `{value}`, times `scale`.
    """

    name: str
    stage: str
    metric: str
    some: float
    high: float
    finding: str
    advice: str
    row: str
    scale: float = 1.0

    def level(self, value: float) -> str:
        """Return the level of a value of the metric."""
        sign = 1.0 if self.high > self.some else -1.0
        if sign * value >= sign * self.high:
            return HIGH
        return SOME if sign * value >= sign * self.some else LOW


_PERCENT = 100.0

_CHECKS = (
    _Check(
        "Sides that were not filmed",
        "frames",
        "unseen_arc_deg",
        45.0,
        120.0,
        "the largest gap between two views is {value:.0f}° of the turn",
        "there the shape is that of the fitted body and the colour is filled in; film a full turn",
        "unseen-side",
    ),
    _Check(
        "Few pictures",
        "field",
        "train_frames",
        57.0,
        19.0,
        "{value:.0f} pictures to learn from",
        "errors of single pictures do not average out; film longer, or more slowly",
        "weak-evidence",
    ),
    _Check(
        "A small person",
        "frames",
        "person_px",
        400.0,
        240.0,
        "the person is {value:.0f} px tall in the pictures used",
        "fingers and face have few pixels; film from nearer, with the phone upright",
        "thin-parts",
    ),
    _Check(
        "Unknown lens",
        "body",
        "focal_relative_std",
        0.12,
        0.2,
        "the focal length is known to {value:.0f} %",
        "depth and distance may be wrong by as much; body.field_of_view_deg or a camera.json tells it",
        "focal",
        _PERCENT,
    ),
    _Check(
        "A camera that moves, or light that changes",
        "frames",
        "scene_change_share",
        0.1,
        0.3,
        "what is behind the person differs in {value:.0f} % of the pictures",
        "drift of the camera becomes motion of the person; put the camera down and lock the exposure",
        "moving-camera",
        _PERCENT,
    ),
    _Check(
        "Legs behind something",
        "body",
        "hidden_leg_share",
        0.05,
        0.5,
        "a leg is hidden in {value:.0f} % of the pictures",
        "there it follows the posture of the other pictures; if it is never seen, it is a guess",
        "occlusion",
        _PERCENT,
    ),
    _Check(
        "Feet out of the picture",
        "frames",
        "cut_feet_share",
        0.02,
        0.5,
        "the feet are cut off in {value:.0f} % of the pictures",
        "the avatar's feet are those of the fitted body; leave room below the feet",
        "occlusion",
        _PERCENT,
    ),
    _Check(
        "Something else in the masks",
        "body",
        "frames_with_foreign_objects",
        1.0,
        10.0,
        "{value:.0f} pictures show a ball, a bag or a caption in the mask",
        "it may become part of the surface; leave these pictures out with split.json, or supply masks/",
        "masks",
    ),
    _Check(
        "Body and outline differ",
        "body",
        "silhouette_iou",
        0.88,
        0.8,
        "the fitted body covers {value:.0f} % of the masks (intersection over union)",
        "wide clothes, a wrong mask or a wrong pose; look at body/overlay.png",
        "masks",
        _PERCENT,
    ),
    _Check(
        "Loose clothes",
        "texture",
        "loose_share",
        0.02,
        0.15,
        "{value:.0f} % of the surface stand off the body",
        "legs under a skirt or coat are a guess, and their pose bends the cloth in new poses",
        "clothes",
        _PERCENT,
    ),
    _Check(
        "Exposure that changes",
        "texture",
        "gain_log_std",
        0.05,
        0.3,
        "the exposure of the pictures varies by {value:.0f} %",
        "it is estimated for each picture and taken out; lock the exposure for the best colours",
        "light",
        _PERCENT,
    ),
    _Check(
        "Shine",
        "texture",
        "specular_regions",
        1.0,
        8.0,
        "{value:.0f} regions of the surface shine",
        "their highlights have a map of their own; where the whole person shines, colours keep some of the light",
        "shine",
    ),
    _Check(
        "Poses that were not filmed",
        "mesh",
        "stretch_p999",
        1.6,
        2.2,
        "arms up, steps and squats stretch edges of the surface to {value:.1f} times their length (99.9th percentile)",
        "armpits, crotch and loose cloth show it first; film these poses as well",
        "unseen-pose",
    ),
)


def capture_risks(manifests: Mapping[str, Manifest]) -> list[Risk]:
    """Return all risks that the manifests tell about, the highest levels first."""
    risks = [risk for check in _CHECKS if (risk := _judge(check, manifests)) is not None]
    return sorted(risks, key=lambda risk: LEVELS.index(risk.level))


def _judge(check: _Check, manifests: Mapping[str, Manifest]) -> Risk | None:
    """Return the risk; None if its stage or its metric is missing or not finite."""
    manifest = manifests.get(check.stage)
    value = None if manifest is None else manifest.metrics.get(check.metric)
    if value is None:
        return None
    level = check.level(value)
    finding = check.finding.format(value=check.scale * value)
    return Risk(check.name, level, finding, "" if level == LOW else check.advice, check.row)
