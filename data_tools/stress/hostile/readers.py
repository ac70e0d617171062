"""Every reader of user files, as a function of a path; what it returns does not count."""

from collections.abc import Callable, Mapping
from pathlib import Path

from data_tools.convert.colmap import read_colmap_model
from data_tools.convert.joblib_pickle import load_joblib
from data_tools.convert.people_snapshot import read_people_snapshot
from data_tools.pose import read_pose
from data_tools.stress.hostile.valid_files import valid_files, write_image_folder
from data_tools.synthetic.rig.rigged import read_rigged_person
from pipeline.body.body import Body, load_anny
from pipeline.body.smpl_file import load_smpl
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.core.record import RunRecord
from pipeline.io.bvh import read_bvh
from pipeline.io.glb import GlbFile
from pipeline.io.image import read_gray, read_rgb
from pipeline.io.npz import load_npz
from pipeline.io.safe_pickle import load_npy, load_pickle
from stages import PIPELINE

Reader = Callable[[Path], object]
MAX_SIDE_PX = 720


def _user_file(name: str) -> Reader:
    """Return a reader of a file beside the images of a recording, which is read to its last mask."""

    def read(path: Path) -> object:
        folder = write_image_folder(path.with_name("recording"))
        target = folder / name
        target.write_bytes(path.read_bytes())
        try:
            source = open_frame_source(folder)
            files = load_user_files(folder, source)
            if files.read_mask is not None:
                for index in range(source.n_frames):
                    files.read_mask(index)
            if files.camera is not None:
                frame = next(read_frames(source, lambda index: index == 0, MAX_SIDE_PX))
                files.camera.undistort(frame.rgb, 1.0)
        finally:
            target.unlink()
        return files

    return read


def _people_snapshot(path: Path) -> object:
    folder = path.with_name("subject")
    folder.mkdir(exist_ok=True)
    (folder / "subject.mp4").write_bytes(valid_files()["video"])
    (folder / "camera.pkl").write_bytes(path.read_bytes())
    return read_people_snapshot(folder)


def _colmap(name: str) -> Reader:
    """Return a reader of one file of a COLMAP model whose other file is valid."""

    def read(path: Path) -> object:
        folder = path.with_name("sparse")
        folder.mkdir(exist_ok=True)
        for part in ("cameras", "images"):
            (folder / f"{part}.bin").write_bytes(valid_files()[f"colmap {part}"])
        (folder / f"{name}.bin").write_bytes(path.read_bytes())
        return read_colmap_model(folder)

    return read


def _video(path: Path) -> object:
    source = open_frame_source(path)
    return sum(1 for _ in read_frames(source, lambda _: True, MAX_SIDE_PX))


def _glb(path: Path) -> object:
    file = GlbFile(path)
    for primitive in file.skinned_primitives():
        file.base_colour(primitive.material)
    return file.node_to_world()


def _preset(path: Path) -> object:
    return PIPELINE.build_configs(RunRecord(preset=str(path)))


def _pose(path: Path) -> object:
    return read_pose(path, _body())


def _body() -> Body:
    model = load_anny()
    return model.at_shape(model.shape_defaults)


READERS: Mapping[str, tuple[str, str, tuple[Reader, ...]]] = {
    "npz": ("npz", "file.npz", (load_npz, _user_file("landmarks.npz"))),
    "masks-npz": ("masks npz", "file.npz", (_user_file("masks.npz"),)),
    "masks-hdf5": ("masks hdf5", "file.hdf5", (_user_file("masks.hdf5"),)),
    "smpl-poses": ("poses npz", "file.npz", (_user_file("smpl_poses.npz"),)),
    "camera": ("camera json", "file.json", (_user_file("camera.json"),)),
    "split": ("split json", "file.json", (_user_file("split.json"),)),
    "pose": ("pose json", "file.json", (_pose,)),
    "bvh": ("bvh", "file.bvh", (read_bvh,)),
    "glb": ("glb", "file.glb", (_glb, read_rigged_person)),
    "pickle": ("pickle", "file.pkl", (load_pickle, load_npy, load_joblib)),
    "smpl-model": ("model pkl", "file.pkl", (load_smpl,)),
    "people-snapshot": ("camera pkl", "camera.pkl", (_people_snapshot,)),
    "smpl-npz": ("model npz", "file.npz", (load_smpl,)),
    "colmap-cameras": ("colmap cameras", "cameras.bin", (_colmap("cameras"),)),
    "colmap-images": ("colmap images", "images.bin", (_colmap("images"),)),
    "video": ("video", "file.mp4", (_video,)),
    "png": ("png", "file.png", (read_rgb, read_gray)),
    "jpg": ("jpg", "file.jpg", (read_rgb,)),
    "exr": ("exr", "file.exr", (read_rgb,)),
    "tiff": ("tiff", "file.tiff", (read_rgb,)),
    "preset": ("preset", "file.yaml", (_preset,)),
}
"""By name in the row: kind in `valid_files` and `bombs`, file name, and the readers of such a file."""
