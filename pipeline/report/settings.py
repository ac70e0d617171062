"""Settings of the report that no preset varies; change them from Python with `dataclasses.replace`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportSettings:
    """Constants of the evaluation.

    score_unrefined_field: score the field also with the poses of the body stage; doubles the time of the report.
    turntable_height_px: height of a turntable image.
    head_height_px: height of an image of the head.
    edge_blur_frames: frames on which the softness of the masks is measured; none of them is scored.
    crop_margin_px: margin around the person in images of held-out frames.
    """

    score_unrefined_field: bool = False
    turntable_height_px: int = 480
    head_height_px: int = 320
    edge_blur_frames: int = 16
    crop_margin_px: int = 12

    def __post_init__(self) -> None:
        """Raise ValueError for values that make no report."""
        if self.edge_blur_frames < 1:
            raise ValueError("edge_blur_frames must be at least 1")
        if min(self.turntable_height_px, self.head_height_px) < 64:
            raise ValueError("turntable_height_px and head_height_px must be at least 64")


REPORT_SETTINGS = ReportSettings()
