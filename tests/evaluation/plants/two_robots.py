"""Simulates recordings of the two virtual robots.

A request has the keys ``robot``, ``trajectory``, ``repeats``, ``period``, ``seed``, ``effects`` and ``out``. An effect
has ``effect``, ``joint``, ``other``, ``parameters``, ``strength``, ``truth`` and ``hide``. ``parameters`` and ``truth``
may be expressions; an effect with ``hide: false`` is part of the healthy arm already. The answer has the keys
``effects``, ``truth`` and ``seconds``.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np

from armident.configs import RobotConfig, Trajectory, load_robot, load_trajectory
from armident.configs.expression import evaluate
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.daq.recording import write_recording
from armident.virtual_robot.arm_parameters import arm_parameters
from armident.virtual_robot.offline import simulate_recording
from armident.virtual_robot.plant import Plant

Json = dict[str, Any]
"""A JSON object."""


def joint_scale(robot: RobotConfig, joint: int, q: tuple[float, ...]) -> dict[str, float]:
    """Properties of a joint (from 0) of the healthy arm that expressions may use, SI, joint side.

    ``fv``, ``fc``: viscous and Coulomb friction; ``ia``: rotor inertia; ``inertia``: diagonal of the mass matrix at
    posture ``q`` (n,); ``speed``, ``torque``: limits; ``span``: width of the position range; ``ratio``: gear ratio.
    """
    standard, limits = arm_parameters(robot).standard, robot.joints[joint].limits
    return {
        "fv": standard[f"fv{joint + 1}"],
        "fc": standard[f"fc{joint + 1}"],
        "ia": standard[f"ia{joint + 1}"],
        "inertia": float(Plant(robot, q).mass_matrix()[joint, joint]),
        "speed": limits.velocity,
        "torque": limits.torque,
        "span": limits.position[1] - limits.position[0],
        "ratio": float(np.abs(robot.transmission_matrix[joint, joint])),
    }


def resolve_effect(entry: Json, robot: RobotConfig, trajectory: Trajectory) -> tuple[HiddenEffect, dict[str, float]]:
    """Evaluate the expressions of an element of ``effects``; joint inertias are those at the start of the trajectory.

    Returns the effect with numeric parameters, and the true values of those that the diagnosis estimates. An expression
    without a value is a ConfigError that names it.
    """
    names = [joint.name for joint in robot.joints]
    place, joint = f"{entry['effect']} of {entry['joint']}", entry["joint"]
    scale = joint_scale(robot, names.index(joint), trajectory.start) if joint in names else {}
    scale |= {"s": float(entry.get("strength", 1.0))}
    values = {k: evaluate(v, scale, f"{place}: parameters.{k}") for k, v in entry["parameters"].items()}
    truth = {k: evaluate(v, scale | values, f"{place}: truth.{k}") for k, v in entry.get("truth", {}).items()}
    return HiddenEffect(effect=entry["effect"], joint=joint, other=entry.get("other"), parameters=values), truth


def simulate(request: Json) -> Json:
    """Simulate the recording of a request, write it to ``out``, and return the answer; see the module's docstring."""
    begin = time.perf_counter()
    robot, once = load_robot(request["robot"]), load_trajectory(request["trajectory"])
    trajectory = once.model_copy(update={"moves": once.moves * int(request.get("repeats", 1))})
    entries = request.get("effects", [])
    resolved = [resolve_effect(entry, robot, once) for entry in entries]
    hidden = tuple(effect for (effect, _), entry in zip(resolved, entries, strict=True) if entry.get("hide", True))
    scenario = Scenario(schema="armident/scenario/1", effects=hidden) if hidden else None
    recording = simulate_recording(
        robot, trajectory, int(request["seed"]), scenario=scenario, period=request["period"], setpoint_every=1
    )
    write_recording(recording, Path(request["out"]))
    return {
        "effects": [effect.model_dump(mode="json") for effect, _ in resolved],
        "truth": [truth for _, truth in resolved],
        "seconds": time.perf_counter() - begin,
    }
