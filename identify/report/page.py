"""What every report shares: the page, its template, and figures drawn into it."""

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, MUTED, MEASURED, MODEL, RESIDUAL, BAND = "#1d2733", "#6b7785", "#b3bac4", "#c2410c", "#2f6f9f", "#dfe8f1"
STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.grid": True,
    "grid.color": "#eceff3",
    "figure.constrained_layout.use": True,
    "svg.hashsalt": "armident",
}

_TEMPLATES = Environment(
    loader=PackageLoader("armident.identify.report", "templates"),
    autoescape=select_autoescape(default=True),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters["g"] = lambda value, digits=4: "" if value is None else f"{value:.{digits}g}"
_TEMPLATES.filters["fixed"] = lambda value, digits=2: "" if value is None else f"{value:.{digits}f}"


def render(template: str, **content: Any) -> str:
    """Fill in a template of this package; the result needs no other file."""
    return _TEMPLATES.get_template(template).render(**content)


@contextmanager
def figure(rows: int, columns: int, height: float) -> Iterator[tuple["Figure", Any, list[str]]]:
    """Draw on a grid of axes; the list receives the picture as a ``data:`` address when the block ends.

    Parameters
    ----------
    rows, columns
        Size of the grid.
    height
        Height of one row, inches.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    picture: list[str] = []
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(10.5, height * rows))
        FigureCanvasAgg(drawing)
        axes = drawing.subplots(rows, columns, squeeze=False)
        yield drawing, axes, picture
        buffer = io.BytesIO()
        drawing.savefig(buffer, format="svg", metadata={"Date": None})
    picture.append("data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode())
