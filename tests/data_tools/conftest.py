"""One small synthetic person and one small capture; a run with a finished export."""

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

install_import_hook(["data_tools"], "beartype.beartype")

from data_tools.sample import main as make_sample  # noqa: E402 (after the hook, so that shapes are checked)
from data_tools.synthetic.rig.subject import Subject, load_subject  # noqa: E402
from pipeline.body.body import Body  # noqa: E402
from pipeline.body.files import load_body  # noqa: E402
from tests.data_tools.exported_run import write_exported_run  # noqa: E402
from tests.field.scene import PaintedScene, painted_scene  # noqa: E402

SAMPLE_OPTIONS = [
    *("--frames", "6", "--fps", "6", "--size", "200", "--texture", "512"),
    *("--novel-views", "2", "--novel-poses", "2"),
]


@pytest.fixture(scope="session")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a capture of the built-in person, 6 frames of 200 x 200."""
    out = tmp_path_factory.mktemp("captures") / "sample"
    make_sample([str(out), *SAMPLE_OPTIONS])
    return out


@pytest.fixture(scope="session")
def subject(sample: Path) -> Subject:
    """The built-in person of seed 0, clothed."""
    return load_subject(sample / "truth")


@pytest.fixture(scope="session")
def bare(sample: Path) -> Body:
    """The body without clothes."""
    return load_body(sample / "truth" / "bare.npz")


@pytest.fixture(scope="module")
def scene() -> PaintedScene:
    """A painted body in six frames."""
    return painted_scene(frames=6, height_px=32)


@pytest.fixture
def run(scene: PaintedScene, tmp_path: Path) -> Path:
    """A run whose export is finished, in the names of Mixamo; its texture is white."""
    folder = tmp_path / "run"
    folder.mkdir()
    write_exported_run(folder, scene)
    return folder
