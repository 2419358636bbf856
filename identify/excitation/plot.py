"""Plot of a trajectory: positions, velocities, accelerations and torques against their limits."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from armident.configs import ConfigError, Joint, RobotConfig
from armident.identify.excitation.design import PERIOD, Design
from armident.identify.excitation.point_to_point import sample_trajectory

SUFFIXES = (".png", ".svg", ".pdf")
"""Formats of the plot."""
LINE, LIMIT, OUTSIDE = "#2a5d8f", "#b5403a", "#f6dfdd"


def draw(robot: RobotConfig, design: Design, path: Path, title: str) -> None:
    """Plot a trajectory, one row per joint, in the format of the suffix (`SUFFIXES`)."""
    check_name(path)
    q, qd, qdd = sample_trajectory(design.trajectory, PERIOD)
    time = np.arange(len(q)) * PERIOD
    columns = [("position", "", q), ("velocity", "/s", qd), ("acceleration", "/s²", qdd)]
    if design.torque is not None:
        columns.append(("torque", "", design.torque))
    figure = Figure(figsize=(3.4 * len(columns), 1.5 * robot.n + 1.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(robot.n, len(columns), sharex=True, squeeze=False)
    for j, joint in enumerate(robot.joints):
        turns = joint.type == "revolute"
        for k, (name, per, values) in enumerate(columns):
            low, high = limits_of(joint, name)
            unit = ("N m" if turns else "N") if name == "torque" else f"{'rad' if turns else 'm'}{per}"
            axis = axes[j, k]
            margin = 0.12 * (high - low)
            axis.axhspan(low - margin, low, color=OUTSIDE, lw=0)
            axis.axhspan(high, high + margin, color=OUTSIDE, lw=0)
            axis.axhline(low, color=LIMIT, lw=0.8)
            axis.axhline(high, color=LIMIT, lw=0.8)
            axis.plot(time, values[:, j], color=LINE, lw=1.1)
            axis.set_ylim(
                min(low - margin, float(values[:, j].min()) - margin),
                max(high + margin, float(values[:, j].max()) + margin),
            )
            axis.set_xlim(0.0, time[-1])
            axis.tick_params(labelsize=7)
            axis.set_ylabel(f"{joint.name}\n{unit}" if k == 0 else unit, fontsize=8)
            used = float(np.abs(values[:, j] - (low + high) / 2).max()) / ((high - low) / 2)
            axis.annotate(
                f"{100 * used:.0f} %",
                (0.99, 0.95),
                xycoords="axes fraction",
                ha="right",
                va="center",
                fontsize=7,
                color=LIMIT if used > 1.0 else "0.35",
            )
            if j == 0:
                axis.set_title(name, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("s", fontsize=8)
    figure.suptitle(title, fontsize=10)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise ConfigError(f"--picture {path}: cannot be written: {error.strerror}") from error


def check_name(path: Path) -> None:
    """Check the suffix of the file of a plot. Raises ConfigError if its suffix is not in `SUFFIXES`."""
    if path.suffix not in SUFFIXES:
        raise ConfigError(f"--picture {path}: expected a name that ends in {', '.join(SUFFIXES)}")


def limits_of(joint: Joint, name: str) -> tuple[float, float]:
    """Return the lower and upper limit of a joint's ``position``, ``velocity``, ``acceleration`` or ``torque``."""
    if name == "position":
        return joint.limits.position
    most = float(getattr(joint.limits, name))
    return -most, most
