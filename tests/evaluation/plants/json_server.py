"""Server that simulates recordings of virtual arms: ``python -m tests.evaluation.plants.json_server``.

It reads one JSON request per line from standard input and writes one JSON answer per line to standard output.

A request has the keys ``robot``, ``trajectory``, ``repeats``, ``period``, ``seed``, ``effects`` and ``out``; ``id`` is
returned in the answer. ``effects`` is a list of ``{effect, joint, other, parameters, strength, truth, hide}``;
``parameters`` and ``truth`` may be expressions; an effect with ``hide: false`` is part of the healthy arm already.
The answer has the keys ``recording``, ``effects``, ``truth`` and ``seconds``, or ``error``.
"""

import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from armident.configs import ArmidentError, RobotConfig, Trajectory, load_robot, load_trajectory
from armident.configs.expression import evaluate
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.daq.recording import write_recording
from armident.virtual_robot.arm_parameters import arm_parameters
from armident.virtual_robot.offline import simulate_recording
from armident.virtual_robot.plant import Plant

Json = dict[str, Any]
"""A JSON object."""


def joint_scale(robot: RobotConfig, joint: int, q: tuple[float, ...]) -> dict[str, float]:
    """Return the properties of a joint of the healthy arm that expressions may use, SI, joint side.

    ``joint``: index of the joint, from 0; ``q``: posture (n,) at which ``inertia`` is evaluated, rad or m. Result:
    ``fv``, ``fc``: viscous and Coulomb friction; ``ia``: rotor inertia; ``inertia``: diagonal element of the mass
    matrix; ``speed``, ``torque``: limits; ``span``: width of the position range; ``ratio``: gear ratio.
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
    """Evaluate the expressions of an effect.

    ``entry``: element of ``effects`` of a request. ``trajectory``: the trajectory; joint inertias are evaluated at its
    start. Returns ``effect``: the effect with numeric parameters; ``truth``: true values of the parameters that the
    diagnosis estimates, by name. Raises ConfigError if an expression has no value; the message names it.
    """
    names = [joint.name for joint in robot.joints]
    place, joint = f"{entry['effect']} of {entry['joint']}", entry["joint"]
    scale = joint_scale(robot, names.index(joint), trajectory.start) if joint in names else {}
    scale |= {"s": float(entry.get("strength", 1.0))}
    values = {k: evaluate(v, scale, f"{place}: parameters.{k}") for k, v in entry["parameters"].items()}
    truth = {k: evaluate(v, scale | values, f"{place}: truth.{k}") for k, v in entry.get("truth", {}).items()}
    return HiddenEffect(effect=entry["effect"], joint=joint, other=entry.get("other"), parameters=values), truth


def simulate_request(request: Json) -> Json:
    """Simulate the recording of a request, write it, and return the answer.

    ``request``: request as described in the module's docstring. Returns the answer as described in the module's
    docstring. Raises ConfigError if the robot, the trajectory or an effect is not valid for the virtual arm.
    """
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
        "recording": request["out"],
        "effects": [effect.model_dump(mode="json") for effect, _ in resolved],
        "truth": [truth for _, truth in resolved],
        "seconds": time.perf_counter() - begin,
    }


def serve(handle: Callable[[Json], Json]) -> None:
    """Answer the requests on standard input until it ends.

    Other output of the process goes to standard error.

    ``handle``: returns the answer to a request. If it raises, the answer is ``{"error": "CLASS: MESSAGE"}``.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = handle(request)
        except Exception as error:
            if not isinstance(error, ArmidentError):
                traceback.print_exc()
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        print(json.dumps({"id": request.get("id"), **answer}), file=answers, flush=True)


if __name__ == "__main__":
    serve(simulate_request)
