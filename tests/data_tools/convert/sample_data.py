"""Small recordings in the formats of research data sets, written without the code of the readers."""

import pickle
from pathlib import Path

import h5py
import numpy as np

from data_tools.synthetic.scene.movie import write_video
from pipeline.io.image import write_gray, write_rgb

WIDTH, HEIGHT = 16, 12
SCALES = {"pose": 0.3, "trans": 1.0, "transl": 1.0, "betas": 1.0, "global_orient": 0.3, "body_pose": 0.3}
WIDTHS = {"pose": 72, "trans": 3, "transl": 3, "betas": 10, "global_orient": 3, "body_pose": 69}


def pictures(n: int) -> np.ndarray:
    """Return distinct images (n, h, w, 3)."""
    return np.random.default_rng(1).integers(0, 255, (n, HEIGHT, WIDTH, 3), dtype=np.uint8)


def masks(n: int) -> np.ndarray:
    """Return masks (n, h, w) of 0 and 1: a bar whose position depends on the frame."""
    columns = np.arange(WIDTH)
    rows = np.stack([(columns >= k % 8) & (columns < k % 8 + 5) for k in range(n)])
    return rows[:, None].repeat(HEIGHT, axis=1).astype(np.uint8)


def numbers(name: str, n: int, seed: int = 2) -> np.ndarray:
    """Return n rows of an SMPL parameter."""
    return np.random.default_rng(seed).normal(scale=SCALES[name], size=(n, WIDTHS[name])).astype(np.float32)


def people_snapshot(folder: Path, n: int = 6) -> dict[str, np.ndarray]:
    """Write one subject and return its camera."""
    folder.mkdir(parents=True)
    write_video(folder / f"{folder.name}.mp4", pictures(n), 25.0)
    camera = {
        "camera_f": np.array([30.0, 31.0]),
        "camera_c": np.array([WIDTH / 2, HEIGHT / 2]),
        "camera_k": np.array([-0.05, 0.01, 0.0, 0.001, 0.0]),
        "camera_rt": np.array([0.0, 0.0, np.pi / 2]),
        "camera_t": np.array([0.1, 0.2, 3.0]),
        "width": WIDTH,
        "height": HEIGHT,
    }
    (folder / "camera.pkl").write_bytes(pickle.dumps(camera, protocol=2))
    with h5py.File(folder / "masks.hdf5", "w") as file:
        file["masks"] = masks(n).astype(np.int8)
    with h5py.File(folder / "reconstructed_poses.hdf5", "w") as file:
        for name in ("pose", "trans"):
            file[name] = numbers(name, n)
        file["betas"] = numbers("betas", 1)[0]
    return camera


def instant_avatar(folder: Path, n: int = 6) -> None:
    """Write one subject with poses of all frames and masks as .npy files."""
    for name in ("images", "masks", "poses"):
        (folder / name).mkdir(parents=True)
    for k, (picture, mask) in enumerate(zip(pictures(n), masks(n), strict=True)):
        write_rgb(folder / "images" / f"image_{k:04d}.png", picture)
        np.save(folder / "masks" / f"mask_{k:04d}.npy", mask)
    extrinsic = np.eye(4)
    extrinsic[:3, 3] = (0.0, 0.0, 1.0)
    intrinsic = np.array([[30.0, 0.0, 8.0], [0.0, 31.0, 6.0], [0.0, 0.0, 1.0]])
    np.savez(folder / "cameras.npz", intrinsic=intrinsic, extrinsic=extrinsic, height=HEIGHT, width=WIDTH)
    poses = {"thetas": numbers("pose", n), "transl": numbers("transl", n), "betas": numbers("betas", 1)[0]}
    np.savez(folder / "poses.npz", **poses)


def poses_of_set(n: int, seed: int) -> dict[str, np.ndarray]:
    """Return the content of `anim_nerf_train.npz`."""
    rows = {name: numbers(name, n, seed) for name in ("global_orient", "body_pose", "transl")}
    return rows | {"betas": numbers("betas", 1, seed)}


def write_image_folder(folder: Path, mask_folder: str, n: int = 6) -> None:
    """Write images, and masks of 0 and 255 with the same names."""
    (folder / "images").mkdir(parents=True)
    (folder / mask_folder).mkdir()
    for k, (picture, mask) in enumerate(zip(pictures(n), masks(n), strict=True)):
        write_rgb(folder / "images" / f"{k:05d}.png", picture)
        write_gray(folder / mask_folder / f"{k:05d}.png", 255 * mask)
