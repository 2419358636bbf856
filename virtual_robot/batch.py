"""Batch simulation of recordings: ``python -m armident.virtual_robot.batch`` answers one request per line.

A request is ``{robot, trajectory, repeats, period, seed, effects, out}``. ``effects`` is a list of ``{effect, joint,
other, parameters, strength, truth, hide}`` whose parameters and truth may be expressions. With ``hide`` false the arm
has the effect already. The answer contains the path of the recording and the values of parameters and truth.
"""

import time
from pathlib import Path

import numpy as np

from armident.configs import RobotConfig, Trajectory, load_robot, load_trajectory
from armident.configs.exchange import Document, serve
from armident.configs.expression import evaluate
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.daq.recording import write_recording
from armident.virtual_robot.inertias import plant_parameters
from armident.virtual_robot.offline import simulate_recording
from armident.virtual_robot.plant import Plant


def joint_scale(robot: RobotConfig, joint: int, q: tuple[float, ...]) -> dict[str, float]:
    """Properties of one joint of the healthy arm for use in expressions, SI, joint side.

    Parameters
    ----------
    robot
        The robot.
    joint
        Number of the joint.
    q
        Posture of ``inertia``, rad or m, length n.

    Returns
    -------
    dict
        ``fv``, ``fc``: friction; ``ia``: rotor inertia; ``inertia``: total inertia about the joint; ``speed``,
        ``torque``, ``span``: limits of velocity and torque, and width of the position range; ``ratio``: gear ratio.
    """
    standard, limits = plant_parameters(robot), robot.joints[joint].limits
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


def resolved(entry: Document, robot: RobotConfig, trajectory: Trajectory) -> tuple[HiddenEffect, dict[str, float]]:
    """Hidden effect of a request with evaluated expressions, and its true parameters.

    Parameters
    ----------
    entry
        Element of ``effects`` of a request.
    robot
        The robot.
    trajectory
        Its trajectory, whose start is the posture of `joint_scale`.

    Raises
    ------
    ConfigError
        If an expression has no value; names the expression.
    """
    names = [joint.name for joint in robot.joints]
    where, joint = f"{entry['effect']} of {entry['joint']}", entry["joint"]
    scale = joint_scale(robot, names.index(joint), trajectory.start) if joint in names else {}
    scale |= {"s": float(entry.get("strength", 1.0))}
    values = {k: evaluate(v, scale, f"{where}: parameters.{k}") for k, v in entry["parameters"].items()}
    truth = {k: evaluate(v, scale | values, f"{where}: truth.{k}") for k, v in entry.get("truth", {}).items()}
    return HiddenEffect(effect=entry["effect"], joint=joint, other=entry.get("other"), parameters=values), truth


def record(request: Document) -> Document:
    """Simulate one recording, write it, and return the answer.

    Parameters
    ----------
    request
        The request.

    Raises
    ------
    ConfigError
        If robot, trajectory or effects are not valid for the virtual arm.
    """
    begin = time.perf_counter()
    robot, once = load_robot(request["robot"]), load_trajectory(request["trajectory"])
    trajectory = once.model_copy(update={"moves": once.moves * int(request.get("repeats", 1))})
    both = [resolved(entry, robot, once) for entry in request.get("effects", [])]
    entries = request.get("effects", [])
    hidden = tuple(effect for (effect, _), entry in zip(both, entries, strict=True) if entry.get("hide", True))
    scenario = Scenario(schema="armident/scenario/1", effects=hidden) if hidden else None
    recording = simulate_recording(
        robot, trajectory, int(request["seed"]), scenario=scenario, period=request["period"], setpoint_every=1
    )
    write_recording(recording, Path(request["out"]))
    return {
        "recording": request["out"],
        "effects": [effect.model_dump(mode="json") for effect, _ in both],
        "truth": [truth for _, truth in both],
        "seconds": time.perf_counter() - begin,
    }


if __name__ == "__main__":
    serve(record)
