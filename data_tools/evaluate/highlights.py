"""Score estimated highlights at surface points against those of a synthetic person."""

import numpy as np
from jaxtyping import Float, Int

from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.renderer import Light, face_exponents, shiny_faces
from pipeline.texture.light import exponent_of_roughness, roughness_of_exponent


def lamp_error_deg(direction: Float[np.ndarray, "3"], light: Light) -> float:
    """Return the angle between the direction of the highlights' lamp (unit, world of the capture) and the key light."""
    key = np.array(light.key_direction) / np.linalg.norm(light.key_direction)
    return float(np.degrees(np.arccos(np.clip(direction @ key, -1.0, 1.0))))


def highlight_scores(
    strength: Float[np.ndarray, "n"],
    roughness: Float[np.ndarray, "n"],
    subject: Subject,
    light: Light,
    faces: Int[np.ndarray, "n"],
) -> dict[str, float]:
    """Compare strength and glTF roughness at points with the truth at the nearest true faces.

    Returns:
        specular_correlation: of the strength with the true one; missing where the true one is the same everywhere.
        roughness_error: mean distance to the true roughness where the true surface shines, weighted by the strength.
        roughness_P, exponent_P: weighted mean where the true exponent is P, and the exponent of that roughness.
    """
    true = shiny_faces(subject, light)[faces]
    scores = {}
    if true.std() > 0:
        scores["specular_correlation"] = float(np.corrcoef(strength, true)[0, 1]) if strength.any() else 0.0
    weight, exponent = strength * true, face_exponents(subject, light)[faces]
    if not weight.any():
        return scores
    error = np.abs(roughness - roughness_of_exponent(exponent))
    scores["roughness_error"] = float(np.average(error, weights=weight))
    for value in np.unique(exponent[weight > 0.0]).tolist():
        here = exponent == value
        mean = np.array([np.average(roughness[here], weights=weight[here])])
        scores[f"roughness_{value:g}"] = float(mean[0])
        scores[f"exponent_{value:g}"] = float(exponent_of_roughness(mean)[0])
    return scores
