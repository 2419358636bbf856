"""Result of the recursive estimator as a document of one line, and as a table for the terminal."""

from typing import Any

import numpy as np
from rich.table import Table

from armident.configs import RobotConfig
from armident.identify.documents.base import plain
from armident.identify.monitoring.recursive.estimator import RecursiveResult

SCHEMA = "armident/recursive/1"
"""Schema of the published document."""
DRIFTED = 0.06
"""Relative change of friction that is shown as drifted although the test is silent, 1: the mean of its two changes."""

BOTH_DIRECTIONS = (
    "friction: mean of both directions; a change of one direction counts half, its other half is an offset that is not "
    "tested; reidentify and compare test it"
)
"""Note under the table of friction: one-sided friction counts half in it."""


def joint_states(result: RecursiveResult) -> list[str]:
    """State of each joint: ``alarm``, ``drifted``, ``unchanged``, ``too little motion`` or ``no motion``."""
    states = []
    for j in range(result.valid.size):
        if result.alarm[j]:
            states.append("alarm")
        elif np.isfinite(result.valid[j]):
            states.append("drifted" if abs(result.valid[j]) > DRIFTED else "unchanged")
        else:
            states.append("too little motion" if result.information[j] > 0 else "no motion")
    return states


def document(result: RecursiveResult, robot: RobotConfig) -> dict[str, Any]:
    """Return the document that ``armident watch`` publishes and prints; values that are not valid are null."""
    states = joint_states(result)
    joints = [
        {
            "joint": joint.name,
            "state": states[j],
            "friction_change": {
                "raw": result.raw[j], "raw_std": result.raw_std[j],
                "filtered": result.filtered[j], "filtered_std": result.filtered_std[j], "valid": result.valid[j],
            },
            "excitation": {"information": result.information[j], "needed": result.needed_information},
            "level": result.level[j],
            "evidence": {"nats": result.evidence[j], "threshold": result.threshold},
            "alarm": {"motion_s": result.alarm_s[j], "change": result.alarm_change[j]} if result.alarm[j] else None,
            "noise_std": result.noise_std[j],
            "lag_s": result.lag_s[j],
        }
        for j, joint in enumerate(robot.joints)
    ]  # fmt: skip
    parameters = [
        {"name": name, "reference": before, "raw": raw, "filtered": filtered, "std": std, "valid": valid}
        for name, before, raw, filtered, std, valid in zip(
            result.names, result.reference, result.parameters_raw, result.parameters_filtered, result.parameters_std,
            result.parameters_valid, strict=True,
        )
    ]  # fmt: skip
    content: dict[str, Any] = plain(
        {
            "schema": SCHEMA,
            "robot": robot.name,
            "sync": result.sync,
            "motion_s": result.motion_s,
            "friction_of": "mean of both directions",
            "joints": joints,
            "parameters": parameters,
            "gaps": result.gaps,
            "without_reference": result.without_reference,
            "repeated": result.repeated,
        }
    )
    return content


def friction_table(result: RecursiveResult, robot: RobotConfig) -> Table:
    """Return the table of ``armident watch``: one row per joint. ``result``: state of the estimator."""
    table = Table(title=f"{robot.name}: {result.motion_s:.0f} s of motion", caption=BOTH_DIRECTIONS)
    for heading in ("joint", "excitation", "friction / reference", "evidence, nats", "state"):
        table.add_column(heading, justify="left" if heading in ("joint", "state") else "right")
    for j, (joint, state) in enumerate(zip(robot.joints, joint_states(result), strict=True)):
        share = 100.0 * min(result.information[j] / result.needed_information, 1.0)
        now = "-"
        if np.isfinite(result.valid[j]):
            now = f"{1.0 + result.valid[j]:.3f} ± {2.0 * result.filtered_std[j]:.3f}"
        words = state.upper() if state == "alarm" else state
        if result.alarm[j]:
            words += f": {100.0 * result.alarm_change[j]:+.0f} % at {result.alarm_s[j]:.0f} s"
        table.add_row(joint.name, f"{share:.0f} %", now, f"{result.evidence[j]:.1f} of {result.threshold:.1f}", words)
    return table
