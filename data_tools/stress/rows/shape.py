"""Rows about shape: masks, clothes, unseen sides, few frames, occlusion, thin parts."""

import statistics
from collections import defaultdict

from data_tools.stress.row import DONE, Results, Row, Trial, all_of, bounded, bounded_change
from data_tools.stress.rows.captures import TURN, turn_trial

EVIDENCE_FRAMES = (8, 19, 57, 114, 456)
EVIDENCE_SEEDS = (0, 1, 2)
MIN_EVIDENCE = 57
"""Frames below which the pass line asks for a body-like avatar instead of its details."""


FINGER_MM = (2, 4, 6, 8, 10)
NOT_ASKED = ("fingers 2 mm", "fingers 4 mm")
"""Trials that the pass line leaves out."""


def more_is_never_worse(results: Results) -> list[str]:
    """Pass: the mean over the seeds falls by at most 0.2 dB from one number of frames to the next larger one."""
    groups: dict[int, list[float]] = defaultdict(list)
    for label, result in results.items():
        if result.state == DONE and "frames" in label:
            groups[int(label.split(" ")[0])].append(result.scores["psnr_body_db"])
    means = [(frames, statistics.fmean(values)) for frames, values in sorted(groups.items())]
    pairs = zip(means, means[1:], strict=False)
    return [f"{b} frames: {y - x:+.2f} dB from {a}" for (a, x), (b, y) in pairs if y < x - 0.2]


def weak_is_body_like(results: Results) -> list[str]:
    """Pass: with little evidence, at most 0.5 % of the area is farther than 30 mm from the truth."""
    weak = {
        label: result
        for label, result in results.items()
        if "frames" not in label or int(label.split(" ")[0]) < MIN_EVIDENCE
    }
    return bounded("far_area_share", high=0.005)(weak)


