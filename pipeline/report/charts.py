"""Small charts as inline SVG. Colours and fonts come from the page, so that they follow its light or dark theme."""

import math
from collections.abc import Mapping, Sequence
from html import escape

WIDTH = 640
_ROW = 30
_LABEL = 84
_VALUE = 84
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 12, 14, 38


def bar_chart(rows: Sequence[tuple[str, float]], unit: str) -> str:
    """Horizontal bars in the given order, each with its value; all values >= 0, same unit.

    Raises ValueError when a value is negative or not finite.
    """
    if any(not math.isfinite(value) or value < 0.0 for _, value in rows):
        raise ValueError(f"bars need finite values of zero and more: {list(rows)}")
    longest = max((value for _, value in rows), default=0.0) or 1.0
    plot_width = WIDTH - _LABEL - _VALUE
    parts = []
    for row, (label, value) in enumerate(rows):
        y, length = row * _ROW, max(plot_width * value / longest, 1.5)
        parts.append(
            f'<text class="tick" x="{_LABEL - 10}" y="{y + 20}" text-anchor="end">{escape(label)}</text>'
            f'<rect class="bar" x="{_LABEL}" y="{y + 5}" width="{length:.1f}" height="{_ROW - 10}" rx="4"/>'
            f'<text class="value" x="{_LABEL + length + 8:.1f}" y="{y + 20}">{_short(value)} {escape(unit)}</text>'
        )
    return _svg(len(rows) * _ROW, parts)


def line_chart(series: Mapping[str, Sequence[tuple[float, float]]], x_label: str, y_label: str) -> str:
    """Lines with a dot at each (x, y); not finite values of y are left out. Classes `line-0`, `line-1`, ... by order.

    Raises ValueError when no point is left.
    """
    height = 250
    points = [(x, y) for line in series.values() for x, y in line if math.isfinite(y)]
    if not points:
        raise ValueError("a line chart needs at least one finite point")
    x_ticks = _ticks(min(x for x, _ in points), max(x for x, _ in points))
    y_ticks = _ticks(min(y for _, y in points), max(y for _, y in points))

    def to_svg_coordinates(x: float, y: float) -> tuple[float, float]:
        across = (x - x_ticks[0]) / (x_ticks[-1] - x_ticks[0])
        up = (y - y_ticks[0]) / (y_ticks[-1] - y_ticks[0])
        return _LEFT + across * (WIDTH - _LEFT - _RIGHT), height - _BOTTOM - up * (height - _TOP - _BOTTOM)

    parts = []
    for tick in y_ticks:
        y = to_svg_coordinates(x_ticks[0], tick)[1]
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{_short(tick)}</text>')
    for tick in x_ticks:
        x = to_svg_coordinates(tick, y_ticks[0])[0]
        parts.append(f'<text class="tick" x="{x:.1f}" y="{height - 20}" text-anchor="middle">{_short(tick)}</text>')
    parts.append(f'<text class="tick" x="{WIDTH - _RIGHT}" y="{height - 3}" text-anchor="end">{escape(x_label)}</text>')
    for number, (name, line) in enumerate(series.items()):
        dots = [to_svg_coordinates(x, y) for x, y in line if math.isfinite(y)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in dots)
        circles = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3"/>' for x, y in dots)
        title = f"<title>{escape(name)}, {escape(y_label)}</title>"
        parts.append(f'<g class="line-{number}">{title}<polyline points="{path}"/>{circles}</g>')
    return _svg(height, parts)


def legend(names: Sequence[str]) -> str:
    """The key of a `line_chart`'s series, in the same order."""
    keys = (f'<span><i class="key-{number}"></i>{escape(name)}</span>' for number, name in enumerate(names))
    return f'<p class="legend">{"".join(keys)}</p>'


def _ticks(low: float, high: float) -> list[float]:
    """Between three and eight round numbers that enclose [low, high]; at least two different ones."""
    span = high - low
    if span < 1e-6 * max(abs(low), abs(high), 1.0):  # one value: room around it
        span = 0.1 * max(abs(high), 1.0)
    step = 10.0 ** math.floor(math.log10(span / 4.0))
    step *= next(factor for factor in (1, 2, 5, 10) if span / (factor * step) <= 5.0)
    first, last = math.floor(low / step), math.ceil(high / step)
    return [round(step * k, 10) for k in range(first, max(last, first + 1) + 1)]


def _short(value: float) -> str:
    """Three significant digits and thousands separated: 0.0123, 4.56, 78.9, 1,234."""
    if value == 0.0:
        return "0"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _svg(height: int, parts: Sequence[str]) -> str:
    return f'<svg class="chart" viewBox="0 0 {WIDTH} {height}" role="img">{"".join(parts)}</svg>'
