"""Drawings of the page: sparklines of parameters, and the figures that reports contain."""

import base64
import binascii
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path

from markupsafe import Markup

from armident.identify.documents.comparison import LEVEL_95
from armident.identify.documents.rounding import alike, plus_minus
from armident.identify.monitoring.change.history import ParameterSeries
from armident.identify.page.cells import LARGEST

WIDTH, HEIGHT, MARGIN = 148.0, 34.0, 4.0
"""Size of a sparkline and its margin, px."""
PICTURE = "data:image/svg+xml;base64,"
_SPARKLINE = Markup(
    '<svg viewBox="0 0 148 34" width="148" height="34" role="img" aria-label="{words}">'
    '<rect class="band" x="0" y="{band[0]}" width="148" height="{band[1]}"/><polyline points="{line}"/>'
    '<line x1="{x}" x2="{x}" y1="{ends[0]}" y2="{ends[1]}"/><circle cx="{x}" cy="{y}" r="2.6"/></svg>'
)


def sparkline(series: ParameterSeries, changed: bool) -> Markup:
    """Return a drawing of a parameter over its runs, with 95 % intervals of the first (band) and the last one."""
    first, last = series.values[0], series.values[-1]
    of_first, of_last = (LEVEL_95 * abs(std) for std in (series.deviations[0], series.deviations[-1]))
    ends = [*series.values, first - of_first, first + of_first, last - of_last, last + of_last]
    scale = (HEIGHT - 2 * MARGIN) / ((max(ends) - min(ends)) or 1.0)
    step = (WIDTH - 2 * MARGIN) / max(len(series.values) - 1, 1)

    def y(value: float) -> float:
        return round(HEIGHT - MARGIN - (value - min(ends)) * scale, 2)

    points = [(round(MARGIN + k * step, 2), y(value)) for k, value in enumerate(series.values)]
    change = f"{alike(first, of_last)[0]} to {plus_minus(last, of_last)} {series.unit}"
    words = f"{series.name}: {change}, runs: {len(series.values)}"
    return _SPARKLINE.format(
        words=f"{words}{', changed' if changed else ''}",
        band=(y(first + of_first), round(2 * of_first * scale, 2)),
        line=" ".join(f"{px},{py}" for px, py in points),
        x=points[-1][0],
        y=points[-1][1],
        ends=(y(last + of_last), y(last - of_last)),
    )


@lru_cache(maxsize=24)
def pictures_of(report: Path, _stamp: str) -> tuple[tuple[str, bytes], ...]:
    """Return the figures of a report, description and SVG, none of one that is too large."""
    if report.stat().st_size > LARGEST:
        return ()
    reader = _Pictures()
    reader.feed(report.read_text(encoding="utf-8", errors="replace"))
    return tuple(reader.found)


class _Pictures(HTMLParser):
    """Collects the figures of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, bytes]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take an image that is in the page."""
        values = dict(attrs)
        source = values.get("src") or ""
        if tag == "img" and source.startswith(PICTURE):
            try:
                svg = base64.b64decode(source.removeprefix(PICTURE), validate=True)
            except binascii.Error:
                return
            self.found.append((values.get("alt") or "", svg))