SHAPE_ROWS = (
    Row(
        name="masks",
        failure="true masks eroded (-) or dilated (+) by 1-8 px of 288, with holes, without a limb in 20 % of frames",
        line="volume of each limb within 10 % of the truth",
        trials=(
            *(turn_trial(f"{px:+d} px", px, corruption={"erode_px": -px}) for px in (-8, -4, -2, -1, 0, 1, 2, 4, 8)),
            turn_trial("holes of 6 px", 10, corruption={"holes_px": 6}),
            turn_trial("blurred by 3 px", 11, corruption={"blur_px": 3}),
            turn_trial("lost limb, 20 %", 12, corruption={"lost_limb": 0.2}),
        ),
        crossed=all_of(bounded("limb_volume_low", low=0.9), bounded("limb_volume_high", high=1.1)),
        score="limb_volume_low",
        unit="smallest limb volume over the true one",
        may_refuse=True,
    ),
    Row(
        name="clothes",
        failure="a skirt that is 5-30 cm wider at its hem",
        line="Chamfer on the skirt at most 8 mm; at most 0.5 % of the area farther than 30 mm from the truth",
        trials=tuple(
            turn_trial(f"{100 * flare:.0f} cm", 100 * flare, {"legwear": "skirt", "flare_m": flare})
            for flare in (0.05, 0.1, 0.2, 0.3)
        ),
        crossed=all_of(bounded("skirt_chamfer_mm", high=8.0), bounded("far_area_share", high=0.005)),
        score="skirt_chamfer_mm",
        unit="Chamfer on the skirt, mm",
    ),
    Row(
        name="sleeves",
        failure="sleeves that are 0-8 cm wider at their hem",
        line="Chamfer on the shirt at most 8 mm; at most 0.5 % of the area farther than 30 mm from the truth",
        trials=tuple(
            turn_trial(f"{100 * flare:.0f} cm", 100 * flare, {"sleeve_flare_m": flare} if flare else {})
            for flare in (0.0, 0.03, 0.08)
        ),
        crossed=all_of(bounded("shirt_chamfer_mm", high=8.0), bounded("far_area_share", high=0.005)),
        score="shirt_chamfer_mm",
        unit="Chamfer on the shirt, mm",
    ),
    Row(
        name="hair",
        failure="long hair, a ponytail, an afro, a cap",
        line="Chamfer at most 1 mm above short hair; at most 0.5 % of the area farther than 30 mm from the truth",
        trials=(
            turn_trial("short hair", 0),
            *(
                turn_trial(kind.replace("-", " "), k, {"attachment": kind})
                for k, kind in enumerate(("long-hair", "ponytail", "afro", "cap"), 1)
            ),
        ),
        crossed=all_of(
            bounded_change("short hair", {"chamfer_mm": (None, 1.0)}), bounded("far_area_share", high=0.005)
        ),
        score="chamfer_mm",
        unit="Chamfer, mm",
    ),
    Row(
        name="unseen-side",
        failure="a turn of 360, 270, 180 and 90° is filmed",
        line="no hole, no shard, fill near the body: at most 0.5 % of the area farther than 30 mm from the truth, and "
        "95 % of both surfaces within 40 mm of the other",
        trials=tuple(turn_trial(f"{arc}°", arc, {"arc": arc} if arc < 360 else {}) for arc in (360, 270, 180, 90)),
        crossed=all_of(bounded("far_area_share", high=0.005), bounded("hausdorff95_mm", high=40.0)),
        score="far_area_share",
        unit="area farther than 30 mm",
    ),
    Row(
        name="weak-evidence",
        failure="8-456 frames of one turn, three seeds; a person of 240 px in a large picture",
        line="the mean of three seeds is never worse by more than 0.2 dB with more frames; below "
        f"{MIN_EVIDENCE} frames at most 0.5 % of the area is farther than 30 mm from the truth",
        trials=(
            *(
                Trial(
                    f"{frames} frames, seed {seed}",
                    frames,
                    {
                        "capture": {**TURN, "frames": frames, "fps": frames / 2},
                        "overrides": {"field.seed": seed, "frames.min_frames": 5},
                    },
                )
                for frames in EVIDENCE_FRAMES
                for seed in EVIDENCE_SEEDS
            ),
            turn_trial("person of 240 px in 720", 500, {"size": 720, "fill": 0.333}),
        ),
        crossed=all_of(more_is_never_worse, weak_is_body_like),
        score="psnr_body_db",
        unit="body PSNR, dB",
        may_refuse=True,
        missing="a moving camera, which is the row `moving-camera`",
    ),
    Row(
        name="occlusion",
        failure="a juggled ball, a box before one leg, a passer-by, cut feet",
        line="at most 1 dB and 1 mm below the same capture without",
        trials=(
            turn_trial("nothing", 0),
            turn_trial("ball", 1, {"ball": True}),
            turn_trial("box, 25 % of frames", 2, corruption={"box": 0.25}),
            turn_trial("box, all frames", 3, corruption={"box": 1.0}),
            turn_trial("passer-by, 25 % of frames", 4, corruption={"pedestrian": 0.25}),
            turn_trial("cut at the ankles", 5, corruption={"cut_bottom": 0.1}),
        ),
        crossed=bounded_change("nothing", {"psnr_body_db": (-1.0, None), "chamfer_mm": (None, 1.0)}),
        score="psnr_body_db",
        unit="body PSNR, dB",
        may_refuse=True,
    ),
    Row(
        name="thin-parts",
        failure="hands of persons of 240-720 px; fingers of 2-10 mm at 540 px",
        line="at least 0.8 of the hands' true area within 5 mm of the avatar, from fingers of 6 mm on",
        trials=(
            *(
                turn_trial(f"{size} px", size, {"size": size}, overrides={"field.max_person_px": 640})
                for size in (288, 540, 864)
            ),
            *(
                turn_trial(
                    f"fingers {width} mm",
                    1000 + width,
                    {"size": 540, "finger_mm": width},
                    overrides={"field.max_person_px": 640},
                )
                for width in FINGER_MM
            ),
        ),
        crossed=lambda results: bounded("hand_recall", low=0.8)(
            {label: result for label, result in results.items() if label not in NOT_ASKED}
        ),
        score="hand_recall",
        unit="recall of the hands at 5 mm",
        missing="strands of hair",
    ),
)
