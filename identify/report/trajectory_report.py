"""HTML report of a trajectory: limits, distances between bodies, predicted precision."""

from typing import Any

import numpy as np
from markupsafe import Markup

from armident.configs import RobotConfig
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.design import ASSUMED_NOISE, PERIOD, Design
from armident.identify.excitation.plot import limits_of
from armident.identify.excitation.point_to_point import sample_trajectory
from armident.identify.excitation.safety import CheckedTrajectory
from armident.identify.identification.identification_result import units
from armident.identify.report.glossary import base_entries
from armident.identify.report.identification_report import FAIR_PCT, GOOD_PCT
from armident.identify.report.page import MODEL, RESIDUAL, render
from armident.identify.report.plots import Plot, Series, plots_html

MOTION_EVERY, DISTANCE_EVERY = 5, 20
"""Samples of `PERIOD` from one drawn point to the next."""


def trajectory_report(found: CheckedTrajectory) -> str:
    """Return the HTML page of a trajectory, complete in one file."""
    robot, design = found.robot, found.design
    names = arm_model(robot).base.names
    torque = None
    if design.torque is not None:
        torque = float((np.abs(design.torque) / [joint.limits.torque for joint in robot.joints]).max())
    return render(
        "trajectory.html",
        found=found,
        robot=robot,
        design=design,
        torque=torque,
        motion=_motion(robot, design),
        distance=_distance(found),
        rows=_rows(found, names),
        assumed_noise=ASSUMED_NOISE,
        slow={joint.name: share for joint, share in zip(robot.joints, design.slow_share, strict=True)},
        glossary=base_entries(names),
    )


def _motion(robot: RobotConfig, design: Design) -> dict[str, Markup]:
    """Return the plots of positions, velocities, accelerations and torques of all joints, by quantity."""
    q, qd, qdd = sample_trajectory(design.trajectory, PERIOD)
    time = np.arange(0, len(q), MOTION_EVERY, dtype=np.float64) * PERIOD
    quantities = {"position": ("", q), "velocity": ("/s", qd), "acceleration": ("/s²", qdd)}
    if design.torque is not None:
        quantities = {"torque": ("", design.torque)} | quantities
    groups = {}
    for name, (per, values) in quantities.items():
        plots = []
        for j, joint in enumerate(robot.joints):
            turns = joint.type == "revolute"
            unit = ("N m" if turns else "N") if name == "torque" else f"{'rad' if turns else 'm'}{per}"
            low, high = limits_of(joint, name)
            curve = Series(name, values[::MOTION_EVERY, j], MODEL)
            plots.append(Plot(joint.name, unit, time, (curve,), (("lower limit", low), ("upper limit", high))))
        groups[name] = plots_html(plots)
    return groups


def _distance(found: CheckedTrajectory) -> Markup | None:
    """Return the plot of the smallest distance between bodies; ``None`` if there are none to compare."""
    if found.design.closest is None:
        return None
    q = found.design.trajectory.sample(PERIOD)[::DISTANCE_EVERY]
    time = np.arange(len(q), dtype=np.float64) * PERIOD * DISTANCE_EVERY
    collision = found.safety.collision
    curve = Series("smallest distance", collision.profile(q), RESIDUAL)
    return plots_html([Plot("distance between bodies", "m", time, (curve,), (("clearance", collision.clearance),))])


def _rows(found: CheckedTrajectory, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return the predicted precision of the base parameters; relative to their values where these are known."""
    rows = []
    for k, (name, unit) in enumerate(zip(names, units(arm_model(found.robot)), strict=True)):
        row: dict[str, Any] = {"name": name, "unit": unit, "std": float(found.std[k]), "value": None, "grade": ""}
        if found.prior is not None:
            value = float(found.prior.theta[k])
            relative = min(100.0 * row["std"] / max(abs(value), 1e-300), 1e3)
            grade = "good" if relative <= GOOD_PCT else "fair" if relative <= FAIR_PCT else "poor"
            bar = min(100.0, 100.0 * relative / FAIR_PCT)
            row |= {"value": value, "relative": relative, "bar": bar, "grade": grade}
        rows.append(row)
    return rows
