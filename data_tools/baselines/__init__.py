"""Presets that reproduce published methods with the stages of this pipeline, for comparison with its own method.

| preset | method |
|---|---|
| `instantavatar` | InstantAvatar (Jiang et al. 2023) |
| `animnerf` | Anim-NeRF (Chen et al. 2021) |
| `ihm` | Instant Human Mesh, the constants of the paper (Wang et al. 2025) |
| `visual-hull` | visual hull in canonical space (Laurentini 1994), no training |

`--preset NAME` finds them as it finds the presets in `configs/`; `python -m data_tools.sweep.chart` runs all of them.
"""
