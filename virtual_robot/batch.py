"""Recordings of virtual arms by the hundred: ``python -m armident.virtual_robot.batch`` answers one request a line.

A request is ``{robot, trajectory, repeats, period, seed, effects, out}``; ``effects`` is a list of ``{effect, joint,
other, parameters, strength, truth, hide}`` whose parameters and truth may be expressions; with ``hide`` false the arm
has the effect anyhow. The answer names the recording, and what parameters and truth have become.
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
    """What expressions may refer to: properties of one joint of the healthy arm, SI, joint side.

    Parameters
    ----------
    q
        Posture (n,) at which ``inertia`` is taken.

    Returns
    -------
    dict
        ``fv``, ``fc``: friction; ``ia``: rotor inertia; ``inertia``: all inertia about the joint; ``speed``,
        ``torque``, ``span``: limits of velocity and torque, and width of the position range; ``ratio``: of the gear.
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
    """A hidden effect of a request with its expressions evaluated, and its truth.

    Raises
    ------
    ConfigError
        Naming the expression that has no value.
    """
    names = [joint.name for joint in robot.joints]
    where, joint = f"{entry['effect']} of {entry['joint']}", entry["joint"]
    scale = joint_scale(robot, names.index(joint), trajectory.start) if joint in names else {}
    scale |= {"s": float(entry.get("strength", 1.0))}
    values = {k: evaluate(v, scale, f"{where}: parameters.{k}") for k, v in entry["parameters"].items()}
    truth = {k: evaluate(v, scale | values, f"{where}: truth.{k}") for k, v in entry.get("truth", {}).items()}
    return HiddenEffect(effect=entry["effect"], joint=joint, other=entry.get("other"), parameters=values), truth


def record(request: Document) -> Document:
    """Simulate one recording and write it.

    Raises
    ------
    ConfigError
        If robot, trajectory or effects are not what the virtual arm takes.
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
