"""Settings of the mesh stage that no preset varies; sweeps and ablations set them from Python."""

from dataclasses import dataclass
from typing import Literal

Remeshing = Literal["error", "uniform", "none"]


@dataclass(frozen=True)
class MeshSettings:
    """Parameters of surface extraction and refinement. Figures are in docs/decisions/mesh.md.

    Surface extraction:
        solid_core_depth_m: points deeper than this inside the fitted body are solid, m.
        blur_sigma_voxels: standard deviation of the Gaussian blur of the density indicator, voxels.
        closing_radius_m: concavities inside the body that a ball of this radius cannot enter are filled, m.
        hands_from_body: take hands and fingers from the fitted body, not from the field.
        fairing_ratio: standard deviation of the smoothing of the offset from the body, in local thicknesses; 0: none.
        isovalues_per_m: density isovalues to select from, 1/m.
        isovalue_frames: validation frames on which the isovalue is selected.

    Refinement:
        coarse_scale: resolution of the training views in all rounds but the last, over that in the last; at most 1.
        coarse_step_ratio: optimiser steps of these rounds, over those of the last.
        frames_per_step: training frames in one optimiser step.
        pixel_stride: inside the silhouette a step uses one of this many pixels of a frame.
        learning_rate: step size of the smoothed vertex offsets, m (with 0.003 and lambda 20: 0.12 dB less, 40
            self-intersections).
        global_learning_rate: step size of the global offset, m.
        appearance_learning_rate: learning rate of the field's colours on the surface; 0 keeps them (0.8 dB less).
        appearance_steps: steps at the start of a round that optimise the colours only.
        smoothing_lambda: lambda of the implicit smoothing of Nicolet et al.; 0 moves each vertex independently.
        colour_weight: weight of the Huber colour loss.
        silhouette_weight: weight of the silhouette loss, alpha against mask.
        laplacian_weight: weight of the uniform Laplacian of the vertex offsets, in units of the edge length.
        offset_weight: weight of the squared vertex offsets, in units of the edge length.
        global_offset_weight: weight of the squared global offset, in units of the edge length.
        subdivide_percentile: faces with an image error above this percentile are subdivided (IHM paper: 95).
        decimate_percentile: faces with an image error up to this percentile are decimated (IHM paper: 50).
        decimated_edge_ratio: edge length of decimated regions, in target edge lengths.
        remeshing: before each round after the first; by the image error of the faces, to a uniform edge length (then
            before the first round too), or none.
        remeshed_faces: number of faces after uniform remeshing; unused otherwise.
        field_views: renders of the field from other cameras that are added to the training views (IHM paper: only
            renders); 0: none.
        alignment_steps: Gauss-Newton steps after each round that align the poses of the views to the surface; 0: none.
        seed: seed of the frame order and of the random backgrounds.

    Reduction of faces:
        max_reduction_loss_db: validation PSNR that the reduction may cost, dB.
        reduction_ratio: ratio of the numbers of faces of successive trials.
        final_faces: number of faces to reach, whatever it costs; 0: as few as `max_reduction_loss_db` allows.

    Raises:
        ValueError: a value is out of its range, or two values contradict each other; the message names them.
    """

    solid_core_depth_m: float = 0.025
    blur_sigma_voxels: float = 1.0
    closing_radius_m: float = 0.03
    hands_from_body: bool = True
    fairing_ratio: float = 0.2
    isovalues_per_m: tuple[float, ...] = (8.0, 16.0, 32.0, 64.0, 128.0)
    isovalue_frames: int = 8

    coarse_scale: float = 0.5
    coarse_step_ratio: float = 2.0
    frames_per_step: int = 4
    pixel_stride: int = 3
    learning_rate: float = 0.0012
    global_learning_rate: float = 0.0003
    appearance_learning_rate: float = 0.012
    appearance_steps: int = 20
    smoothing_lambda: float = 12.0
    colour_weight: float = 1.0
    silhouette_weight: float = 1.0
    laplacian_weight: float = 1.5
    offset_weight: float = 0.002
    global_offset_weight: float = 0.02
    subdivide_percentile: float = 95.0
    decimate_percentile: float = 50.0
    decimated_edge_ratio: float = 1.4
    remeshing: Remeshing = "error"
    remeshed_faces: int = 0
    field_views: int = 0
    alignment_steps: int = 2
    seed: int = 0

    max_reduction_loss_db: float = 0.05
    reduction_ratio: float = 0.8
    final_faces: int = 0

    def __post_init__(self) -> None:
        """Refuse values out of range and contradictions."""
        for name in ("learning_rate", "isovalue_frames", "frames_per_step", "pixel_stride", "coarse_step_ratio"):
            if getattr(self, name) <= 0:
                raise ValueError(f"MeshSettings.{name} = {getattr(self, name)} is not allowed: it must be above 0")
        for name in ("field_views", "final_faces", "alignment_steps"):
            if getattr(self, name) < 0:
                raise ValueError(f"MeshSettings.{name} = {getattr(self, name)} is not allowed: it must be at least 0")
        if not 0.0 < self.coarse_scale <= 1.0:
            raise ValueError(
                f"MeshSettings.coarse_scale = {self.coarse_scale} is not allowed: it must be above 0, at most 1"
            )
        if not self.isovalues_per_m or min(self.isovalues_per_m) <= 0.0:
            raise ValueError(
                f"MeshSettings.isovalues_per_m = {self.isovalues_per_m} is not allowed: it must have values above 0"
            )
        if not 0.0 <= self.decimate_percentile <= self.subdivide_percentile <= 100.0:
            raise ValueError(
                f"MeshSettings.decimate_percentile = {self.decimate_percentile} and subdivide_percentile = "
                f"{self.subdivide_percentile} contradict each other: 0 <= decimate <= subdivide <= 100 must hold"
            )
        if self.decimated_edge_ratio < 1.0:
            raise ValueError(
                f"MeshSettings.decimated_edge_ratio = {self.decimated_edge_ratio} is not allowed: it must be at least 1"
            )
        if (self.remeshing == "uniform") != (self.remeshed_faces > 0):
            raise ValueError(
                f"MeshSettings.remeshing = {self.remeshing} and remeshed_faces = {self.remeshed_faces} contradict each "
                "other: remeshed_faces must be above 0 for uniform remeshing, and 0 otherwise"
            )
