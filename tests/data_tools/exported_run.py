"""A run with a finished export, for commands that continue from one."""

from pathlib import Path

import numpy as np

from pipeline.core.manifest import Manifest, write_manifest
from pipeline.geometry.atlas import Atlas
from pipeline.texture.files import TextureArtifact, save_texture
from pipeline.texture.light import Highlights, VideoLight
from stages.export import STAGE, Config
from tests.field.scene import PaintedScene
from tests.stages.painted_run import make_run, save_known_template


def write_exported_run(folder: Path, scene: PaintedScene) -> None:
    """Write all that the export reads, and its manifest, with the names of Mixamo's rig; the texture is white."""
    make_run(folder, scene.body, scene.motion, scene.camera, scene.images, scene.masks)
    faces = scene.body.faces
    uv = np.random.default_rng(0).uniform(size=(len(scene.body.vertices), 2)).astype(np.float32)
    atlas = Atlas(uv, faces.astype(np.int32), np.arange(len(uv), dtype=np.int32))
    blank = np.zeros((16, 16), dtype=np.uint8)
    (folder / "texture").mkdir()
    texture = TextureArtifact(
        atlas,
        np.ones((16, 16, 3), np.float32),
        blank.astype(np.float32),
        blank,
        VideoLight.uniform(len(scene.images)),
        Highlights.none(),
    )
    save_texture(folder / "texture", texture)
    save_known_template(folder / "texture", scene.body)
    (folder / "export").mkdir()
    config = Config(rig="mixamo").model_dump()
    manifest = Manifest("export", STAGE.version, "", config, {}, {}, {}, 0.0, 0.0)
    write_manifest(manifest, folder / "export" / "manifest.json")
