"""The pipeline, in order: a name is the module `stages.<name>`, the folder `runs/<run>/<name>/`, the config section."""

from importlib import import_module

from pipeline.core.stage import Stage

STAGES = ("frames", "body", "field", "mesh", "texture", "export", "report")


def load(name: str) -> Stage:
    """Import the stage called `name`: only now, because stages pull in heavy libraries."""
    stage: Stage = import_module(f"stages.{name}").STAGE
    return stage
