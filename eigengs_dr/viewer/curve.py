"""A small chart of one curve, as SVG that takes the colours of the page around it."""

from __future__ import annotations

import math
from collections.abc import Sequence

WIDTH, HEIGHT = 300, 170
"""Size of the chart in pixels."""

LEFT, RIGHT, TOP, BOTTOM = 44, 12, 24, 34
"""Space around the curve, in pixels."""


def draw_curve(points: Sequence[tuple[float, float]], x_name: str, y_name: str) -> str:
    """Draw a curve with the smallest and the largest value along each axis.

    Parameters
    ----------
    points : sequence of (float, float)
        x and y; points that are not finite are left out.
    x_name, y_name : str
        Names of the axes.

    Returns
    -------
    str
        SVG; empty for fewer than two points.
    """
    finite = [p for p in points if all(map(math.isfinite, p))]
    if len(finite) < 2:
        return ""
    (x0, x1), (y0, y1) = ((min(v), max(v)) for v in zip(*finite, strict=True))
    right, floor = WIDTH - RIGHT, HEIGHT - BOTTOM

    def place(x: float, y: float) -> str:
        across = (x - x0) / ((x1 - x0) or 1)
        up = (y - y0) / ((y1 - y0) or 1)
        return f"{LEFT + across * (right - LEFT):.1f},{floor - up * (floor - TOP):.1f}"

    line = " ".join(place(x, y) for x, y in finite)
    texts = (
        (LEFT, TOP - 10, "start", y_name),
        (LEFT - 6, TOP + 4, "end", f"{y1:.4g}"),
        (LEFT - 6, floor + 4, "end", f"{y0:.4g}"),
        (LEFT, floor + 16, "start", f"{x0:.3g}"),
        (right, floor + 16, "end", f"{x1:.3g}"),
        ((LEFT + right) / 2, floor + 30, "middle", x_name),
    )
    labels = "".join(
        f'<text x="{x}" y="{y}" text-anchor="{anchor}" fill="currentColor">{text}</text>'
        for x, y, anchor, text in texts
    )
    axes = f"M{LEFT},{TOP}V{floor}H{right}"
    return (
        f'<svg width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'style="font: 11px sans-serif"><title>{y_name} over {x_name}</title>'
        f'<path d="{axes}" fill="none" stroke="currentColor" opacity="0.5"/>'
        f'<polyline points="{line}" fill="none" stroke="#1f77b4" stroke-width="2"/>{labels}</svg>'
    )
