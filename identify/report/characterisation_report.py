"""HTML report of a characterisation: friction over speed, ripple spectrum, friction about reversals."""

from typing import TYPE_CHECKING

import numpy as np

from armident.identify.documents.characterisation import CharacterisationDocument
from armident.identify.report.page import INK, MEASURED, MODEL, MUTED, RESIDUAL, figure, render

if TYPE_CHECKING:
    from armident.identify.api.result_tables import Table


def characterisation_report(document: CharacterisationDocument, friction: "Table", curve: "Table") -> str:
    """Return the HTML page of a characterisation, complete in one file."""
    return render(
        "characterisation.html",
        document=document,
        glossary=None,
        friction=friction,
        curve=curve,
        pictures={
            "friction": _friction_figure(document),
            "ripple": _ripple_figure(document),
            "stiffness": _reversal_figure(document),
        },
    )


def _friction_figure(document: CharacterisationDocument) -> str | None:
    """Friction at each speed with 95 % intervals, and the curve through it."""
    found = document.friction
    if found is None:
        return None
    with figure(1, 1, 3.4) as (_, axes, picture):
        ax = axes[0][0]
        for name, colour in (("friction", INK), ("forward", RESIDUAL), ("backward", MODEL)):
            points = [(p.speed, e) for p in found.points if (e := getattr(p, name)) is not None]
            if points:
                half = [e.high - e.value for _, e in points]
                words = "half the difference of both directions" if name == "friction" else name
                ax.errorbar(
                    [v for v, _ in points], [e.value for _, e in points], half,
                    fmt="o", markersize=3, color=colour, capsize=2, linewidth=1, label=words,
                )  # fmt: skip
        for side, colour in ((found.forward, RESIDUAL), (found.backward, MODEL)):
            ax.plot(found.speeds, side, color=colour, linewidth=1)
        ax.set_xscale("log")
        ax.set_xlabel(f"speed, {document.position_unit}/s")
        ax.set_ylabel(f"friction, {document.torque_unit}")
        ax.legend(frameon=False)
    return picture[0]


def _ripple_figure(document: CharacterisationDocument) -> str | None:
    """Amplitude of the ripple over its order, with the noise floor."""
    found = document.ripple
    if found is None:
        return None
    with figure(1, 1, 3.0) as (_, axes, picture):
        ax = axes[0][0]
        ax.plot(found.orders, found.amplitudes, color=MEASURED, linewidth=0.8, label="amplitude")
        ax.plot(found.orders, found.floor, color=MUTED, linewidth=0.8, linestyle="--", label="noise floor")
        for peak in found.peaks:
            size = peak.amplitude
            ax.errorbar(peak.order, size.value, size.high - size.value, fmt="o", markersize=3, color=MODEL, capsize=2)
        ax.set_xlabel("cycles per revolution" if document.position_unit == "rad" else "cycles per metre")
        ax.set_ylabel(f"amplitude, {document.torque_unit}")
        ax.legend(frameon=False)
    return picture[0]


def _reversal_figure(document: CharacterisationDocument) -> str | None:
    """Friction against the travel since a reversal, measured and of the model."""
    found = document.presliding
    if found is None or found.stiffness is None:
        return None
    with figure(1, 1, 3.0) as (_, axes, picture):
        ax, travel = axes[0][0], np.array(found.travel)
        ax.plot(travel, found.measured, ".", markersize=3, color=MEASURED, label="measured")
        ax.plot(travel, found.model, ".", markersize=2, color=MODEL, label="bristle")
        ax.set_xlabel(f"travel since the reversal, {document.position_unit}")
        ax.set_ylabel(f"friction, {document.torque_unit}")
        ax.legend(frameon=False)
    return picture[0]
