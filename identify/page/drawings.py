"""Drawings of the page: sparklines of parameters, and the figures that reports contain."""

import base64
import binascii
from dataclasses import dataclass
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path

from armident.identify.documents.comparison import LEVEL_95
from armident.identify.monitoring.change.history import ParameterSeries
from armident.identify.page.cells import LARGEST

WIDTH, HEIGHT, MARGIN = 148.0, 34.0, 4.0
"""Size of a sparkline and its margin, px."""
PICTURE = "data:image/svg+xml;base64,"


@dataclass(frozen=True)
class Sparkline:
    """Parameter over its runs, px: the band of the first run (top, height), the line, and the last value with interval.

    ``words``: the same as text; ``changed``: True if the test of all parameters names this one.
    """

    name: str
    words: str
    changed: bool
    band: tuple[float, float]
    line: str
    last: tuple[float, float]
    interval: tuple[float, float]


def sparkline(series: ParameterSeries, *, changed: bool) -> Sparkline:
    """Draw a parameter over its runs, with 95 % intervals of the first and the last one."""
    half = [LEVEL_95 * abs(std) for std in (series.deviations[0], series.deviations[-1])]
    first, last = series.values[0], series.values[-1]
    ends = [*series.values, first - half[0], first + half[0], last - half[1], last + half[1]]
    low, high = min(ends), max(ends)
    scale = (HEIGHT - 2 * MARGIN) / ((high - low) or 1.0)
    step = (WIDTH - 2 * MARGIN) / max(len(series.values) - 1, 1)

    def y(value: float) -> float:
        return round(HEIGHT - MARGIN - (value - low) * scale, 2)

    points = [(round(MARGIN + k * step, 2), y(value)) for k, value in enumerate(series.values)]
    runs = "1 run" if len(series.values) == 1 else f"{len(series.values)} runs"
    return Sparkline(
        series.name,
        f"{first:.4g} to {last:.4g} ± {half[1]:.2g} {series.unit} over {runs}{', changed' if changed else ''}",
        changed,
        (y(first + half[0]), round(2 * half[0] * scale, 2)),
        " ".join(f"{x},{y}" for x, y in points),
        points[-1],
        (y(last + half[1]), y(last - half[1])),
    )


@dataclass(frozen=True)
class Picture:
    """Figure of a report: its description, and the SVG file."""

    alt: str
    svg: bytes


@lru_cache(maxsize=24)
def pictures_of(report: Path, _stamp: str) -> tuple[Picture, ...]:
    """Return the figures of a report, none of one that is too large or damaged."""
    if report.stat().st_size > LARGEST:
        return ()
    reader = _Pictures()
    reader.feed(report.read_text(encoding="utf-8", errors="replace"))
    return tuple(reader.found)


class _Pictures(HTMLParser):
    """Collects the figures of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[Picture] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take an image that is in the page."""
        values = dict(attrs)
        source = values.get("src") or ""
        if tag == "img" and source.startswith(PICTURE):
            try:
                svg = base64.b64decode(source.removeprefix(PICTURE), validate=True)
            except binascii.Error:
                return
            self.found.append(Picture(values.get("alt") or "figure of the report", svg))
