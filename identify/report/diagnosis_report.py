"""HTML report of a diagnosis: findings with confidence and gap, detection limits, unexplained residual."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.diagnose import DiagnosisResult
from armident.identify.diagnosis.lack_of_fit import ResidualDependence
from armident.identify.documents.diagnosis import VERDICTS, DiagnosisDocument, Finding
from armident.identify.report.glossary import finding_entries, parameter_meaning
from armident.identify.report.identification_report import torque_plots
from armident.identify.report.page import BAND, INK, MEASURED, MODEL, MUTED, RESIDUAL, figure, render

LEVELS = {"no_gap": "trustworthy", "explained": "doubtful", "partly_explained": "unusable", "unexplained": "unusable"}
"""Colours of the verdicts, by the levels of an identification."""
BINS, FILLED = 14, 5
"""Bins of a variable, and the fewest samples of one that is drawn."""
SHOWN = 700
"""Most samples of one curve."""
FOLLOWS = 0.6
"""Share of the power of a finding's torque that its means over a variable must have to be drawn over it."""


def diagnosis_report(diagnosis: DiagnosisResult, document: DiagnosisDocument) -> str:
    """Return the HTML page of a diagnosis, complete in one file."""
    joints = [joint.name for joint in diagnosis.robot.joints]
    hidden: dict[str, list[str]] = {}
    for i in document.not_visible:
        hidden.setdefault(f"{i.effect.replace('_', ' ')}: {i.reason}", []).append(i.joint)
    units = [_unit(diagnosis, j) for j in range(len(joints))]
    before = diagnosis.before if document.findings else None
    return render(
        "diagnosis.html",
        document=document,
        level=LEVELS[document.verdict],
        torques=torque_plots(diagnosis.t, diagnosis.measured, diagnosis.after, joints, units, before),
        detection_limits=_detection_limits(document),
        glossary=finding_entries(document.findings),
        verdict=VERDICTS[document.verdict],
        findings=[
            {
                "f": finding,
                "title": finding.evidence.get("title", finding.effect.replace("_", " ")),
                "where": finding.joint if finding.other is None else f"{finding.joint} and {finding.other}",
                "probability": posterior_probability(finding),
                "closed": closed_gap_share(finding, document),
                "rows": _rows(finding),
                "picture": _finding_figure(diagnosis, joints.index(finding.joint), lacking, own),
            }
            for finding, lacking, own in zip(document.findings, diagnosis.lacking, diagnosis.own, strict=True)
        ],
        gaps=_gap_figure(document),
        map=_map_figure(diagnosis, joints),
        left=[_curve_figure(d, _unit(diagnosis, joints.index(d.joint))) for d in diagnosis.left],
        joints=joints,
        hidden=hidden,
    )


def _detection_limits(document: DiagnosisDocument) -> list[dict[str, str]]:
    """Return the rows of the table of detection limits."""
    return [
        {
            "effect": h.effect.replace("_", " "),
            "joint": h.joint if h.other is None else f"{h.joint} and {h.other}",
            "limits": ", ".join(f"{name} {value:g} {h.units[name]}".rstrip() for name, value in h.limits.items()),
        }
        for h in document.detection_limits
    ]


def posterior_probability(finding: Finding) -> str:
    """Return the probability of a finding in words, with the other effects of its set."""
    shown = finding.probability
    rivals = ", ".join(name.replace("_", " ") for name in finding.evidence.get("ambiguous_with", []))
    if rivals:
        return f"{shown}, ambiguous with {rivals}"
    doubtful = finding.confidence < Criteria.doubtful
    return f"{shown}, perhaps a similar effect outside the catalogue" if doubtful else shown


def closed_gap_share(finding: Finding, document: DiagnosisDocument) -> float | None:
    """Return the share of the joint's held-out gap above the noise floor that a finding closes, if any."""
    after = finding.gap_after
    floor = min(document.noise_floor.by_joint[finding.joint], after)
    gap = finding.gap_before**2 - floor**2
    if gap <= 0:
        return None
    return float(np.clip((finding.gap_before**2 - after**2) / gap, 0.0, 1.0))


def _rows(finding: Finding) -> list[tuple[str, float, float | None, str, str]]:
    """Return the parameters with standard deviation, unit and meaning."""
    std, units = finding.evidence.get("std", {}), finding.evidence.get("units", {})
    return [
        (name, value, std.get(name), units.get(name, ""), parameter_meaning(name, finding))
        for name, value in finding.parameters.items()
    ]


