"""Tables of the commands on stdout."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.cli.print_table import print_table
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.rounding import alike, plus_minus
from armident.identify.effects.terms import arm_model

if TYPE_CHECKING:
    from armident.identify.documents.prediction import PredictionDocument, PredictionsDocument


def design_table(robot: RobotConfig, theta: Array | None, std: Array) -> None:
    """Print base parameters (b,), if known, and their predicted standard deviations (b,)."""
    table = Table(title=f"{robot.name}: predicted precision, base parameters", title_justify="left")
    names = arm_model(robot).base.names
    for column in ("parameter", "value", "std", "std %") if theta is not None else ("parameter", "std"):
        table.add_column(column, justify="left" if column == "parameter" else "right")
    if theta is None:
        for name, deviation in zip(names, std, strict=True):
            table.add_row(name, f"{deviation:.4g}")
    for name, value, deviation in () if theta is None else zip(names, theta, std, strict=True):
        relative = "" if value == 0 else f"{100 * deviation / abs(value):.1f}"
        table.add_row(name, *alike(value, deviation), relative)
    print_table(table)


def wanted_table(std: Mapping[str, float]) -> None:
    """Print the predicted standard deviations of the parameters of the wanted effects, by name."""
    table = Table(title="predicted precision, wanted effect", title_justify="left")
    table.add_column("parameter")
    table.add_column("std", justify="right")
    for name, deviation in std.items():
        table.add_row(name, f"{deviation:.4g}" if np.isfinite(deviation) else "not visible")
    print_table(table)


COLOURS = {"trustworthy": "green", "doubtful": "yellow", "unusable": "red"}
"""Colours of the levels of a verdict."""


def verdict_lines(document: IdentificationDocument) -> None:
    """Print the verdict of an identification, its reasons, and the next step of each."""
    level = document.verdict or "not judged"
    console = Console()
    console.print(f"verdict: {level}", style=f"bold {COLOURS.get(level, 'default')}", highlight=False)
    for reason in document.reasons:
        console.print(
            f"- {reason.message}.", style=COLOURS[reason.level], highlight=False, soft_wrap=True, markup=False
        )
        console.print(f"  Next: {reason.next_step}.", highlight=False, soft_wrap=True, markup=False)


def identification_table(document: IdentificationDocument) -> None:
    """Print the essential parameters with their standard deviations, beside the IDIM-LS estimate."""
    beside = {} if document.comparison is None else {p.name: p for p in document.comparison.parameters}
    table = Table(title=f"{document.robot}: {document.method}, essential parameters", title_justify="left")
    table.add_column("parameter")
    table.add_column("value", justify="right")
    table.add_column("std", justify="right")
    table.add_column("std %", justify="right")
    table.add_column("unit")
    if beside:
        table.add_column("idim-ls", justify="right")
    for p in document.parameters:
        if not p.essential:
            continue
        relative = "" if p.relative_std_pct is None else f"{p.relative_std_pct:.2f}"
        row = [p.name, *alike(p.value, p.std), relative, p.unit]
        table.add_row(*row, *([alike(beside[p.name].value, p.std)[0]] if beside else []))
    console = Console()
    print_table(table, console)
    essential = sum(p.essential for p in document.parameters)
    errors = ", ".join(f"{name} {value:.1f}" for name, value in document.relative_error_pct_by_joint.items())
    held_out = "" if document.held_out_error_pct is None else f"; {document.held_out_error_pct:.2f} % on held-out data"
    coloured = any(reason.kind in ("residual", "uncertainty") for reason in document.reasons)
    tested = document.verdict in ("trustworthy", "doubtful")
    residuals = f"; residuals are {'not ' if coloured else ''}noise" if tested else ""
    console.print(
        f"{essential} of {len(document.parameters)} base parameters are essential; "
        f"relative torque error {document.relative_error_pct:.4f} % ({errors}){held_out}",
        highlight=False,
        soft_wrap=True,
    )
    for line in (document.transition_sentence, f"{document.iterations} iterations{residuals}"):
        if line:
            console.print(line, highlight=False, soft_wrap=True)


def diagnosis_table(document: DiagnosisDocument) -> None:
    """Print the verdict, the findings with their gaps on held-out data, and the unexplained residual."""
    console = Console()
    console.print(f"verdict: {document.verdict}", highlight=False)
    if document.findings:
        table = Table(title="findings", title_justify="left")
        for heading in ("joint", "effect", "parameters", "confidence", "held-out gap"):
            table.add_column(heading)
        for f in document.findings:
            std = f.evidence.get("std", {})
            values = ", ".join(f"{k} {plus_minus(v, std.get(k))}" for k, v in f.parameters.items())
            where = f.joint if f.other is None else f"{f.joint}, {f.other}"
            closed = f"{f.gap_before:.2f} % → {f.gap_after:.2f} %"
            table.add_row(where, f.effect, values, f.probability, closed)
        print_table(table, console)
        for f in document.findings:
            console.print(f"{f.joint}: {f.evidence['description']}", highlight=False)
    for e in document.explanations:
        if e.doubtful:
            console.print(f"{e.joint}: 90 % set: {e.sentence}", highlight=False, soft_wrap=True)
    for u in document.unexplained:
        console.print(f"unexplained: {u.sentence}", highlight=False, soft_wrap=True)
    if document.transitions:
        found = ", ".join(f"{joint} {1e3 * velocity:.3g}" for joint, velocity in document.transitions.items())
        console.print(
            f"dry friction reverses over a velocity of (mrad/s, mm/s): {found}", highlight=False, soft_wrap=True
        )
    if document.recommended_experiment is not None:
        console.print(f"next experiment: {document.recommended_experiment}", highlight=False)
    gap = document.gap.validation
    console.print(
        f"torque error on held-out data: {gap.before.all:.2f} % before, {gap.after.all:.2f} % after", highlight=False
    )


def prediction_table(document: "PredictionDocument") -> None:
    """Print the error of a model on a recording, in total and by joint."""
    console = Console()
    console.print(document.sentence, highlight=False, soft_wrap=True)
    table = Table(title=f"{document.robot}: torque errors by joint", title_justify="left")
    for heading in ("joint", "error %", "own data %", "error rms", "torque rms", "unit"):
        table.add_column(heading, justify="left" if heading in ("joint", "unit") else "right")
    for name, error in document.relative_error_pct_by_joint.items():
        own = document.identification_error_pct_by_joint.get(name)
        row = [name, f"{error:.2f}", "" if own is None else f"{own:.2f}"]
        table.add_row(*row, f"{document.error_rms[name]:.4g}", f"{document.torque_rms[name]:.4g}", document.units[name])
    print_table(table, console)


def predictions_table(document: "PredictionsDocument") -> None:
    """Print the errors of a model on several recordings, and the worst one."""
    console = Console()
    table = Table(title=f"{document.robot}: torque errors by recording", title_justify="left")
    headings = ("recording", "error %", "worst joint", "its error %", "held out", "samples")
    for heading in headings:
        table.add_column(heading, justify="right" if "%" in heading or heading == "samples" else "left")
    for each in document.predictions:
        joint, error = max(each.relative_error_pct_by_joint.items(), key=lambda pair: pair[1])
        held_out = "yes" if each.held_out else "no"
        name = each.recording.path or "(in memory)"
        table.add_row(name, f"{each.relative_error_pct:.2f}", joint, f"{error:.2f}", held_out, str(each.samples))
    print_table(table, console)
    own = document.predictions[0].identification_error_pct
    worse = "; the model explains the torques of a recording no better than none" if document.worthless else ""
    console.print(
        f"Worst torque error {document.worst_error_pct:.2f} % ({document.worst_recording}); "
        f"on its own data {own:.2f} %{worse}.",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )
