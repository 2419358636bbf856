"""HTML report of an identification: recordings, parameters with uncertainties, residual tests."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.daq.recording import Recording
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.report.glossary import base_entries
from armident.identify.report.page import BAND, CONFIGURED, INK, MEASURED, MODEL, MUTED, RESIDUAL, figure, render
from armident.identify.report.plots import Plot, Series, plots_html

GOOD_PCT = 5.0
"""Relative standard deviation, percent, up to which a parameter counts as well determined."""
FAIR_PCT = 20.0
"""Relative standard deviation, percent, up to which a parameter counts as usable."""


def identification_report(
    recordings: Sequence[Recording],
    robot: RobotConfig,
    result: IdentificationResult | None,
    document: IdentificationDocument,
) -> str:
    """Return the HTML page; ``result`` is ``None``, and ``recordings`` are empty, if only the document is left."""
    joints = [joint.name for joint in robot.joints]
    return render(
        "identification.html",
        document=document,
        robot=robot,
        recorded=[recorded(recording) for recording in recordings],
        essential=_rows(document),
        others=[p for p in document.parameters if not p.essential],
        torques=result and torque_plots(result.t, result.tau_measured, result.tau_predicted, joints, _units(robot)),
        autocorrelation=result
        and _autocorrelation_figure(result.residual_autocorrelation, result.autocorrelation_bound, joints),
        controller=_controller_figure(document.controller),
        least_squares={} if document.comparison is None else {p.name: p.value for p in document.comparison.parameters},
        residuals=_residual_words(document),
        glossary=base_entries(p.name for p in document.parameters),
    )


def recorded(recording: Recording) -> dict[str, Any]:
    """Return the facts of a recording for the report: rate, duration, streams, lost samples."""
    samples = recording.samples
    spans = recording.experiments()
    lost = sum(g.last - g.first + 1 for g in recording.gaps if g.stream == "samples" and g.joint is None)
    inside = sum(int(((samples.sync >= a) & (samples.sync <= b)).sum()) for a, b in spans)
    expected = sum(b - a + 1 for a, b in spans)
    return {
        "file": "(from the stream)" if recording.path is None else recording.path.name,
        "rate_hz": recording.sample_rate_hz,
        "rows": int(samples.sync.size),
        "joints": recording.robot.n,
        "duration_s": float(samples.sync[-1] - samples.sync[0] + 1) / recording.sample_rate_hz,
        "experiments": len(spans),
        "experiment_s": expected / recording.sample_rate_hz,
        "missing": expected - inside,
        "gaps": len(recording.gaps),
        "lost": lost,
        "streams": [
            (s.name, recording.sample_rate_hz / s.every, int(s.sync.size), ", ".join(s.fields))
            for s in recording.streams.values()
        ],
        "counters": sorted(recording.counters.items()),
        "torn": recording.missing,
    }


def torque_plots(
    t: Array, measured: Array, predicted: Array, joints: list[str], units: list[str], before: Array | None = None
) -> Markup:
    """Return plots of measured and predicted torques (M, n) and their difference, one per joint, with common zoom.

    In ``t`` (M,), s, a step back begins another experiment. ``before``: torques (M, n) of the model as configured.
    """
    breaks = np.flatnonzero(np.diff(t) <= 0)
    measured = measured.copy()
    measured[breaks] = np.nan
    t = _continued(t)
    plots = []
    for j, (name, unit) in enumerate(zip(joints, units, strict=True)):
        curves: tuple[Series, ...] = (
            Series("measured", measured[:, j], MEASURED, 2.2),
            Series("model", _broken(predicted[:, j], breaks), MODEL),
            Series("difference", measured[:, j] - predicted[:, j], RESIDUAL, 1.0),
        )
        if before is not None:
            curves += (
                Series("model as configured", _broken(before[:, j], breaks), INK, 0.8),
                Series("difference as configured", measured[:, j] - before[:, j], CONFIGURED, 0.8),
            )
        plots.append(Plot(name, unit, t, curves))
    return plots_html(plots)


def _broken(values: Array, breaks: NDArray[np.intp]) -> Array:
    """Values (M,) with NaN where an experiment ends."""
    values = values.copy()
    values[breaks] = np.nan
    return values


def _autocorrelation_figure(values: Array, bounds: Array, joints: list[str]) -> str:
    columns = min(3, len(joints))
    rows = -(-len(joints) // columns)
    with figure(rows, columns, 1.6) as (_, axes, picture):
        for j, name in enumerate(joints):
            axis, lags = axes.flat[j], np.arange(1, values.shape[1] + 1)
            axis.axhspan(-bounds[j], bounds[j], color=BAND)
            axis.vlines(lags, 0, values[j], color=RESIDUAL, linewidth=1.6)
            axis.axhline(0, color=MUTED, linewidth=0.6)
            limit = max(0.2, 1.2 * float(np.abs(values[j]).max()))
            axis.set_ylim(-limit, limit)
            axis.set_title(name)
        for axis in axes[-1]:
            axis.set_xlabel("lag")
        for axis in axes.flat[len(joints) :]:
            axis.set_visible(False)
    return picture[0]


def _controller_figure(controller: dict[str, Any]) -> str | None:
    described = [joint for joint in controller.get("joints", []) if joint.get("error_taps")]
    if not described:
        return None
    columns = min(3, len(described))
    rows = -(-len(described) // columns)
    with figure(rows, columns, 1.6) as (_, axes, picture):
        for axis, joint in zip(axes.flat, described, strict=False):
            taps = np.asarray(joint["error_taps"], dtype=np.float64)
            axis.vlines(np.arange(taps.size), 0, taps, color=MODEL, linewidth=1.6)
            axis.axhline(0, color=MUTED, linewidth=0.6)
            fit = joint.get("fit_pct")
            axis.set_title(joint["joint"] + ("" if fit is None else f"   fit {fit:.1f} %"))
        for axis in axes[-1]:
            axis.set_xlabel("samples after the error")
        for axis in axes.flat[len(described) :]:
            axis.set_visible(False)
    return picture[0]


def _rows(document: IdentificationDocument) -> list[dict[str, Any]]:
    rows = []
    for p in document.parameters:
        if not p.essential:
            continue
        relative = p.relative_std_pct if p.relative_std_pct is not None else 100.0
        grade = "good" if relative <= GOOD_PCT else "fair" if relative <= FAIR_PCT else "poor"
        rows.append({"p": p, "bar": min(100.0, 100.0 * relative / FAIR_PCT), "grade": grade})
    return rows


def _units(robot: RobotConfig) -> list[str]:
    return ["N m" if joint.type == "revolute" else "N" for joint in robot.joints]


def _residual_words(document: IdentificationDocument) -> str:
    """State in one sentence what the verdict says of the residuals."""
    reasons = [reason.message for reason in document.reasons if reason.kind in ("residual", "uncertainty")]
    if reasons:
        return " ".join(f"{message}." for message in reasons)
    if document.verdict == "unusable":
        return "They were not tested: the result is unusable."
    return "No test finds serial correlation or model error in them."


def _continued(t: Array) -> Array:
    """Return the times (M,) of consecutive experiments on one axis."""
    steps = np.diff(t, prepend=t[0])
    typical = float(np.median(steps[1:])) if t.size > 1 else 0.0
    continued: Array = np.cumsum(np.where(steps <= 0, typical, steps))
    return np.asarray(continued - continued[0])
