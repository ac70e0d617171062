"""Which colours fill the texels that no frame shows: diffusion over the mesh, or push-pull in the texture?

`python -m tests.bench.bench_hole_filling RUN...` hides observed texels of finished runs within balls of some radii and
prints the PSNR of what each method puts there (mean of three draws), and its CPU seconds.
"""

import sys
import time
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from pipeline.geometry.atlas import Atlas, Texels, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.io.image import push_pull, read_gray, read_rgb_float, to_float
from pipeline.io.npz import load_npz
from pipeline.texture.inpainting import average_texels_per_vertex, inpaint_vertex_colours

HOLES = ((0.01, 300), (0.02, 120), (0.05, 25), (0.10, 6))
"""Radius in metres and number of balls."""
DRAWS = 3
OBSERVED = 0.5


def main(runs: list[str]) -> None:
    """Print one line a run and radius."""
    print("run            radius m  hidden  mesh dB  push-pull dB  mesh s  push-pull s")
    for run in map(Path, runs):
        arrays, layout = load_npz(run / "mesh" / "mesh.npz"), load_npz(run / "texture" / "atlas.npz")
        mesh = Mesh(arrays["vertices"], arrays["faces"])
        texture = read_rgb_float(run / "texture" / "diffuse.png")
        texels = rasterize_texels(Atlas(layout["uv"], layout["faces_uv"], layout["vertex_of_uv"]), len(texture))
        seen = to_float(read_gray(run / "texture" / "coverage.png"))[texels.rows, texels.columns]
        for radius_m, count in HOLES:
            random = np.random.default_rng(0)
            scores = [score(mesh, texels, texture, seen, radius_m, count, random) for _ in range(DRAWS)]
            hidden, *figures = np.mean(scores, axis=0)
            columns = "  ".join(f"{figure:7.2f}" for figure in figures)
            print(f"{run.name:14s} {radius_m:8.2f}  {hidden:6.3f}  {columns}")


def score(
    mesh: Mesh,
    texels: Texels,
    texture: Float[np.ndarray, "s s 3"],
    seen: Float[np.ndarray, "t"],
    radius_m: float,
    count: int,
    random: np.random.Generator,
) -> tuple[float, float, float, float, float]:
    """Share of texels hidden, PSNR over the mesh and in the texture, CPU seconds of both."""
    colour, place = texture[texels.rows, texels.columns], texels.interpolate(mesh.faces, mesh.vertices)
    centres = place[random.choice(np.flatnonzero(seen > OBSERVED), count, replace=False)]
    hidden = np.zeros(len(seen), dtype=bool)
    hidden[np.unique(np.concatenate(cKDTree(place).query_ball_point(centres, radius_m)).astype(int))] = True
    left, held = np.where(hidden, 0.0, seen).astype(np.float32), hidden & (seen > OBSERVED)
    started = time.process_time()
    over_mesh = texels.interpolate(
        mesh.faces,
        inpaint_vertex_colours(mesh, *average_texels_per_vertex(texels, mesh.faces, len(mesh.vertices), colour, left)),
    )
    between = time.process_time()
    known: Bool[np.ndarray, "s s"] = texels.to_texture(left[:, None])[..., 0] > OBSERVED
    in_texture = push_pull(texture, known)[texels.rows, texels.columns]
    ended = time.process_time()
    psnrs_db = (-10.0 * np.log10(np.mean((filled - colour)[held] ** 2)) for filled in (over_mesh, in_texture))
    return float(held.mean()), *map(float, psnrs_db), between - started, ended - between


if __name__ == "__main__":
    main(sys.argv[1:])
