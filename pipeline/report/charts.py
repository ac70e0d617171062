"""Bar and line charts as inline SVG. Colours and fonts come from the page's style sheet, light and dark."""

import math
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from pipeline.report.templates import render_macro, render_template

WIDTH = 640
_ROW_HEIGHT, _LABEL_WIDTH, _VALUE_WIDTH = 30, 84, 84
_LINE_CHART_HEIGHT = 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 12, 14, 38


def bar_chart(rows: Sequence[tuple[str, float]], unit: str) -> Markup:
    """Draw horizontal bars (label, value) in the given order; all values share the unit and are not negative.

    Raises:
        ValueError: a value is negative or not finite.
    """
    if any(not math.isfinite(value) or value < 0.0 for _, value in rows):
        raise ValueError(f"bars need finite values of zero and more: {list(rows)}")
    longest = max((value for _, value in rows), default=0.0) or 1.0
    plot_width = WIDTH - _LABEL_WIDTH - _VALUE_WIDTH
    bars = []
    for row, (label, value) in enumerate(rows):
        y, length = row * _ROW_HEIGHT, max(plot_width * value / longest, 1.5)
        bars.append(
            {
                "label": label,
                "value": f"{_format_value(value)} {unit}",
                "y": y + 5,
                "text_y": y + 20,
                "length": f"{length:.1f}",
                "value_x": f"{_LABEL_WIDTH + length + 8:.1f}",
            }
        )
    return render_template(
        "bar_chart.svg.j2",
        width=WIDTH,
        height=len(rows) * _ROW_HEIGHT,
        label_x=_LABEL_WIDTH - 10,
        bar_x=_LABEL_WIDTH,
        bar_height=_ROW_HEIGHT - 10,
        bars=bars,
    )


def line_chart(series: Mapping[str, Sequence[tuple[float, float]]], x_label: str, y_label: str) -> Markup:
    """Draw one line with a dot at each (x, y) for each series; points whose y is not finite are left out.

    The groups have the classes `line-0`, `line-1`, ... in the order of the series.

    Raises:
        ValueError: no point is left.
    """
    points = [(x, y) for line in series.values() for x, y in line if math.isfinite(y)]
    if not points:
        raise ValueError("a line chart needs at least one finite point")
    x_ticks = _ticks(min(x for x, _ in points), max(x for x, _ in points))
    y_ticks = _ticks(min(y for _, y in points), max(y for _, y in points))

    def svg_x(x: float) -> float:
        return _LEFT + (x - x_ticks[0]) / (x_ticks[-1] - x_ticks[0]) * (WIDTH - _LEFT - _RIGHT)

    def svg_y(y: float) -> float:
        plot_height = _LINE_CHART_HEIGHT - _TOP - _BOTTOM
        return _LINE_CHART_HEIGHT - _BOTTOM - (y - y_ticks[0]) / (y_ticks[-1] - y_ticks[0]) * plot_height

    return render_template(
        "line_chart.svg.j2",
        width=WIDTH,
        height=_LINE_CHART_HEIGHT,
        left=_LEFT,
        right=WIDTH - _RIGHT,
        x_label=x_label,
        y_label=y_label,
        x_ticks=[(f"{svg_x(tick):.1f}", _format_value(tick)) for tick in x_ticks],
        y_ticks=[(f"{svg_y(tick) + 4:.1f}", f"{svg_y(tick):.1f}", _format_value(tick)) for tick in y_ticks],
        lines=[
            {"name": name, "points": [(f"{svg_x(x):.1f}", f"{svg_y(y):.1f}") for x, y in line if math.isfinite(y)]}
            for name, line in series.items()
        ],
    )


def legend(names: Sequence[str]) -> Markup:
    """Return the legend of a `line_chart`, in the same order."""
    return render_macro("legend", names)


def _ticks(low: float, high: float) -> list[float]:
    """Return two to eight round numbers in rising order that enclose [low, high]."""
    span = high - low
    if span < 1e-6 * max(abs(low), abs(high), 1.0):  # a single value: widen the range
        span = 0.1 * max(abs(high), 1.0)
    step = 10.0 ** math.floor(math.log10(span / 4.0))
    step *= next(factor for factor in (1, 2, 5, 10) if span / (factor * step) <= 5.0)
    first, last = math.floor(low / step), math.ceil(high / step)
    return [round(step * k, 10) for k in range(first, max(last, first + 1) + 1)]


def _format_value(value: float) -> str:
    """Format with three significant digits and thousands separators: 0.0123, 4.56, 78.9, 1,234."""
    if value == 0.0:
        return "0"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
