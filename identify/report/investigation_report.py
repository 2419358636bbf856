"""HTML report of an investigation: what it could have been, what was asked, what the arm answered."""

from collections.abc import Sequence

import numpy as np

from armident.configs import RobotConfig, Trajectory
from armident.identify.documents.diagnosis import Explanation
from armident.identify.documents.investigation import OUTCOMES, InvestigationDocument, InvestigationRound
from armident.identify.report.page import MEASURED, MODEL, MUTED, RESIDUAL, figure, render

LEVELS = {"healthy": "trustworthy", "named": "doubtful", "running": "doubtful"}
"""Colours of the outcomes, by the levels of an identification; those not listed are red."""
NAMES = 6
"""Names of a joint that are drawn."""
PERIOD = 0.01
"""Period of the drawn motion, s."""


def investigation_report(
    document: InvestigationDocument, trajectories: Sequence[Trajectory | None], robot: RobotConfig
) -> str:
    """Return the HTML page of an investigation, complete in one file."""
    after = [*(one.explanations for one in document.rounds), document.explanations][1:]
    return render(
        "investigation.html",
        document=document,
        level=LEVELS.get(document.outcome, "unusable"),
        meaning=OUTCOMES[document.outcome],
        glossary=None,
        rounds=[
            {"round": one, "picture": _round_figure(one, later, trajectory, robot)}
            for one, later, trajectory in zip(document.rounds, after, trajectories, strict=True)
        ],
    )


def _round_figure(
    asked: InvestigationRound, after: Sequence[Explanation], trajectory: Trajectory | None, robot: RobotConfig
) -> str:
    """Return the figure of a round: probabilities before and after the answer, and the motion."""
    joint = asked.chosen.joint or next((e.joint for e in asked.explanations if e.doubtful), robot.joints[0].name)
    before, later = (_names(entries, joint) for entries in (asked.explanations, after))
    names = sorted(before | later, key=lambda name: -max(before.get(name, 0.0), later.get(name, 0.0)))[:NAMES][::-1]
    with figure(1, 2, 2.4) as (_, axes, picture):
        left, right = axes[0]
        place = np.arange(len(names))
        left.barh(place + 0.19, [before.get(name, 0.0) for name in names], 0.36, color=MEASURED, label="before")
        left.barh(place - 0.19, [later.get(name, 0.0) for name in names], 0.36, color=MODEL, label="after the answer")
        left.set_yticks(place, [name.replace("_", " ") for name in names])
        left.set_xlim(0.0, 1.0)
        left.set_title(f"{joint}: probability of each explanation")
        left.legend(frameon=False)
        if trajectory is not None:
            q = trajectory.sample(PERIOD)
            for k, each in enumerate(robot.joints):
                moved = each.name in (asked.chosen.joint, asked.chosen.other)
                right.plot(PERIOD * np.arange(len(q)), q[:, k], color=RESIDUAL if moved else MUTED, linewidth=1.0)
        right.set_title("motion: position of each joint, rad or m")
        right.set_xlabel("time, s")
    return picture[0]


def _names(entries: Sequence[Explanation], joint: str) -> dict[str, float]:
    """Return the probabilities of the most uncertain explanation of a joint."""
    own = [entry for entry in entries if entry.joint == joint]
    return max(own, key=lambda entry: -max(entry.names.values())).names if own else {}
