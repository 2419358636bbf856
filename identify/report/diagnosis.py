"""The report of a diagnosis: what is missing, how sure, how much of the gap it explains, and what remains."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identify.discrepancy.diagnose import Diagnosis
from identify.discrepancy.where import Disagreement
from identify.document import DiagnosisDocument, Finding
from identify.report.page import BAND, INK, MEASURED, MODEL, MUTED, RESIDUAL, figure, render

Array = NDArray[np.float64]

VERDICTS = {
    "no_gap": "The model explains the data: nothing is missing that these recordings could show.",
    "explained": "Something is missing from the model, and what was found explains it.",
    "partly_explained": "Something is missing from the model; what was found explains a part of it.",
    "unexplained": "Something is missing from the model that no effect of the catalogue explains.",
}
CERTAIN, LIKELY = 0.95, 0.6
"""Confidence from which a finding is called certain, and likely."""
BINS = 14


def diagnosis_report(diagnosis: Diagnosis, document: DiagnosisDocument) -> str:
    """HTML page of a diagnosis, complete in one file."""
    joints = [joint.name for joint in diagnosis.robot.joints]
    hidden: dict[str, list[str]] = {}
    for i in document.not_visible:
        hidden.setdefault(f"{i.effect.replace('_', ' ')}: {i.reason}", []).append(i.joint)
    return render(
        "diagnosis.html",
        document=document,
        could_hide=_could_hide(document),
        verdict=VERDICTS[document.verdict],
        findings=[
            {
                "f": finding,
                "title": finding.evidence.get("title", finding.effect.replace("_", " ")),
                "where": finding.joint if finding.other is None else f"{finding.joint} and {finding.other}",
                "sure": certainty(finding),
                "closed": closed_share(finding, document),
                "rows": _rows(finding),
                "picture": _finding_figure(diagnosis, joints.index(finding.joint)),
            }
            for finding in document.findings
        ],
        gaps=_gap_figure(document),
        map=_map_figure(diagnosis, joints),
        left=[_curve_figure(d, _unit(diagnosis, joints.index(d.joint))) for d in diagnosis.left],
        joints=joints,
        hidden=hidden,
    )


def _could_hide(document: DiagnosisDocument) -> list[dict[str, str]]:
    """Rows of the table of what could hide: effect, place, and the sizes from which on it would have been found."""
    return [
        {
            "effect": h.effect.replace("_", " "),
            "joint": h.joint if h.other is None else f"{h.joint} and {h.other}",
            "below": ", ".join(f"{name} {value:g} {h.units[name]}".rstrip() for name, value in h.below.items()),
        }
        for h in document.could_hide
    ]


def certainty(finding: Finding) -> str:
    """How sure a finding is, in words."""
    rivals = finding.evidence.get("ambiguous_with", [])
    if rivals:
        return "cannot be told apart from " + ", ".join(name.replace("_", " ") for name in rivals)
    if finding.confidence >= CERTAIN:
        return "certain"
    return "likely" if finding.confidence >= LIKELY else "doubtful: something like it, perhaps outside the catalogue"


def closed_share(finding: Finding, document: DiagnosisDocument) -> float | None:
    """Share of the joint's held-out gap above the noise floor that a finding closes; ``None`` if there is no gap."""
    floor = document.noise_floor.by_joint[finding.joint]
    gap = finding.gap_before**2 - floor**2
    if gap <= 0:
        return None
    return float(np.clip((finding.gap_before**2 - finding.gap_after**2) / gap, 0.0, 1.0))


def _rows(finding: Finding) -> list[tuple[str, float, float | None, str]]:
    """Parameters with standard deviation and unit."""
    std, units = finding.evidence.get("std", {}), finding.evidence.get("units", {})
    return [(name, value, std.get(name), units.get(name, "")) for name, value in finding.parameters.items()]


def _gap_figure(document: DiagnosisDocument) -> str:
    """Held-out torque error per joint, before and after, with the noise floor."""
    before, after = document.gap.validation.before.by_joint, document.gap.validation.after.by_joint
    place = np.arange(len(before))
    with figure(1, 1, 2.3) as (_, axes, picture):
        axis = axes[0, 0]
        axis.bar(place - 0.19, list(before.values()), 0.36, color=MEASURED, label="model as configured")
        axis.bar(place + 0.19, list(after.values()), 0.36, color=MODEL, label="with what was found")
        for k, floor in enumerate(document.noise_floor.by_joint.values()):
            axis.hlines(floor, k - 0.42, k + 0.42, color=MUTED, linestyle=(0, (3, 2)), linewidth=1.2)
        axis.plot([], [], color=MUTED, linestyle=(0, (3, 2)), label="noise floor")
        axis.set_xticks(place, list(before))
        axis.set_ylabel("torque error, %")
        axis.grid(axis="x", visible=False)
        axis.legend(frameon=False, ncols=3, loc="upper left", fontsize=8.5)
        axis.set_ylim(0, 1.25 * max([*before.values(), *after.values(), 1e-9]))
    return picture[0]


