"""Chart accuracy against run time: one row of panels per capture, one colour per preset, with the Pareto front."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

PANEL_INCHES = (4.8, 3.6)
LEGEND_INCHES = 1.1
TEXT_COLOUR, GRID_COLOUR = "#222222", "#888888"
FEW_TICKS, MANY_TICKS = (1.0, 3.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)

Colour = tuple[float, float, float, float]


@dataclass(frozen=True)
class ChartPoint:
    """One finished run.

    Attributes:
        field_seconds: run time up to the trained field.
        seconds: run time up to the exported avatar.
        scores: by column of `data_tools.sweep.runs.SCORE_PATHS`.
        curve: during training: seconds since the start of the run, validation PSNR (dB) of full image and body pixels.
    """

    capture: str
    preset: str
    seed: int
    field_seconds: float
    seconds: float
    scores: dict[str, float]
    curve: list[tuple[float, float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Panel:
    """A column of panels: score of the mesh, score of the field if any, and its column in `ChartPoint.curve`."""

    title: str
    mesh_score: str
    field_score: str | None
    curve_column: int | None
    higher_is_better: bool


PANELS = (
    Panel("PSNR, whole image (dB)", "mesh_psnr_full_db", "field_psnr_full_db", 1, True),
    Panel("PSNR, body pixels (dB)", "mesh_psnr_body_db", "field_psnr_body_db", 2, True),
    Panel("Chamfer distance to the truth (mm)", "chamfer_mm", None, None, False),
)


def pareto_front(entries: Sequence[tuple[float, float]], higher_is_better: bool) -> list[int]:
    """Return the indices of the Pareto-optimal (seconds, score) entries, in ascending order of seconds.

    An entry dominates another if it is at least as fast and at least as good, and not equal in both.
    """
    costs = [(seconds, -score if higher_is_better else score) for seconds, score in entries]
    is_dominated = [any(a[0] <= b[0] and a[1] <= b[1] and a != b for a in costs) for b in costs]
    return sorted((index for index, dominated in enumerate(is_dominated) if not dominated), key=costs.__getitem__)


def preset_means(points: Iterable[ChartPoint], score: str) -> dict[str, tuple[float, float]]:
    """Return the mean (seconds, score) over the seeds of each preset; runs without the score are left out."""
    groups: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        if score in point.scores:
            groups.setdefault(point.preset, []).append((point.seconds, point.scores[score]))
    means = {preset: np.mean(group, axis=0) for preset, group in groups.items()}
    return {preset: (float(mean[0]), float(mean[1])) for preset, mean in means.items()}


def draw_chart(points: Sequence[ChartPoint], provenance: str) -> Figure:
    """Draw the figure; panels without any score are left out. ValueError if no run has a score.

    provenance: text above the figure, see `data_tools.sweep.chart.provenance`.
    """
    captures = list(dict.fromkeys(point.capture for point in points))
    presets = list(dict.fromkeys(point.preset for point in points))
    panels = [panel for panel in PANELS if any(panel.mesh_score in point.scores for point in points)]
    if not panels:
        raise ValueError("a chart needs at least one run with a score")
    colours = {preset: mpl.colormaps["tab10"](number % 10) for number, preset in enumerate(presets)}
    size = (PANEL_INCHES[0] * len(panels), PANEL_INCHES[1] * len(captures) + LEGEND_INCHES)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(captures), len(panels), squeeze=False)
    for capture, row in zip(captures, grid, strict=True):
        chosen = [point for point in points if point.capture == capture]
        for panel, axes in zip(panels, row, strict=True):
            _draw_runs(axes, panel, chosen, colours)
            _draw_presets(axes, panel, chosen, colours)
            _style_axes(axes, f"{capture}: {panel.title}")
    keys = [Line2D([], [], color=colour, marker="o", label=preset) for preset, colour in colours.items()]
    figure.legend(
        handles=[*keys, *_legend_entries()],
        loc="outside lower center",
        ncols=2 * len(panels),
        frameon=False,
        fontsize=9,
    )
    figure.suptitle(provenance, x=0.01, ha="left", fontsize=8, color=GRID_COLOUR)
    return figure


def save_chart(figure: Figure, folder: Path) -> None:
    """Write `chart.svg` and `chart.png`; equal figures give equal bytes."""
    save_figure(figure, folder, "chart", dpi=130)


def save_figure(figure: Figure, folder: Path, name: str, dpi: int) -> None:
    """Write `NAME.svg` and `NAME.png`; equal figures give equal bytes."""
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    figure.savefig(folder / f"{name}.png", dpi=dpi)


def _draw_runs(axes: Axes, panel: Panel, points: Sequence[ChartPoint], colours: dict[str, Colour]) -> None:
    """Draw each run: mesh, field, and validation scores during training."""
    for point in points:
        colour = colours[point.preset]
        if panel.mesh_score in point.scores:
            axes.plot(point.seconds, point.scores[panel.mesh_score], ".", color=colour, markersize=4)
        if panel.curve_column is not None and point.curve:
            seconds, scores = zip(*((row[0], row[panel.curve_column]) for row in point.curve), strict=True)
            axes.plot(seconds, scores, color=colour, linewidth=1, alpha=0.7)
        if panel.field_score in point.scores:
            axes.plot(point.field_seconds, point.scores[panel.field_score], "D", mec=colour, mfc="white", markersize=5)


def _draw_presets(axes: Axes, panel: Panel, points: Sequence[ChartPoint], colours: dict[str, Colour]) -> None:
    """Draw the mean over seeds of each preset with its name, and the Pareto front."""
    means = preset_means(points, panel.mesh_score)
    for preset, point in means.items():
        axes.plot(*point, "o", color=colours[preset], markersize=7)
        axes.annotate(
            preset.partition(",")[0], point, (7, 4), textcoords="offset points", fontsize=8, color=TEXT_COLOUR
        )
    mean_points = list(means.values())
    front = [mean_points[index] for index in pareto_front(mean_points, panel.higher_is_better)]
    if front:
        seconds, scores = zip(*front, strict=True)
        axes.step(seconds, scores, where="post", color=TEXT_COLOUR, linewidth=1, linestyle=":", zorder=1)
        axes.plot(seconds, scores, "o", color=TEXT_COLOUR, markersize=12, fillstyle="none", linestyle="none")


def _style_axes(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda seconds, _: f"{seconds:,.12g}"))
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda *_: ""))
    axes.set_xlabel("seconds", fontsize=9, color=GRID_COLOUR)
    axes.margins(x=0.15, y=0.12)
    shortest, longest = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=FEW_TICKS if longest > 10.0 * shortest else MANY_TICKS))
    axes.grid(color=GRID_COLOUR, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _legend_entries() -> list[Line2D]:
    return [
        Line2D([], [], color=TEXT_COLOUR, marker="o", linestyle="none", label="exported mesh, held-out frames"),
        Line2D([], [], mec=TEXT_COLOUR, mfc="white", marker="D", linestyle="none", label="field, held-out frames"),
        Line2D([], [], color=TEXT_COLOUR, linewidth=1, label="field during training, validation frames"),
        Line2D(
            [], [], color=TEXT_COLOUR, marker="o", markersize=11, fillstyle="none", linestyle=":", label="Pareto front"
        ),
    ]
