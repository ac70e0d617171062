"""Small valid files of every format that a user may supply; the damaged ones are made from them."""

import io
import json
import pickle
import struct
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import cv2
import h5py
import numpy as np
from scipy.sparse import csc_matrix

from data_tools.synthetic.scene.movie import FOR_PLAYERS, write_video
from pipeline.capture.smpl_poses import SmplPoses, save_smpl_poses
from pipeline.io.image import write_rgb

FRAMES, SIDE_PX = 20, 64

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0.0 1.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftArm
  {
    OFFSET 2.0 0.0 0.0
    CHANNELS 3 Yrotation Xrotation Zrotation
    End Site
    {
      OFFSET 0.0 0.5 0.0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
0 1 0  0 0 0  0 0 0
5 6 7  10 20 30  40 50 60
"""

CAMERA = {
    "fx": 80.0,
    "fy": 80.0,
    "cx": 32.0,
    "cy": 32.0,
    "width": SIDE_PX,
    "height": SIDE_PX,
    "distortion": [0.1, 0, 0, 0],
}
SPLIT = {"train": list(range(16)), "validation": [16, 17], "heldout": [18, 19]}
PRESET = "frames:\n  max_frames: 100\nmesh:\n  rounds: 2\n"

_SMPL_PARENTS = (2**32 - 1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Parents of SMPL's joints as its files store them."""


def write_image_folder(folder: Path) -> Path:
    """Write a folder of grey images, a recording."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(FRAMES):
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.full((SIDE_PX, SIDE_PX, 3), 90 + number, np.uint8))
    return folder


@cache
def valid_files() -> Mapping[str, bytes]:
    """Return the content of a valid file by kind."""
    random = np.random.default_rng(0)
    landmarks = random.uniform(0, SIDE_PX, (FRAMES, 33, 2)).astype(np.float32)
    masks = (random.random((FRAMES, SIDE_PX, SIDE_PX)) > 0.5).astype(np.uint8)
    picture = random.integers(0, 255, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
    return {
        "npz": _npz(landmarks_px=landmarks, landmarks_visibility=np.ones((FRAMES, 33), np.float32)),
        "masks npz": _npz(masks=masks),
        "masks hdf5": _hdf5(masks=masks),
        "poses npz": _poses(),
        "camera json": json.dumps(CAMERA).encode(),
        "split json": json.dumps(SPLIT).encode(),
        "bvh": BVH.encode(),
        "glb": _glb(),
        "pickle": pickle.dumps({"a": np.arange(12.0).reshape(3, 4), "b": [1, "two", {"c": np.int32(3)}]}, protocol=2),
        "model pkl": pickle.dumps(_model(), protocol=2),
        "camera pkl": pickle.dumps(_camera_pickle(), protocol=2),
        "model npz": _npz(**_dense_model()),
        "colmap cameras": struct.pack("<QiiQQ4d", 1, 1, 1, SIDE_PX, SIDE_PX, 80.0, 80.0, 32.0, 32.0),
        "colmap images": struct.pack("<Qi7di", 1, 1, 1.0, *[0.0] * 6, 1) + b"000.png\0" + struct.pack("<Q", 0),
        "video": _video(),
        "png": _image(".png", picture),
        "jpg": _image(".jpg", picture),
        "exr": _exr(picture),
        "tiff": _image(".tiff", picture),
        "preset": PRESET.encode(),
    }


def _npz(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _hdf5(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w") as archive:
        for name, values in arrays.items():
            archive.create_dataset(name, data=values, compression="gzip")
    return file.getvalue()


def _poses() -> bytes:
    rows = np.arange(4)
    poses = SmplPoses(
        frame_index=rows,
        global_orient=np.zeros((4, 3), np.float32),
        body_pose=np.zeros((4, 69), np.float32),
        transl=np.zeros((4, 3), np.float32),
        betas=np.zeros((4, 10), np.float32),
        smpl_to_camera=np.tile(np.eye(4, dtype=np.float32), (4, 1, 1)),
        gender="neutral",
    )
    return _written(lambda path: save_smpl_poses(path, poses), "poses.npz")


def _model() -> dict[str, object]:
    """Return a body model of 24 joints in the layout of SMPL; its surface is a cloud of small triangles."""
    random, joints, vertices = np.random.default_rng(0), len(_SMPL_PARENTS), 3 * len(_SMPL_PARENTS)
    centres = random.uniform(-0.5, 0.5, (joints, 3)) + [0.0, 1.0, 0.0]
    template = np.repeat(centres, 3, axis=0) + random.uniform(-0.05, 0.05, (vertices, 3))
    owner = np.repeat(np.eye(joints), 3, axis=0)
    return {
        "v_template": template,
        "shapedirs": random.normal(0.0, 0.001, (vertices, 3, 10)),
        "J_regressor": csc_matrix(owner.T / 3.0),
        "kintree_table": np.array([_SMPL_PARENTS, range(joints)], dtype=np.int64),
        "weights": owner,
        "f": np.arange(vertices, dtype=np.uint32).reshape(-1, 3),
    }


def _dense_model() -> dict[str, np.ndarray]:
    model = _model()
    regressor = model["J_regressor"]
    assert isinstance(regressor, csc_matrix)
    return {name: np.asarray(value) for name, value in (model | {"J_regressor": regressor.toarray()}).items()}


def _camera_pickle() -> dict[str, object]:
    numbers = {"camera_f": 2, "camera_c": 2, "camera_k": 5, "camera_rt": 3, "camera_t": 3}
    return {name: np.ones(size) for name, size in numbers.items()} | {"width": SIDE_PX, "height": SIDE_PX}


def _glb() -> bytes:
    """Return a skinned triangle with a texture, in binary glTF 2."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    parts = [
        positions.tobytes(),
        np.zeros((3, 4), np.uint8).tobytes(),
        np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1)).tobytes(),
        np.eye(4, dtype=np.float32).tobytes(),
        _image(".png", np.full((4, 4, 3), 128, np.uint8)),
    ]
    starts = np.cumsum([0] + [len(part) + -len(part) % 4 for part in parts])
    binary = b"".join(part + bytes(-len(part) % 4) for part in parts)
    views = [
        {"buffer": 0, "byteOffset": int(start), "byteLength": len(part)}
        for start, part in zip(starts[:-1], parts, strict=True)
    ]
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 3, "type": "VEC4"},
            {"bufferView": 2, "componentType": 5126, "count": 3, "type": "VEC4"},
            {"bufferView": 3, "componentType": 5126, "count": 1, "type": "MAT4"},
        ],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "material": 0}]},
        ],
        "skins": [{"joints": [0], "inverseBindMatrices": 3}],
        "nodes": [{"name": "Hips"}, {"mesh": 0, "skin": 0, "children": [0]}],
    }
    return glb_bytes(document, binary)


def glb_bytes(document: object, binary: bytes) -> bytes:
    """Return a .glb of a JSON document and its binary chunk."""
    text = json.dumps(document).encode() if not isinstance(document, bytes) else document
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text
    chunks += len(binary).to_bytes(4, "little") + b"BIN\0" + binary
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


def _video() -> bytes:
    frames = [np.full((SIDE_PX, SIDE_PX, 3), 60 + 3 * number, np.uint8) for number in range(FRAMES)]
    return _written(lambda path: write_video(path, frames, 24.0, FOR_PLAYERS), "video.mp4")


def _image(suffix: str, picture: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, picture)[1].tobytes())


def _exr(picture: np.ndarray) -> bytes:
    return _written(lambda path: write_rgb(path, picture.astype(np.float32) / 255.0), "picture.exr")


def _written(write: Callable[[Path], None], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
