"""One trial of the table of materials: the texture stage with and without the light of the video, scored and stored."""

import json
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_tools.evaluate.materials import largest_gain_error, normal_map_angle_deg, score_maps, write_true_run
from data_tools.evaluate.run_materials import score_run_materials
from data_tools.evaluate.truth import load_ground_truth
from data_tools.sweep.chart_trials import Trial
from data_tools.synthetic.scene.capture import SyntheticCapture
from pipeline.core.atomic import atomic_path
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_json, digest_video, outputs_digests
from pipeline.core.measure import describe_environment
from pipeline.mesh.files import load_dense_mesh, load_mesh
from pipeline.texture.files import load_texture
from stages.texture import STAGE as TEXTURE

TRUE_FRAMES, FLICKER = 48, 0.3
KEPT, REMOVED = "kept", "auto"
"""Values of `texture.light` that are compared: the light of the video stays, or is removed where that helps."""


@dataclass(frozen=True)
class MaterialTrial:
    """One capture with one seed.

    Attributes:
        base: capture, preset, seed, and parent of the run folder.
        true_mesh: with the true mesh, poses and masks, the seed being that of the flicker; otherwise of a run.
    """

    base: Trial
    true_mesh: bool

    @property
    def name(self) -> str:
        """Name of the file with the figures."""
        return f"{self.base.capture_name}-{'true' if self.true_mesh else self.base.preset_name}-{self.base.seed}"

    @property
    def path(self) -> Path:
        """The file with the figures."""
        return self.base.out / "figures" / f"{self.name}.json"

    def inputs_digest(self) -> str:
        """Return the digest of what the texture stage and the scores read: the truth, and the artifacts of the run."""
        truth = self.base.capture / "truth"
        digests: dict[str, str | None] = {"truth": digest_video(truth) if truth.is_dir() else None}
        if not self.true_mesh:
            digests |= outputs_digests(self.base.run_dir, TEXTURE.needs)
        return digest_json(digests)


def read_figures(trial: MaterialTrial) -> dict[str, Any] | None:
    """Return the stored figures with `commit` and `machine`; None if there are none of today's inputs and stage."""
    if not trial.path.is_file():
        return None
    try:
        stored = json.loads(trial.path.read_text(encoding="utf-8"))
        is_current = stored["texture_version"] == TEXTURE.version and stored["inputs"] == trial.inputs_digest()
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{trial.path} is damaged: remove it, and run the same command again") from None
    return dict(stored) if is_current else None


def measure(trial: MaterialTrial) -> dict[str, Any]:
    """Measure a trial, whose run is finished, and store the figures; returns what `read_figures` reads."""
    with tempfile.TemporaryDirectory() as temporary:
        figures = _measure_true(trial, Path(temporary)) if trial.true_mesh else _measure_run(trial, Path(temporary))
    environment = describe_environment()
    stored = {
        "texture_version": TEXTURE.version,
        "inputs": trial.inputs_digest(),
        "commit": environment.get("commit"),
        "environment": environment,
        "figures": figures,
    }
    trial.path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(trial.path) as path:
        path.write_text(json.dumps(stored, indent=1), encoding="utf-8")
    return stored


def _measure_true(trial: MaterialTrial, folder: Path) -> dict[str, float]:
    truth = load_ground_truth(trial.base.capture)
    gains = write_true_run(truth, folder, TRUE_FRAMES, 0.0)
    figures = _compare_lights(folder, folder, lambda texture: score_maps(truth, texture, folder, gains))
    return figures | {"gain_error_largest": _flicker_error(truth, folder / "flicker", trial.base.seed)}


def _flicker_error(truth: SyntheticCapture, folder: Path, seed: int) -> float:
    """Return the largest error of a gain where the exposure of the frames changes by up to `FLICKER`."""
    gains = write_true_run(truth, folder, TRUE_FRAMES, FLICKER, seed)
    _bake(folder, folder / "texture", {"light": "removed", "rounds": 0})
    error = largest_gain_error(load_texture(folder / "texture"), gains)
    shutil.rmtree(folder)
    return error


def _measure_run(trial: MaterialTrial, folder: Path) -> dict[str, float]:
    capture, run = trial.base.capture, trial.base.run_dir
    return _compare_lights(run, folder, lambda texture: score_run_materials(capture, run, texture))


def _compare_lights(run: Path, folder: Path, score: Callable[[Path], dict[str, float]]) -> dict[str, float]:
    """Run the texture stage with and without the light; `score` returns the figures of a folder of it."""
    figures: dict[str, float] = {}
    seconds = {}
    _bake(run, folder / "warm-up", {"light": KEPT, "rounds": 0})  # the first one of a process loads libraries
    for mode in (KEPT, REMOVED):
        options = {"light": mode, "normal_map": mode == REMOVED}
        seconds[mode], metrics = _bake(run, folder / f"texture-{mode}", options)
        scores = score(folder / f"texture-{mode}")
        figures |= {f"{name}_{mode}": value for name, value in scores.items() if not name.startswith("gain")}
        if mode == REMOVED:
            figures |= {name: metrics[name] for name in ("light_removed", "specular_regions")}
    texture = load_texture(folder / f"texture-{REMOVED}")
    mesh = load_mesh(run / "mesh").cut(texture.cut).mesh
    return figures | {
        "faces": float(len(mesh.faces)),
        "normal_map_angle_deg": normal_map_angle_deg(mesh, texture, load_dense_mesh(run / "mesh")),
        "seconds_added": seconds[REMOVED] - seconds[KEPT],
    }


def _bake(run: Path, out: Path, options: dict[str, Any]) -> tuple[float, dict[str, float]]:
    """Run the texture stage on the artifacts of a run; return its processor seconds and its metrics."""
    out.mkdir(parents=True, exist_ok=True)
    started = time.process_time()
    metrics = TEXTURE.run({name: run / name for name in TEXTURE.needs}, out, TEXTURE.config.model_validate(options))
    return time.process_time() - started, dict(metrics)
