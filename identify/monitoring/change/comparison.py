"""Comparison of two identifications, joint by joint: document and table of the change test."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armident.configs import DataError
from armident.identify.diagnosis.change_test import FALSE_ALARMS, ParameterChangeTest, compare
from armident.identify.diagnosis.changed_parameters import ExplainedChange
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.documents.comparison import (
    LEVEL_95,
    ComparedModel,
    ComparedParameter,
    ComparisonDocument,
    NamedChange,
)
from armident.identify.documents.identification import IdentificationDocument, Parameter
from armident.identify.documents.rounding import chance, plus_minus
from armident.identify.effects.terms import terms_of
from armident.identify.identification.saved_model import configuration_of
from armident.identify.monitoring.change.model_differences import model_differences


def compare_models(
    baseline: tuple[IdentificationDocument, Path],
    now: tuple[IdentificationDocument, Path],
    *,
    common: bool = False,
    false_alarms: float = FALSE_ALARMS,
) -> ComparisonDocument:
    """Test two identifications of a robot for a change; ``common``: compare only parameters that both have."""
    (first, first_path), (second, second_path) = baseline, now
    left_out = _different(baseline, now)
    if left_out and first.robot == second.robot:
        if not common:
            raise DataError(
                f"{first_path} and {second_path} have different base parameters ({', '.join(left_out[:5])}): identify "
                "both with one configuration, or compare those that both have with --common"
            )
        first, second = _restricted(first, left_out), _restricted(second, left_out)
    robot = None if left_out else configuration_of(*now)
    result = compare(first, second, false_alarms, robot)
    return _document(result, (first, first_path), (second, second_path), left_out)


def _different(baseline: tuple[IdentificationDocument, Path], now: tuple[IdentificationDocument, Path]) -> list[str]:
    """Return the names of the parameters that do not mean the same in both."""
    one, other = _meanings(*baseline), _meanings(*now)
    if baseline[0].configuration is None or now[0].configuration is None:
        # A document of a former version does not say which curve an effect has.
        one, other = ({name: meaning[0] for name, meaning in each.items()} for each in (one, other))
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))


def _meanings(document: IdentificationDocument, path: Path) -> dict[str, Any]:
    """Return for each parameter what it groups; for one of an effect, the law and its nonlinear parameters, too."""
    robot = configuration_of(document, path)
    terms = {} if robot is None else {n: (t.effect.key, t.place, t.shapes) for t in terms_of(robot) for n in t.names}
    return {p.name: (p.formula or p.name, terms.get(p.name)) for p in document.parameters}


def _restricted(document: IdentificationDocument, without: Sequence[str]) -> IdentificationDocument:
    """Return the identification without some parameters, and without residuals: those depend on all of them."""
    kept = [k for k, p in enumerate(document.parameters) if p.name not in without]
    if not kept:
        raise DataError(f"{document.robot}: the two identifications have no parameter in common")
    covariance = np.array(document.covariance)[np.ix_(kept, kept)].tolist()
    parameters = [document.parameters[k] for k in kept]
    return document.model_copy(update={"parameters": parameters, "covariance": covariance, "residual_statistics": None})


def _document(
    result: ParameterChangeTest,
    baseline: tuple[IdentificationDocument, Path],
    now: tuple[IdentificationDocument, Path],
    left_out: list[str],
) -> ComparisonDocument:
    old = {p.name: p for p in baseline[0].parameters}
    places = joints, couplings = places_of(now[0])
    parameters = [
        _compared(p, old[p.name], joint_of(p.name, *places), float(std), float(p_value), p.name in result.changed)
        for p, std, p_value in zip(result.parameters, result.std, result.p_values, strict=True)
    ]
    order = {name: k for k, name in enumerate([*joints, *couplings])}
    parameters.sort(key=lambda each: order.get(each.joint, len(order)))
    return ComparisonDocument(
        robot=now[0].robot,
        verdict="changed" if result.drifted else "unchanged",
        baseline=_model(*baseline),
        now=_model(*now),
        parameters=parameters,
        changed_groups=[f"{g.kind} {joint_of(g.members[0], *places)}" for g in result.changed_groups],
        changed_residuals=[each.words for each in result.changed_residuals],
        changes=[_named(change, result) for change in result.explained],
        unexplained=[] if result.explanation is None else _unexplained(result),
        chi_square=result.chi_square,
        degrees=result.degrees,
        p_value=result.p_joint,
        false_alarm_rate=result.false_alarms,
        left_out=left_out,
        warnings=_warnings(result, baseline[0], now[0], left_out),
    )


def _named(found: ExplainedChange, result: ParameterChangeTest) -> NamedChange:
    assert result.explanation is not None
    rivals = found.rivals(Criteria.close)
    return NamedChange(
        effect=found.change.effect.name,
        joints=list(found.change.joints),
        words=found.words,
        parameters=found.parameters,
        std=found.deviations,
        probability=found.probability() * result.explanation.share,
        not_excluded=[f"{change.effect.name} of {' and '.join(change.joints)}" for change in rivals],
    )


def _unexplained(result: ParameterChangeTest) -> list[str]:
    """Return what the changes do not explain, in words."""
    assert result.explanation is not None
    names = [result.parameters[k].name for k in result.explanation.unexplained]
    return [*([", ".join(names)] if names else []), *(each.words for each in result.left.changed(result.share))]


def _warnings(
    result: ParameterChangeTest, baseline: IdentificationDocument, now: IdentificationDocument, left_out: Sequence[str]
) -> list[str]:
    lines = []
    if left_out:
        lines.append(
            f"compared on {len(result.parameters)} parameters that both have, without {', '.join(left_out)}: the "
            "others may take over what these explain, and differ although the arm has not changed"
        )
    lines += model_differences(
        baseline, now, {p.name: float(s) for p, s in zip(result.parameters, result.std, strict=True)}
    )
    if baseline.recording.sha256 == now.recording.sha256:
        lines.append(
            "both were identified from the same recording: their errors are not independent, as the test needs"
        )
    if result.residuals.reason and not left_out:
        lines.append(result.residuals.reason)
    doubtful = [name for name, each in (("baseline", baseline), ("now", now)) if each.verdict == "doubtful"]
    if doubtful:
        lines.append(f"the verdict of {' and of '.join(doubtful)} is doubtful: standard deviations may be too small")
    return lines


def _model(document: IdentificationDocument, path: Path) -> ComparedModel:
    return ComparedModel(
        path=str(path),
        method=document.method,
        recording=document.recording,
        relative_error_pct=document.relative_error_pct,
    )


def _compared(
    now: Parameter, before: Parameter, joint: str, std: float, p_value: float, changed: bool
) -> ComparedParameter:
    return ComparedParameter(
        name=now.name,
        joint=joint,
        unit=now.unit,
        before=before.value,
        before_std=before.std,
        now=now.value,
        now_std=now.std,
        std_of_difference=std,
        p_value=p_value,
        changed=changed,
        essential=now.essential or before.essential,
    )


def joint_of(parameter: str, joints: Sequence[str], couplings: Sequence[str] = ()) -> str:
    """Joint or coupling at the end of a parameter's name (``zz1r``, ``iam6``, ``fva2_2``); else the name itself."""
    name = re.sub(r"_\d+$", "", parameter)
    for coupling in couplings:
        if re.fullmatch(rf"(ia|fv|fc){re.escape(coupling)}r?", name):
            return coupling
    match = re.fullmatch(r".*?(\d+)r?", name)
    number = 0 if match is None else int(match[1])
    return joints[number - 1] if 1 <= number <= len(joints) else name