def _gap_figure(document: DiagnosisDocument) -> str:
    """Return a figure of the held-out torque error per joint, before and after, with the noise floor."""
    before, after = document.gap.validation.before.by_joint, document.gap.validation.after.by_joint
    place = np.arange(len(before))
    with figure(1, 1, 2.3) as (_, axes, picture):
        axis = axes[0, 0]
        axis.bar(place - 0.19, list(before.values()), 0.36, color=MEASURED, label="model as configured")
        axis.bar(place + 0.19, list(after.values()), 0.36, color=MODEL, label="with the findings")
        for k, floor in enumerate(document.noise_floor.by_joint.values()):
            axis.hlines(floor, k - 0.42, k + 0.42, color=MUTED, linestyle=(0, (3, 2)), linewidth=1.2)
        axis.plot([], [], color=MUTED, linestyle=(0, (3, 2)), label="noise floor")
        axis.set_xticks(place, list(before))
        axis.set_ylabel("torque error, %")
        axis.grid(axis="x", visible=False)
        axis.legend(frameon=False, ncols=3, loc="upper left", fontsize=8.5)
        axis.set_ylim(0, 1.25 * max([*before.values(), *after.values(), 1e-9]))
    return picture[0]


def _finding_figure(diagnosis: DiagnosisResult, joint: int, lacking: Array | None, own: Array | None) -> str:
    """Return a figure of the joint's held-out residual without and with a finding, over time and over its variable."""
    name, unit = diagnosis.robot.joints[joint].name, _unit(diagnosis, joint)
    seen = [d for d in diagnosis.where if d.joint == name]
    without = (diagnosis.before if lacking is None else lacking)[:, joint]
    rest = diagnosis.measured[:, joint] - without
    added = diagnosis.after[:, joint] - without
    part = telling_stretch(added)
    with figure(1, 2, 2.7) as (_, axes, picture):
        over_time, over_cause = axes[0]
        curves = (("without the effect", rest, MEASURED), ("with the effect", rest - added, MODEL))
        for label, residual, colour in curves:
            over_time.plot(diagnosis.t[part], residual[part], color=colour, linewidth=1.1, label=label)
        over_time.set_title(f"{name}: measured minus predicted torque, held-out data")
        over_time.set_xlabel("s")
        over_time.set_ylabel(unit)
        over_time.legend(frameon=False, ncols=2, fontsize=8.5, loc="upper left")
        over_time.axhline(0, color=MUTED, linewidth=0.6)
        if lacking is None and seen:
            _curve(over_cause, seen[0], unit)
        else:
            cause = followed_variable(diagnosis, joint, added if own is None else own[:, joint])
            _over_cause(over_cause, rest, added, cause, unit)
        over_cause.axhline(0, color=MUTED, linewidth=0.6)
    return picture[0]


def telling_stretch(added: Array) -> slice:
    """Return the `SHOWN` consecutive samples in which the torque (M,) of a finding has most power."""
    if added.size <= SHOWN:
        return slice(0, added.size)
    power = np.concatenate([[0.0], np.cumsum(added**2)])
    begin = int(np.argmax(power[SHOWN:] - power[:-SHOWN]))
    return slice(begin, begin + SHOWN)


def followed_variable(diagnosis: DiagnosisResult, joint: int, added: Array) -> tuple[str, str, Array]:
    """Return the variable that a finding with torque ``added`` (M,) is drawn over: name, unit, values (M,)."""
    way = "m" if diagnosis.robot.joints[joint].type == "prismatic" else "rad"
    for name, unit, x in (
        ("joint speed", f"{way}/s", diagnosis.qd[:, joint]),
        ("joint position", way, diagnosis.q[:, joint]),
        ("time", "s", diagnosis.t),
    ):
        if _followed(x, added) >= FOLLOWS:
            return name, unit, x
    return "torque of the effect", _unit(diagnosis, joint), added


def _followed(x: Array, added: Array) -> float:
    """Return the share of the power of a torque that its means over a variable have."""
    varying = added - added.mean()
    power = sum(part.size * varying[part].mean() ** 2 for part in _bins(x))
    return float(power / max(varying @ varying, 1e-300))


