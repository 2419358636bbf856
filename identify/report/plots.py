"""Interactive line plots of the reports: data for ``templates/plots.js``, which every page contains."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from armident.arrays import Array

MOST_POINTS = 4000
"""Largest number of points of a plot: two for every pixel of a wide screen."""

DIGITS = 5
"""Significant digits of values in a page."""


@dataclass(frozen=True, eq=False)
class Series:
    """Curve of values ``y`` (M,); NaN breaks it. ``half``: half widths (M,) of intervals: points with bars instead."""

    name: str
    y: Array
    colour: str
    width: float = 1.2
    half: Array | None = None


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves over a common ascending axis ``x`` (M,); ``limits`` are horizontal lines with names.

    ``names``: of the points at integer ``x`` from 0, or empty for numbers. ``readings``: text that is read at each
    point, or empty for the values of the curves. ``signed_log``: vertical axis that is linear about zero and
    logarithmic beyond 1, in both directions.
    """

    title: str
    unit: str
    x: Array
    series: tuple[Series, ...]
    limits: tuple[tuple[str, float], ...] = ()
    x_unit: str = "s"
    names: tuple[str, ...] = ()
    readings: tuple[str, ...] = ()
    signed_log: bool = False


def plots_html(plots: Sequence[Plot]) -> Markup:
    """Return a group of plots that share zoom and pointer, as HTML. ``plots``: plots over axes of one unit."""
    content = json.dumps([_data(plot) for plot in plots], separators=(",", ":"), allow_nan=False)
    safe = content.replace("<", "\\u003c")
    return Markup(f'<div class="plots"><script type="application/json">{safe}</script></div>')


def kept_points(curves: Sequence[Array], most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Return the indices of at most ``most`` points, extremes of each curve (M,), and of all breaks (NaN)."""
    size = curves[0].size
    if size <= most:
        return np.arange(size)
    stretches = max(1, most // (2 * len(curves)) - 1)
    edges = np.linspace(0, size, stretches + 1).astype(int)
    kept = {0, size - 1}
    for curve in curves:
        kept.update(int(k) for k in np.flatnonzero(np.isnan(curve)))
        high, low = (np.where(np.isnan(curve), end, curve) for end in (-np.inf, np.inf))
        for first, last in pairwise(edges):
            kept.update((first + int(np.argmax(high[first:last])), first + int(np.argmin(low[first:last]))))
    return np.array(sorted(kept))


def _data(plot: Plot) -> dict[str, object]:
    kept = np.arange(len(plot.names)) if plot.names else kept_points([series.y for series in plot.series])
    return {
        "title": plot.title,
        "unit": plot.unit,
        "x_unit": plot.x_unit,
        "x": [round(float(value), 6) for value in plot.x[kept]],
        "series": [_curve(series, kept) for series in plot.series],
        "limits": [{"name": name, "y": _number(value)} for name, value in plot.limits if np.isfinite(value)],
        "names": list(plot.names),
        "readings": list(plot.readings),
        "signed_log": plot.signed_log,
    }


def _curve(series: Series, kept: NDArray[np.intp]) -> dict[str, object]:
    half = None if series.half is None else [_number(value) for value in series.half[kept]]
    y = [_number(value) for value in series.y[kept]]
    return {"name": series.name, "colour": series.colour, "width": series.width, "y": y, "half": half}


def _number(value: float) -> float | None:
    return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