def places_of(document: IdentificationDocument) -> tuple[list[str], list[str]]:
    """Return the names of the joints and of the couplings."""
    configuration = document.configuration or {}
    return list(document.relative_error_pct_by_joint), [each["name"] for each in configuration.get("couplings", [])]


def comparison_table(document: ComparisonDocument) -> None:
    """Print the verdict of a comparison, and the essential and the changed parameters with 95 % intervals by joint."""
    from rich.console import Console

    console = Console()
    colour = "red" if document.verdict == "changed" else "green"
    console.print(f"verdict: {document.verdict}", style=f"bold {colour}", highlight=False)
    console.print(f"{document.sentence}.", highlight=False, soft_wrap=True, markup=False)
    for change in document.changes:
        if change.not_excluded:
            text = f"{change.effect} of {' and '.join(change.joints)}; not excluded: {', '.join(change.not_excluded)}"
            console.print(text, highlight=False, soft_wrap=True, markup=False)
    for each in document.unexplained:
        console.print(f"not explained: {each}", highlight=False, soft_wrap=True, markup=False)
    rows = {p.name: _row(p) for p in document.parameters if p.essential or p.changed}
    # Lines of plain text: a table that does not fit into the terminal would break names.
    head = ("parameter", "before", "now", "difference", "unit")
    widths = [max(len(row[k]) for row in (head, *rows.values())) for k in range(len(head))]

    def line(cells: Sequence[str]) -> str:
        middle = [cell.rjust(width) for cell, width in zip(cells[1:-1], widths[1:-1], strict=True)]
        return "  ".join([cells[0].ljust(widths[0]), *middle, cells[-1]])

    print(f"parameters with 95 % intervals\n  {line(head)}")
    for joint, parameters in document.by_joint.items():
        shown = [p for p in parameters if p.name in rows]
        if shown:
            print(joint)
        for p in shown:
            print(f"  {line(rows[p.name])}{f'  changed, {chance(p.p_value)}' if p.changed else ''}")
    hidden = len(document.parameters) - len(rows)
    if hidden:
        print(f"{hidden} parameters that are not essential and have not changed are in the report")


def _row(p: ComparedParameter) -> tuple[str, str, str, str, str]:
    """Return name, both values and their difference with 95 % intervals, and unit."""
    values = ((p.before, p.before_std), (p.now, p.now_std), (p.now - p.before, p.std_of_difference))
    before, now, difference = (plus_minus(value, LEVEL_95 * std) for value, std in values)
    return p.name, before, now, difference, p.unit
