"""Takes the effects that a robot configuration names out of an experiment, to identify the rigid model."""

from collections.abc import Sequence
from dataclasses import replace

from configs import RobotConfig
from identify.discrepancy.catalogue import effect_regressor, effect_values
from identify.experiment import Experiment
from identify.signals.differentiate import Method, differentiate


def without_effects(
    experiments: Sequence[Experiment], robot: RobotConfig, derivatives: Method = "irwsm"
) -> list[Experiment]:
    """Subtract the torque of the configured effects, with the values of the configuration.

    A torque sample is held until the next one, so the mean of an effect at both ends is taken from it.

    Raises
    ------
    ConfigError
        If an effect is not in the catalogue or lacks a shape parameter.
    """
    values = effect_values(robot)
    compensated = []
    for experiment in experiments:
        signals = differentiate(experiment.q, experiment.dt, derivatives, bandwidth_hz=robot.bandwidth_hz)
        torque = effect_regressor(robot, signals.q, signals.qd) @ values
        held = torque.copy()
        held[:-1] = (torque[1:] + torque[:-1]) / 2
        compensated.append(replace(experiment, tau=experiment.tau - held))
    return compensated