def _finding_figure(diagnosis: Diagnosis, joint: int) -> str:
    """The joint's held-out residual without and with the findings: over time, and over what it depends on most."""
    name = diagnosis.robot.joints[joint].name
    rest = {
        "before": diagnosis.measured[:, joint] - diagnosis.before[:, joint],
        "after": diagnosis.measured[:, joint] - diagnosis.after[:, joint],
    }
    unit = _unit(diagnosis, joint)
    seen = [d for d in diagnosis.where if d.joint == name]
    with figure(1, 2, 2.7) as (_, axes, picture):
        over_time, over_cause = axes[0]
        for (label, residual), colour in zip(rest.items(), (MEASURED, MODEL), strict=True):
            over_time.plot(diagnosis.t, residual, color=colour, linewidth=0.9, label=label)
        over_time.set_title(f"{name}: measured minus predicted torque, data not used for fitting")
        over_time.set_xlabel("s")
        over_time.set_ylabel(unit)
        over_time.legend(frameon=False, ncols=2, fontsize=8.5, loc="upper left")
        if seen:
            _curve(over_cause, seen[0], unit)
        else:
            speed = diagnosis.qd[:, joint]
            for residual, colour in zip(rest.values(), (MEASURED, MODEL), strict=True):
                centres, means, errors = _binned(speed, residual)
                over_cause.errorbar(centres, means, errors, color=colour, linewidth=1.4, marker="o", markersize=3)
            over_cause.set_title("its mean over joint speed, with two standard errors")
            over_cause.set_xlabel("rad/s" if unit == "N m" else "m/s")
        over_cause.axhline(0, color=MUTED, linewidth=0.6)
    return picture[0]


def _unit(diagnosis: Diagnosis, joint: int) -> str:
    return "N m" if diagnosis.robot.joints[joint].type == "revolute" else "N"


def _curve(axis: Any, d: Disagreement, unit: str) -> None:
    """What the model lacks over the variable that the residual depends on most; of a size, what noise has of it."""
    x, value, band = d.curve.x, d.curve.value, d.curve.band
    low, high = (np.zeros_like(band), band) if d.of_noise else (value - band, value + band)
    axis.fill_between(x, low, high, color=BAND, linewidth=0)
    axis.plot(x, value, color=RESIDUAL, linewidth=1.6)
    axis.set_title(f"what the model as configured lacks, over {d.varies_with}")
    axis.set_xlabel(d.unit)
    axis.set_ylabel(f"{unit}/√Hz" if d.kind == "motion" else unit)


def _map_figure(diagnosis: Diagnosis, joints: Sequence[str]) -> str | None:
    """Share of each joint's held-out residual that each variable predicts, before; with what is left marked."""
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
            remains = " left" if (row, column) in left else ""
            axis.text(
                column, row, f"{100 * shares[row, column]:.0f} %{remains}", ha="center", va="center", fontsize=8.5,
                color="white" if dark else INK,
            )  # fmt: skip
        axis.set_xticks(np.arange(len(kinds)), [k.replace(" of another joint", "\nof another joint") for k in kinds])
        axis.set_yticks(np.arange(len(joints)), list(joints))
        axis.grid(visible=False)
    return picture[0]


def _curve_figure(d: Disagreement, unit: str) -> str:
    """Shape of what is left, in the unit of the joint's torque."""
    with figure(1, 1, 2.3) as (_, axes, picture):
        _curve(axes[0, 0], d, unit)
        over = {"motion": "frequency; shaded: noise", "time, in bursts": "time, from moment to moment; shaded: noise"}
        axes[0, 0].set_title(f"{d.joint}: what remains, over {over.get(d.kind, d.varies_with)}")
        axes[0, 0].axhline(0, color=MUTED, linewidth=0.6)
    return picture[0]


def _binned(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Means of y over equally filled bins of x, with two standard errors."""
    order = np.argsort(x)
    parts = [part for part in np.array_split(order, BINS) if part.size > 1]
    centres = np.array([x[part].mean() for part in parts])
    means = np.array([y[part].mean() for part in parts])
    errors = np.array([2 * y[part].std(ddof=1) / np.sqrt(part.size) for part in parts])
    return centres, means, errors
