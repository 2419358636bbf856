"""HTML report of a comparison of two models: verdict, differences joint by joint, values with intervals."""

from collections.abc import Sequence

import numpy as np

from armident.identify.documents.comparison import LEVEL_95, ComparedParameter, ComparisonDocument
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.rounding import plus_minus
from armident.identify.report.glossary import base_entries, in_words
from armident.identify.report.page import MODEL, MUTED, RESIDUAL, render
from armident.identify.report.plots import Plot, Series, plots_html


def comparison_report(document: ComparisonDocument, glossary_of: IdentificationDocument) -> str:
    """Return the HTML page of a comparison; its glossary explains the parameters of ``glossary_of``."""
    return render(
        "comparison.html",
        document=document,
        plots={joint: plots_html([_plot(joint, parameters)]) for joint, parameters in document.by_joint.items()},
        level=LEVEL_95,
        glossary=base_entries(p.name for p in glossary_of.parameters),
    )


def _plot(joint: str, parameters: Sequence[ComparedParameter]) -> Plot:
    """Plot both values of the parameters of a joint with 95 % intervals, in standard deviations of the difference."""
    scale = np.array([p.std_of_difference for p in parameters])
    shift = np.array([p.now - p.before for p in parameters]) / scale
    before, now = (
        LEVEL_95 * np.array([getattr(p, f"{end}_std") for p in parameters]) / scale for end in ("before", "now")
    )
    changed = np.array([p.changed for p in parameters])
    series = [
        Series("before", 0.0 * shift, MUTED, 1.6, before),
        Series("now", np.where(changed, np.nan, shift), RESIDUAL, 1.6, now),
    ]
    if changed.any():
        series.append(Series("now, changed", np.where(changed, shift, np.nan), MODEL, 1.6, now))
    limits = tuple(
        (f"95 % of differences without a change: {sign * LEVEL_95:.3g}", sign * LEVEL_95) for sign in (-1, 1)
    )
    return Plot(
        joint,
        "standard deviations of the difference",
        np.arange(len(parameters), dtype=np.float64),
        tuple(series),
        limits,
        names=tuple(p.name for p in parameters),
        readings=tuple(map(_reading, parameters)),
        signed_log=True,
    )


def _reading(p: ComparedParameter) -> str:
    """Return both values of a parameter with 95 % intervals, in words and with its unit."""
    words = in_words(p.name)
    values = (("before", p.before, p.before_std), ("now", p.now, p.now_std))
    estimates = ", ".join(f"{when} {plus_minus(value, LEVEL_95 * std)}" for when, value, std in values)
    return f"{p.name}{f' ({words})' if words else ''}: {estimates} {p.unit}"
