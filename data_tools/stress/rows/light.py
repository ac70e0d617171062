"""Rows about images: light, exposure, highlights, motion blur, compression.

A row in ten lines: a name, what fails, the pass line in words and as a function, and the trials with their damage.
"""

from data_tools.stress.measures import FLICKER
from data_tools.stress.row import DONE, Results, Row, all_of, bounded_change
from data_tools.stress.rows.captures import turn_trial

MATTE = "0"


def gains_are_found(results: Results) -> list[str]:
    """Pass: the exposure of each training frame within 5 %, where it flickers."""
    errors = {label: r.scores["gain_error"] for label, r in results.items() if "gain_error" in r.scores}
    return [f"{label}: a gain is off by {100 * error:.0f} %" for label, error in errors.items() if not error <= 0.05]


def matte_stays_matte(results: Results) -> list[str]:
    """Pass: no specular map without highlights."""
    matte = results.get(MATTE)
    has_map = matte is not None and matte.state == DONE and matte.scores["specular_mean"] > 0.0
    return [f"{MATTE}: a specular map for a matte person"] if has_map else []


LIGHT_ROWS = (
    Row(
        name="light",
        failure="low light with the noise of a sensor, flicker, gain 0.5-2, hard shadow, night",
        line="body PSNR after a gain a frame at most 1.5 dB below the clean capture; each gain within 5 %",
        trials=(
            turn_trial("clean", 0),
            turn_trial("gain 0.5", 1, corruption={"gain": 0.5}),
            turn_trial("gain 2", 2, corruption={"gain": 2.0}),
            turn_trial("flicker ± 30 %", 3, corruption={"flicker": FLICKER}, measure="gains"),
            turn_trial("low light, 0.25 with noise", 4, corruption={"low_light": 0.25}),
            turn_trial("night, 0.05 with noise", 5, corruption={"low_light": 0.05}),
            turn_trial("hard shadow", 6, {"light": "hard"}),
        ),
        crossed=all_of(bounded_change("clean", {"psnr_body_db": (-1.5, None)}), gains_are_found),
        score="psnr_body_db",
        unit="body PSNR after a gain, dB",
        may_refuse=True,
    ),
    Row(
        name="shine",
        failure="highlights of strength 0-1 on the whole person, and on a patch",
        line="Chamfer within 10 % and colour error within 10 % of those without; no specular map when matte",
        trials=(
            *(turn_trial(f"{strength:g}", strength, {"specular": strength}) for strength in (0.0, 0.25, 0.5, 1.0)),
            turn_trial("patch", 1.2, {"light": "patch"}),
        ),
        crossed=lambda results: _within_ten_percent(results) + matte_stays_matte(results),
        score="balanced_colour_error",
        unit="colour error, of 255",
    ),
    Row(
        name="blur",
        failure="a shutter open for 0-180° of the frame interval; H.264 at 0.2-2 Mb/s",
        line="at most 1 dB lost at 90° and at 0.5 Mb/s",
        trials=(
            *(turn_trial(f"{deg}°", deg, corruption={"shutter_deg": deg} if deg else {}) for deg in (0, 45, 90, 180)),
            *(turn_trial(f"{rate:g} Mb/s", 200 + rate, corruption={"bitrate_mbps": rate}) for rate in (2.0, 0.5, 0.2)),
        ),
        crossed=lambda results: [
            sentence
            for sentence in bounded_change("0°", {"psnr_body_db": (-1.0, None)})(results)
            if sentence.startswith(("45°", "90°", "2 Mb/s", "0.5 Mb/s"))
        ],
        score="psnr_body_db",
        unit="body PSNR, dB",
    ),
)


def _within_ten_percent(results: Results) -> list[str]:
    matte = results.get(MATTE)
    if matte is None or matte.state != DONE:
        return []
    sentences = []
    for score in ("chamfer_mm", "balanced_colour_error"):
        for label, result in results.items():
            if result.state == DONE and result.scores[score] > 1.1 * matte.scores[score]:
                excess = 100 * (result.scores[score] / matte.scores[score] - 1)
                sentences.append(f"{label}: {score} {excess:+.0f} %")
    return sentences
