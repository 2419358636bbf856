"""Recording of an identified model in closed loop along a trajectory."""

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, Trajectory
from armident.daq.recording import Field, Recording, Stream
from armident.identify.controller.nominal import known_controller, nominal_controller
from armident.identify.identification.robot_model import RobotModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.relaxation import simulate_with_terms
from armident.identify.signals.bandwidth import motion_bandwidth


def simulate_model(model: RobotModel, trajectory: Trajectory, rate_hz: float | None = None) -> Recording:
    """Simulate the recording of an arm that is exactly the model, with its effects, without noise; SI, joint side.

    Dynamics: thesis section B.3; controller: known, else a critically damped PD.
    """
    robot, arm = model.robot, model.arm
    trajectory.check(robot)
    rate = rate_hz or model.document.recording.sample_rate_hz
    reference = trajectory.sample(1.0 / rate)
    controller = _controller(model, reference, 1.0 / rate)
    run = simulate_with_terms(arm, model.theta, controller, reference, 1.0 / rate)
    if run.diverged_at is not None:
        raise DataError(
            f"{model.path}: the closed loop diverges after {run.diverged_at / rate:.2f} s: the parameters are "
            "not physical, or the controller does not suit them. Next: identify with --physical"
        )
    revolute = all(joint.type == "revolute" for joint in robot.joints)
    unit, ones = "rad" if revolute else "m", (1.0,) * robot.n
    fields = {
        "position": Field("position", "position", unit, "joint", ones),
        "velocity": Field("velocity", "velocity", f"{unit}/s", "joint", ones),
        "torque": Field("torque", "torque", "N m" if revolute else "N", "joint", ones),
        "demand": Field("demand", "demand", unit, "joint", ones),
    }
    sync = np.arange(reference.shape[0], dtype=np.int64)
    t_ns = np.round(sync * (1e9 / rate)).astype(np.int64)
    raw = {"position": run.q, "velocity": run.qd, "torque": run.tau, "demand": reference}
    facts = {"source": f"simulation of {model.path.name}"}
    return Recording(
        None, robot, None, rate, {"samples": Stream("samples", 1, sync, t_ns, fields, raw)}, metadata=facts
    )


def _controller(model: RobotModel, reference: NDArray[np.float64], dt: float) -> DiscreteController:
    if model.robot.controller is not None:
        return known_controller(model.robot, dt)
    bandwidth = model.robot.bandwidth_hz or motion_bandwidth([reference], dt)
    return nominal_controller(model.arm, model.theta, reference, dt, bandwidth)
