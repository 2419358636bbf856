"""The report of a diagnosis: where model and data disagree, what is missing, and how much of the gap it closes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from identify.discrepancy.diagnose import Diagnosis
from identify.document import DiagnosisDocument
from identify.report.page import MEASURED, MODEL, MUTED, RESIDUAL, figure, render

Array = NDArray[np.float64]

VERDICTS = {
    "no_gap": "The model explains the data: nothing is missing that this recording could show.",
    "explained": "Something is missing from the model, and what was found explains it.",
    "partly_explained": "Something is missing from the model; what was found explains a part of it.",
    "unexplained": "Something is missing from the model that no effect of the catalogue explains.",
}
BINS = 12


def diagnosis_report(diagnosis: Diagnosis, document: DiagnosisDocument) -> str:
    """HTML page of a diagnosis, complete in one file."""
    joints = [joint.name for joint in diagnosis.robot.joints]
    return render(
        "diagnosis.html",
        document=document,
        verdict=VERDICTS[document.verdict],
        findings=[
            {
                "f": finding,
                "says": finding.evidence["says"],
                "share": finding.evidence.get("share_of_residual"),
                "friction": finding.evidence.get("relative_to_friction_pct"),
                "picture": _finding_figure(diagnosis, joints.index(finding.joint)),
            }
            for finding in document.findings
        ],
        gaps=_gap_figure(document),
        joints=joints,
    )


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
    """Residual of the joint over its speed, and over time, without and with the findings."""
    rest = {
        "without": diagnosis.measured[:, joint] - diagnosis.before[:, joint],
        "with": diagnosis.measured[:, joint] - diagnosis.after[:, joint],
    }
    speed = diagnosis.qd[:, joint]
    with figure(1, 2, 2.5) as (_, axes, picture):
        for (label, residual), colour in zip(rest.items(), (MODEL, RESIDUAL), strict=True):
            axes[0, 0].plot(diagnosis.t, residual, color=colour, linewidth=0.8, label=f"{label} the finding")
            centres, means, errors = _binned(speed, residual)
            axes[0, 1].errorbar(
                centres, means, errors, color=colour, linewidth=1.4, marker="o", markersize=3, capsize=2
            )
        axes[0, 0].set_title("held-out residual over time")
        axes[0, 0].set_xlabel("s")
        axes[0, 0].legend(frameon=False, ncols=2, fontsize=8.5, loc="upper left")
        axes[0, 1].axhline(0, color=MUTED, linewidth=0.6)
        axes[0, 1].set_title("its mean over joint speed, with two standard errors")
        axes[0, 1].set_xlabel("rad/s")
    return picture[0]


def _binned(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Means of y over equally filled bins of x, with two standard errors."""
    order = np.argsort(x)
    parts: list[NDArray[Any]] = [part for part in np.array_split(order, BINS) if part.size > 1]
    centres = np.array([x[part].mean() for part in parts])
    means = np.array([y[part].mean() for part in parts])
    errors = np.array([2 * y[part].std(ddof=1) / np.sqrt(part.size) for part in parts])
    return centres, means, errors
