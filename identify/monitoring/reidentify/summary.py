"""Text lines of a comparison and of a diagnosis: joint, parameter, values, significance."""

import re

import numpy as np

from armident.configs import RobotConfig
from armident.identify.diagnosis.change_test import ParameterChangeTest
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.rounding import chance

_NAME = re.compile(r"([a-z]+)(\d+)r?(?:_\d+)?$")
CLEAR = 2.0
"""Least difference, in standard deviations, of a parameter that is listed for a changed group: by chance one in 20 has
it, and the group as a whole has been tested before."""

_SHARED = ("ia", "fv", "fc")
"""Kinds of parameters of a coupling of two joints."""

_MEANINGS = {
    "fv": "viscous friction",
    "fc": "Coulomb friction",
    "ia": "rotor inertia",
    "off": "torque offset",
    "mx": "first moment of mass",
    "my": "first moment of mass",
    "mz": "first moment of mass",
}


def change_lines(drift: ParameterChangeTest, robot: RobotConfig) -> list[str]:
    """One line per change of the plant, parameter, group and residual, or one for all parameters together."""
    lines = [f"{' and '.join(found.change.joints)}: {found.words}" for found in drift.explained]
    p_values = {each.name: float(p) for each, p in zip(drift.parameters, drift.p_values, strict=True)}
    lines += [_line(drift, name, robot) + f", {chance(p_values[name])}" for name in drift.changed]
    for group in drift.changed_groups:
        rest = [name for name in group.members if name not in drift.changed]
        if len(rest) == len(group.members):
            where = place_of(rest[0], robot)
            clear = [name for name in rest if _deviations(drift, name) >= CLEAR] or rest
            values = "; ".join(_line(drift, name, robot).removeprefix(f"{where}: ") for name in clear)
            lines.append(f"{where}: {group.kind} ({values}), together {chance(group.p_value)}")
    lines += [each.words for each in drift.changed_residuals]
    if not lines and drift.drifted:
        z = np.abs(drift.difference) / drift.std
        most = ", ".join(drift.parameters[k].name for k in np.argsort(-z)[:3])
        lines.append(
            f"no single parameter changed significantly, all together did ({chance(drift.p_joint)}); most: {most}"
        )
    return lines


def _deviations(drift: ParameterChangeTest, name: str) -> float:
    k = next(k for k, p in enumerate(drift.parameters) if p.name == name)
    return float(abs(drift.difference[k]) / drift.std[k])


def _line(drift: ParameterChangeTest, name: str, robot: RobotConfig) -> str:
    """Return joint, meaning, values and difference in standard deviations of a parameter."""
    k = next(k for k, p in enumerate(drift.parameters) if p.name == name)
    parameter, before = drift.parameters[k], float(drift.before[k])
    share = f" ({100 * (parameter.value - before) / abs(before):+.1f} %)" if before else ""
    return (
        f"{place_of(name, robot)}: {meaning_of(name)} {name} {before:.4g} -> {parameter.value:.4g} "
        f"{parameter.unit}{share}, {_deviations(drift, name):.1f} standard deviations"
    )


def finding_lines(diagnosis: DiagnosisDocument) -> list[str]:
    """Return one line per finding of a diagnosis, and one per unexplained dependence."""
    lines = []
    for finding in diagnosis.findings:
        values = ", ".join(f"{name} {value:.4g}" for name, value in finding.parameters.items())
        where = finding.joint if finding.other is None else f"{finding.joint} and {finding.other}"
        text = finding.evidence.get("description")
        effect = text if isinstance(text, str) else f"{finding.effect.replace('_', ' ')} ({values})"
        lines.append(
            f"{where}: {effect}; probability {finding.probability}, torque error "
            f"{finding.gap_before:.2f} % -> {finding.gap_after:.2f} %"
        )
    return lines + [f"{each.joint}: {each.hint}" for each in diagnosis.unexplained]


def place_of(name: str, robot: RobotConfig) -> str:
    """Return the joint, or the two joints of a coupling, of a base parameter."""
    for coupling in robot.couplings:
        if name in {kind + coupling.name for kind in _SHARED}:
            return " and ".join(coupling.joints)
    match = _NAME.match(name)
    number = 0 if match is None else int(match[2])
    return robot.joints[number - 1].name if 1 <= number <= robot.n else robot.name


def meaning_of(name: str) -> str:
    """Return the meaning of a parameter from the first letters of its name."""
    return next((meaning for kind, meaning in _MEANINGS.items() if name.startswith(kind)), "inertia")
