"""Templates and figures of the reports."""

import base64
import io
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from armident.identify.documents.rounding import alike, chance
from armident.identify.report.glossary import CONVENTIONS, in_words, mentioned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Matplotlib warns that it builds its font cache, which is no matter of the user's.
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)

INK, MUTED, MEASURED, MODEL, RESIDUAL, BAND = "#1d2733", "#6b7785", "#b3bac4", "#c2410c", "#2f6f9f", "#dfe8f1"
CONFIGURED = "#8fb4d1"
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


def templates_of(package: str) -> Environment:
    """Return the HTML templates of a package's folder ``templates``, with the filters of the reports."""
    found = Environment(
        loader=PackageLoader(package, "templates"),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters["code"] = lambda text: Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))
    found.filters["words"] = in_words
    found.filters["mentioned"] = mentioned
    found.filters["alike"] = alike
    found.filters["chance"] = chance
    found.filters["g"] = lambda value, digits=4: "" if value is None else f"{value:.{digits}g}"
    found.filters["fixed"] = lambda value, digits=2: "" if value is None else f"{value:.{digits}f}"
    return found


_TEMPLATES = templates_of("armident.identify.report")
_TEMPLATES.globals["conventions"] = CONVENTIONS
_TEMPLATES.globals["plot_hint"] = Markup(
    '<p class="hint">Drag over a plot to zoom all of them, double-click to see all again. '
    "The line below a plot reads the values under the pointer; a click on a name hides its curve.</p>"
)


def render(template: str, **content: Any) -> str:
    """Return the HTML page of a file in ``templates``; it needs no other file."""
    return _TEMPLATES.get_template(template).render(**content)


@contextmanager
def figure(rows: int, columns: int, height: float) -> Iterator[tuple["Figure", Any, list[str]]]:
    """Draw on a grid of axes, ``height`` inches a row; the list finally receives the picture as a ``data:`` URL."""
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
