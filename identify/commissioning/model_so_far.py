"""Model of the motions so far, which predicts the torques of a faster one: what they do not determine stays small."""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.design import PERIOD, design_trajectory
from armident.identify.excitation.point_to_point import sample_trajectory
from armident.identify.excitation.safety import assumed_noise
from armident.identify.identification.equations import equations, least_rows
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import smoothed_derivatives
from armident.identify.identification.solvers import decimation_of
from armident.identify.signals.bandwidth import motion_bandwidth
from armident.identify.signals.experiments import Experiment

COARSE = 10
"""Samples of a planned motion of which one is used for the largest torque of a parameter."""
PASSES = 2
"""Estimates, the first with an assumed noise, the others with that of the residuals."""


def model_so_far(robot: RobotConfig, experiments: Sequence[Experiment], known: Array | None) -> Array:
    """Return base parameters (b,), SI: the most probable ones where nothing but the limits is known of the arm.

    ``experiments``: corrected, SI, joint side. Each parameter has a Gaussian prior about its ``known`` value, (p,) or
    (b,), zero without. Its width is the value that takes the torque limit of a joint in a usual motion at full speed:
    parameters that slow motions do not show stay near the known value.
    """
    arm, dt = arm_model(robot), experiments[0].dt
    bandwidth = robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)
    signals = smoothed_derivatives(experiments, robot, Options(derivatives="bandpass"), bandwidth)
    lengths = [e.q.shape[0] for e in experiments]
    decimation = decimation_of("idim-ls", dt, bandwidth, None, samples=lengths, rows=least_rows(arm))
    blocks = equations(arm, experiments, signals, decimation)
    usual = sample_trajectory(design_trajectory(robot, seed=0, evaluations=0).trajectory, COARSE * PERIOD)
    limits = np.array([joint.limits.torque for joint in robot.joints])
    most = np.abs(arm.base_regressor(*usual, dt=COARSE * PERIOD)) / limits[:, None]
    width = 1.0 / np.maximum(most.max(axis=(0, 1)), np.finfo(float).tiny)
    mean = np.zeros(arm.base.b)
    if known is not None:
        mean = known if known.size == arm.base.b else arm.base.regroup @ known
    keep = np.concatenate([block.keep for block in blocks])
    x = np.concatenate([block.x for block in blocks]) * keep[:, :, None] * width
    y = np.concatenate([block.y for block in blocks]) * keep - x @ (mean / width)
    sigma, z = assumed_noise(robot), np.zeros(mean.size)
    for _ in range(PASSES):
        rows, right = (x / sigma[:, None]).reshape(-1, mean.size), (y / sigma).ravel()
        z = np.linalg.solve(rows.T @ rows + np.eye(mean.size), rows.T @ right)
        sigma = np.maximum(np.sqrt(np.mean((y - x @ z) ** 2, axis=0)), np.finfo(float).tiny)
    return np.asarray(mean + width * z)
