"""Constants of the texture bake that were fixed by measurement.

Users do not set them; sweeps and ablations do: `stages.texture.run(..., settings=replace(TextureSettings(), ...))`.
"""

from dataclasses import dataclass

_NON_NEGATIVE = ("cosine_power", "flow_smoothing_sigma_m", "max_flow_m")
_POSITIVE = ("silhouette_falloff_m", "depth_tolerance_m", "geman_mcclure_scale", "texels_per_pixel", "padding_px")


@dataclass(frozen=True)
class TextureSettings:
    """Settings of the atlas and the diffuse bake.

    Raises:
        ValueError: a value is outside its range.

    Attributes:
        cosine_power: exponent of the cosine between normal and view direction in the weight of a view, >= 0. Exponents
            1, 2, 4 give 32.65, 32.62, 32.46 dB on aligned validation frames; 2 has fewer ghosts than 1.
        silhouette_falloff_m: distance from a silhouette over which the confidence of a pixel rises from 0 to 1, m.
        depth_tolerance_m: largest depth difference at which a texel passes the depth test, m.
        flow_smoothing_sigma_m: standard deviation of the Gaussian blur of the optical flow, m on the surface.
        max_flow_m: largest displacement of a pixel by the alignment, m on the surface; 0 turns the alignment off.
        geman_mcclure_scale: residual norm (sRGB in [0, 1]) at which a pixel has a quarter of its weight.
        texels_per_pixel: texels along the side of one pixel's footprint on the person.
        padding_px: smallest gutter between charts, texels.
    """

    cosine_power: float = 2.0
    silhouette_falloff_m: float = 0.012
    depth_tolerance_m: float = 0.01
    flow_smoothing_sigma_m: float = 0.01
    max_flow_m: float = 0.03
    geman_mcclure_scale: float = 0.3
    texels_per_pixel: float = 1.5
    padding_px: int = 4

    def __post_init__(self) -> None:
        for name in _NON_NEGATIVE:
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} = {getattr(self, name)} must be at least 0")
        for name in _POSITIVE:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)} must be above 0")


DEFAULT_SETTINGS = TextureSettings()
