"""The pipeline, in order: a name is the module `stages.<name>`, the folder `runs/<run>/<name>/`, the config section.

From Python::

    from stages import reconstruct

    avatar = reconstruct("me.mp4", preset="instant")
    print(avatar.glb)
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core.pipeline import Pipeline
from pipeline.core.run_folder import RunRequest, default_run_dir
from pipeline.core.runner import Progress, ProgressCallback, RunOptions, StageOutcome, run_pipeline
from pipeline.core.stage import Stage

__version__ = "0.2.0"

STAGES = ("frames", "body", "field", "mesh", "texture", "export", "report")
PIPELINE = Pipeline(
    __name__,
    STAGES,
    preparations=("pipeline.body.body", "pipeline.kernels.precompile", "pipeline.kernels.precompile_cuda"),
)

__all__ = ["PIPELINE", "STAGES", "Progress", "Reconstruction", "load_stage", "reconstruct"]


@dataclass(frozen=True)
class Reconstruction:
    """Files of a finished run.

    run_dir: the run folder, with one folder for each stage.
    glb: the rigged, textured, animated avatar as glTF 2.0 in one file.
    obj: the avatar without rig, with its .mtl and textures in the same folder.
    page: the report as an HTML page.
    report: the figures of the report as JSON.
    stages: state and cost of each stage, in order.
    """

    run_dir: Path
    glb: Path
    obj: Path
    page: Path
    report: Path
    stages: tuple[StageOutcome, ...]


def load_stage(name: str) -> Stage:
    """Import one stage by name; its libraries take seconds to import."""
    return PIPELINE.load_stage(name)


def reconstruct(
    video: str | Path,
    run: str | Path | None = None,
    *,
    preset: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    isolate: bool = True,
    progress: ProgressCallback | None = None,
) -> Reconstruction:
    """Make a rigged avatar from a video of one person; same as the command `instant-human-mesh VIDEO`.

    Stages whose results are fresh are skipped, and an interrupted run resumes from its checkpoints.

    Args:
        video: video file or image folder; never written.
        run: run folder; default runs/NAME in the working directory, with the name of the video.
        preset: "instant", "default", "fine" or another name in configs/, or path of a .yaml file. None: that of the
            run folder, "default" for a new one.
        overrides: options by "section.key", for instance {"mesh.max_faces": 30000}; the run folder records them.
        force: run every stage, even if its result is fresh.
        isolate: run each stage in a process of its own, as the command does: it returns its memory and cannot crash
            this process. False runs all stages in this process, for debugging; results can then differ in the last
            bits if NumPy was imported before this package, which sets the threads of its matrix products.
        progress: called with the `Progress` of the run; an exception that it raises stops the run.

    Raises:
        UserError: the video, the run folder or an option is not valid; the message names the remedy.
        StageFailedError: the process of a stage failed.
    """
    video = Path(video)
    run_dir = Path(run) if run is not None else default_run_dir(video)
    request = RunRequest(run_dir, video, preset, overrides or {}, replace_video=force)
    options = RunOptions(STAGES if force else (), isolate, progress or _ignore)
    outcomes = run_pipeline(PIPELINE, request, options)
    return Reconstruction(
        run_dir=run_dir,
        glb=run_dir / "export" / "avatar.glb",
        obj=run_dir / "export" / "avatar.obj",
        page=run_dir / "report" / "index.html",
        report=run_dir / "report" / "report.json",
        stages=tuple(outcomes),
    )


def _ignore(progress: Progress) -> None:
    """Receive the progress without using it; with a callback, errors of a stage's process carry their message."""
