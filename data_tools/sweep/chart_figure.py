"""Chart accuracy against run time or size: a row of panels per capture, a colour per preset, with the Pareto front."""

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
        sizes: by column of `data_tools.sweep.chart_trials.SIZE_METRICS`.
    """

    capture: str
    preset: str
    seed: int
    field_seconds: float
    seconds: float
    scores: dict[str, float]
    curve: list[tuple[float, float, float]] = field(default_factory=list)
    sizes: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Panel:
    """A column of panels.

    Attributes:
        score: column of `ChartPoint.scores` that is compared.
        field_score: score of the field that is drawn beside it.
        curve_column: its column in `ChartPoint.curve`.
        size: column of `ChartPoint.sizes` along the horizontal axis; None: seconds.
        axis: title of the horizontal axis.
    """

    title: str
    score: str
    higher_is_better: bool = True
    field_score: str | None = None
    curve_column: int | None = None
    size: str | None = None
    axis: str = "seconds"

    def place(self, point: ChartPoint) -> tuple[float, float] | None:
        """Return where a run is in the panel; None without its score or size."""
        cost = point.seconds if self.size is None else point.sizes.get(self.size)
        score = point.scores.get(self.score)
        return None if cost is None or score is None else (cost, score)


TIME_PANELS = (
    Panel("PSNR, whole image (dB)", "mesh_psnr_full_db", field_score="field_psnr_full_db", curve_column=1),
    Panel("PSNR, body pixels (dB)", "mesh_psnr_body_db", field_score="field_psnr_body_db", curve_column=2),
    Panel("Chamfer distance to the truth (mm)", "chamfer_mm", higher_is_better=False),
    Panel("normals to the truth (degrees)", "normal_angle_deg", higher_is_better=False),
)
SIZE_PANELS = (
    Panel("field, body pixels (dB)", "field_psnr_body_db", size="parameters", axis="parameters of the field"),
    Panel("mesh, body pixels (dB)", "mesh_psnr_body_db", size="glb_faces", axis="faces of the .glb"),
    Panel("mesh, body pixels (dB)", "mesh_psnr_body_db", size="glb_bytes", axis="bytes of the .glb"),
)


def pareto_front(entries: Sequence[tuple[float, float]], higher_is_better: bool) -> list[int]:
    """Return the indices of the Pareto-optimal (cost, score) entries, in ascending order of cost (seconds or size).

    An entry dominates another if it costs at most as much and is at least as good, and not equal in both.
    """
    costs = [(cost, -score if higher_is_better else score) for cost, score in entries]
    is_dominated = [any(a[0] <= b[0] and a[1] <= b[1] and a != b for a in costs) for b in costs]
    return sorted((index for index, dominated in enumerate(is_dominated) if not dominated), key=costs.__getitem__)


def seeds_of_presets(points: Iterable[ChartPoint], panel: Panel) -> dict[str, list[tuple[float, float]]]:
    """Return (cost, score) of every seed by preset; runs without score or size are left out."""
    groups: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        place = panel.place(point)
        if place is not None:
            groups.setdefault(point.preset, []).append(place)
    return groups


def preset_means(points: Iterable[ChartPoint], panel: Panel) -> dict[str, tuple[float, float]]:
    """Return the mean (cost, score) over the seeds of each preset."""
    means = {preset: np.mean(group, axis=0) for preset, group in seeds_of_presets(points, panel).items()}
    return {preset: (float(mean[0]), float(mean[1])) for preset, mean in means.items()}


def draw_chart(points: Sequence[ChartPoint], provenance: str, panels: Sequence[Panel] = TIME_PANELS) -> Figure:
    """Draw the figure; panels without any score, columns or single ones, are left out. ValueError if none is left.

    provenance: text above the figure, see `data_tools.sweep.chart.provenance`.
    """
    captures = list(dict.fromkeys(point.capture for point in points))
    presets = list(dict.fromkeys(point.preset for point in points))
    panels = [panel for panel in panels if any(panel.place(point) for point in points)]
    if not panels:
        raise ValueError("a chart needs at least one run with a score")
    colours = {preset: mpl.colormaps["tab10"](number % 10) for number, preset in enumerate(presets)}
    size = (PANEL_INCHES[0] * len(panels), PANEL_INCHES[1] * len(captures) + LEGEND_INCHES)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(captures), len(panels), squeeze=False)
    for capture, row in zip(captures, grid, strict=True):
        chosen = [point for point in points if point.capture == capture]
        for panel, axes in zip(panels, row, strict=True):
            axes.set_visible(any(panel.place(point) for point in chosen))
            _draw_runs(axes, panel, chosen, colours)
            _draw_presets(axes, panel, chosen, colours)
            _style_axes(axes, f"{capture}: {panel.title}", panel.axis)
    keys = [Line2D([], [], color=colour, marker="o", label=preset) for preset, colour in colours.items()]
    figure.legend(
        handles=[*keys, *_legend_entries(panels)],
        loc="outside lower center",
        ncols=2 * len(panels),
        frameon=False,
        fontsize=9,
    )
    figure.suptitle(provenance, x=0.01, ha="left", fontsize=8, color=GRID_COLOUR)
    return figure


def save_figure(figure: Figure, folder: Path, name: str, dpi: int) -> None:
    """Write `NAME.svg` and `NAME.png`; equal figures give equal bytes."""
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    figure.savefig(folder / f"{name}.png", dpi=dpi)


def _draw_runs(axes: Axes, panel: Panel, points: Sequence[ChartPoint], colours: dict[str, Colour]) -> None:
    """Draw each run: mesh, field, and validation scores during training."""
    for point in points:
        colour = colours[point.preset]
        place = panel.place(point)
        if place is not None:
            axes.plot(*place, ".", color=colour, markersize=4)
        if panel.curve_column is not None and point.curve:
            seconds, scores = zip(*((row[0], row[panel.curve_column]) for row in point.curve), strict=True)
            axes.plot(seconds, scores, color=colour, linewidth=1, alpha=0.7)
        if panel.field_score in point.scores:
            axes.plot(point.field_seconds, point.scores[panel.field_score], "D", mec=colour, mfc="white", markersize=5)


def _draw_presets(axes: Axes, panel: Panel, points: Sequence[ChartPoint], colours: dict[str, Colour]) -> None:
    """Draw mean and range over the seeds of each preset with its name, and the Pareto front."""
    means = preset_means(points, panel)
    groups = seeds_of_presets(points, panel)
    for preset, point in means.items():
        axes.plot(*point, "o", color=colours[preset], markersize=7)
        least, greatest = np.min(groups[preset], axis=0), np.max(groups[preset], axis=0)
        axes.plot([least[0], greatest[0]], [point[1]] * 2, color=colours[preset], linewidth=2, solid_capstyle="butt")
        axes.plot([point[0]] * 2, [least[1], greatest[1]], color=colours[preset], linewidth=2, solid_capstyle="butt")
        axes.annotate(
            preset.partition(",")[0], point, (7, 4), textcoords="offset points", fontsize=8, color=TEXT_COLOUR
        )
    mean_points = list(means.values())
    front = [mean_points[index] for index in pareto_front(mean_points, panel.higher_is_better)]
    if front:
        seconds, scores = zip(*front, strict=True)
        axes.step(seconds, scores, where="post", color=TEXT_COLOUR, linewidth=1, linestyle=":", zorder=1)
        axes.plot(seconds, scores, "o", color=TEXT_COLOUR, markersize=12, fillstyle="none", linestyle="none")


def _style_axes(axes: Axes, title: str, axis: str) -> None:
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda cost, _: f"{cost:,.12g}"))
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda *_: ""))
    axes.set_xlabel(axis, fontsize=9, color=GRID_COLOUR)
    axes.margins(x=0.15, y=0.12)
    shortest, longest = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=FEW_TICKS if longest > 10.0 * shortest else MANY_TICKS))
    axes.grid(color=GRID_COLOUR, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _legend_entries(panels: Sequence[Panel]) -> list[Line2D]:
    entries = [
        Line2D([], [], color=TEXT_COLOUR, marker="o", linestyle="none", label="mean of the seeds, held-out frames"),
        Line2D([], [], color=TEXT_COLOUR, linewidth=2, label="least to greatest seed"),
        Line2D(
            [], [], color=TEXT_COLOUR, marker="o", markersize=11, fillstyle="none", linestyle=":", label="Pareto front"
        ),
    ]
    if any(panel.curve_column is not None for panel in panels):
        entries += [
            Line2D([], [], mec=TEXT_COLOUR, mfc="white", marker="D", linestyle="none", label="field, held-out frames"),
            Line2D([], [], color=TEXT_COLOUR, linewidth=1, label="field during training, validation frames"),
        ]
    return entries