def _over_cause(axis: Any, rest: Array, added: Array, cause: tuple[str, str, Array], unit: str) -> None:
    """Draw binned means of the residual without an effect, with spread, and of the torque of the effect."""
    name, unit_of_cause, x = cause
    bins = _bins(x)
    centres, mean = ([float(y[part].mean()) for part in bins] for y in (x, added))
    missing, spread = [rest[part].mean() for part in bins], [rest[part].std() for part in bins]
    axis.errorbar(
        centres, missing, spread, color=MUTED, ecolor=MEASURED, linestyle="", marker="o", markersize=4,
        label="residual without the effect: mean and spread",
    )  # fmt: skip
    axis.plot(centres, mean, color=MODEL, linewidth=1.6, label="torque of the effect")
    axis.set_title(f"over {name}")
    axis.set_xlabel(unit_of_cause)
    axis.set_ylabel(unit)
    axis.legend(frameon=False, fontsize=8.5, loc="best")


def _unit(diagnosis: DiagnosisResult, joint: int) -> str:
    return "N m" if diagnosis.robot.joints[joint].type == "revolute" else "N"


def _curve(axis: Any, d: ResidualDependence, unit: str) -> None:
    """Draw a residual dependence with its uncertainty; a spectrum with the noise level."""
    x, value, band = d.curve.x, d.curve.value, d.curve.band
    low, high = (np.zeros_like(band), band) if d.of_noise else (value - band, value + band)
    axis.fill_between(x, low, high, color=BAND, linewidth=0)
    axis.plot(x, value, color=RESIDUAL, linewidth=1.6)
    axis.set_title(f"residual of the model as configured, over {d.varies_with}")
    axis.set_xlabel(d.unit)
    axis.set_ylabel(f"{unit}/√Hz" if d.kind == "motion" else unit)


def _map_figure(diagnosis: DiagnosisResult, joints: Sequence[str]) -> str | None:
    """Return a figure of the share of each joint's residual that each variable predicts, unexplained ones marked."""
    kinds = list(dict.fromkeys(d.kind for d in diagnosis.where))
    if not kinds:
        return None
    shares = np.zeros((len(joints), len(kinds)))
    for d in diagnosis.where:
        at = joints.index(d.joint), kinds.index(d.kind)
        shares[at] = max(shares[at], d.share)
    left = {(joints.index(d.joint), kinds.index(d.kind)) for d in diagnosis.left if d.kind in kinds}
    with figure(1, 1, 0.9 + 0.34 * len(joints)) as (_, axes, picture):
        axis = axes[0, 0]
        axis.imshow(shares, cmap="Blues", vmin=0, vmax=max(0.3, float(shares.max())), aspect="auto")
        for row, column in zip(*np.nonzero(shares >= 0.005), strict=True):
            dark = shares[row, column] > 0.55 * max(0.3, float(shares.max()))
            remains = " unexplained" if (row, column) in left else ""
            axis.text(
                column, row, f"{100 * shares[row, column]:.0f} %{remains}", ha="center", va="center", fontsize=8.5,
                color="white" if dark else INK,
            )  # fmt: skip
        axis.set_xticks(np.arange(len(kinds)), [k.replace(" of another joint", "\nof another joint") for k in kinds])
        axis.set_yticks(np.arange(len(joints)), list(joints))
        axis.grid(visible=False)
    return picture[0]


def _curve_figure(d: ResidualDependence, unit: str) -> str:
    """Return a figure of an unexplained residual dependence, in the unit of the joint's torque."""
    with figure(1, 1, 2.3) as (_, axes, picture):
        _curve(axes[0, 0], d, unit)
        over = "frequency; shaded: noise" if d.kind == "motion" else d.varies_with
        axes[0, 0].set_title(f"{d.joint}: unexplained residual, over {over}")
        axes[0, 0].axhline(0, color=MUTED, linewidth=0.6)
    return picture[0]


def _bins(x: Array) -> list[NDArray[np.intp]]:
    """Return the sample numbers of equally wide bins of a variable, without bins of fewer than `FILLED` samples."""
    number = np.digitize(x, np.linspace(x.min(), x.max(), BINS + 1)[1:-1])
    return [part for k in range(BINS) if (part := np.flatnonzero(number == k)).size >= FILLED]
