"""A pipeline: an ordered list of stages, one Python module for each."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from pipeline.core.config import CONFIG_DIR, Config, build_config, check_sections, load_layers
from pipeline.core.record import RunRecord
from pipeline.core.stage import Stage


@dataclass(frozen=True)
class Pipeline:
    """The stages of a package, in order.

    package: Python package with a module for each stage; `python -m PACKAGE` runs the pipeline.
    names: names of the stages, which are the names of the modules; each module has a constant `STAGE`.
    config_dir: folder of the presets.
    preparations: modules that prepare this machine beside the first run, see `pipeline.core.preparation`.
    """

    package: str
    names: tuple[str, ...]
    config_dir: Path = CONFIG_DIR
    preparations: tuple[str, ...] = ()

    def load_stage(self, name: str) -> Stage:
        """Import one stage; its libraries take seconds to import, so nothing else imports the stages."""
        stage: Stage = import_module(f"{self.package}.{name}").STAGE
        return stage

    def load_stages(self) -> list[Stage]:
        """Import all stages."""
        return [self.load_stage(name) for name in self.names]

    def build_configs(self, record: RunRecord) -> dict[str, Config]:
        """Build the options of all stages, by stage.

        Raises:
            UserError: the preset, a section, a key or a value is not valid.
        """
        layers = load_layers(record.preset, record.overrides, self.config_dir)
        check_sections(layers, self.names)
        return {stage.name: build_config(stage.name, stage.config, layers) for stage in self.load_stages()}
