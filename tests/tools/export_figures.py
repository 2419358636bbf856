"""Torque differences of every export format for every named effect: the table of docs/export-model.md.

.venv/bin/python -m tests.tools.export_figures [--effects NAME,...] [--formats NAME,...]
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from armident.configs import RobotConfig, load_robot
from armident.configs.schema.robot import Effect
from armident.identify.effects.registry import of_entry
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formats import export_model
from armident.identify.model_export.verification import motion_of
from tests.model_exports import exported
from tests.pinocchio_oracle import random_parameters

JOINT = "joint_2"
"""Joint that has the effect."""

RESONANCE_HZ = 20.0
"""Resonance of the elastic joint."""

FORMATS = ("mjcf", "c", "python", "fmu", "sdf", "urdf", "pinocchio")

EFFECTS: dict[str, tuple[dict[str, float], tuple[float, ...]]] = {
    "": ({}, ()),
    "stribeck_friction": ({"velocity": 0.1, "displacement": 0.0}, (4.0,)),
    "stribeck_friction on a bristle": ({"velocity": 0.1, "displacement": 1e-4}, (4.0, 4.0)),
    "stribeck_friction/exponential": ({"velocity": 0.1}, (4.0,)),
    "asymmetric_coulomb_friction": ({"velocity": 0.05}, (2.0,)),
    "asymmetric_viscous_friction": ({}, (2.0,)),
    "nonlinear_viscous_friction": ({"velocity": 0.3}, (2.0,)),
    "load_dependent_friction": ({"rotor": 0.0}, (0.05,)),
    "presliding_friction": ({"displacement": 1e-3}, (-4.0,)),
    "position_dependent_friction": ({"period": 2.0}, (1.5, 1.5)),
    "friction_drift": ({"time_constant": 1.5}, (2.0, 1.0)),
    "friction_drift/work": ({"decay": 0.7}, (2.0, 1.0)),
    "joint_elasticity": ({"frequency": RESONANCE_HZ, "damping": 0.1, "rotor": 0.0}, (math.nan,)),
    "joint_elasticity with its motor": ({"frequency": RESONANCE_HZ, "damping": 0.1, "rotor": 0.25}, (math.nan,)),
    "backlash": ({"gap": 2e-4, "rotor": 0.0}, (1.0,)),
    "backlash with its motor": ({"gap": 2e-4, "rotor": 0.25}, (1.0,)),
    "cogging_torque": ({"harmonic": 6.0}, (1.5, 1.5)),
    "joint_spring": ({}, (20.0,)),
}
"""Nonlinear and linear parameters of each effect, of moderate size; the compliance follows from the resonance."""


def model_with(name: str) -> ExportedModel:
    """Return the TX40 with random parameters and an effect at its second joint."""
    robot: RobotConfig = load_robot("tx40")
    shapes, values = EFFECTS[name]
    if name:
        effect, _, law = name.partition(" ")[0].partition("/")
        entry = Effect(effect=effect, law=law, joint=JOINT, parameters=shapes)
        assert {*shapes} <= {shape.name for shape in of_entry(entry).shapes}
        robot = robot.model_copy(update={"effects": (entry,)})
    arm = arm_model(robot)
    theta = random_parameters(arm, np.random.default_rng(5), friction=True)
    theta[len(arm.names) - arm.e :] = 0.0
    if values and math.isnan(values[0]):
        # Links as torques determine them: with rotor inertias that cannot be told from theirs.
        links = np.where(arm.of_links, arm.standard_from_base(arm.base.regroup @ theta), 0.0)
        still = np.zeros((1, arm.n))
        postures = arm.motion(still, still, still, dt=1.0).postures
        mean = float(arm.mass_matrix(links, postures)[:, 1, 1].mean())
        values = (1.0 / ((mean - shapes["rotor"]) * (2.0 * np.pi * RESONANCE_HZ) ** 2),)
    theta[len(arm.names) - arm.e :] = values
    return exported(robot, theta)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--formats", default=",".join(FORMATS))
    options = parser.parse_args(arguments)
    formats = options.formats.split(",")
    print(f"| effect | share of the torque | {' | '.join(f'`{each}`' for each in formats)} |")
    print("| --- | --- |" + " --- |" * len(formats))
    for name in options.effects.split(","):
        model = model_with(name)
        with TemporaryDirectory() as folder:
            cells = [cell(model, each, Path(folder)) for each in formats]
        print(f"| {name or 'none'} | {share(model)} | {' | '.join(cells)} |", flush=True)


def share(model: ExportedModel) -> str:
    """Return the torque of the effects over the whole torque along the motion."""
    motion = motion_of(model)
    whole = model.model.inverse_dynamics(motion.q, motion.qd, motion.qdd, dt=motion.dt)
    rigid = model.arm.inverse_dynamics(model.theta, motion.q, motion.qd, motion.qdd)
    return f"{100.0 * float(np.linalg.norm(whole - rigid) / np.linalg.norm(whole)):.2g} %"


def cell(model: ExportedModel, format_name: str, folder: Path) -> str:
    """Return the figure of a format; a second one with its module of what it leaves out, or that it leaves it out."""
    _, sheet = export_model(model, format_name, folder / format_name, motion_of(model))
    found = sheet.measured
    assert found is not None
    if found.error_pct is None:
        return found.missing
    kept = all(any(effect.title in part for part in sheet.held) for effect in model.effects)
    if found.error_pct_with_supplement is not None:
        return f"{_percent(found.error_pct)}; {_percent(found.error_pct_with_supplement)}"
    return f"{_percent(found.error_pct)}{'' if kept else ', left out'}"


def _percent(value: float) -> str:
    return "0 %" if value < 1e-5 else f"{value:.2g} %"


if __name__ == "__main__":
    main()
