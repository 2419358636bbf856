"""Correction of recordings for effects on signals: wiring, delayed or saturated torques."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Stanza
from armident.identify.effects.effect import Recorded, motor_limit
from armident.identify.effects.registry import of_entry
from armident.identify.effects.wiring import rewired
from armident.identify.experiment import Experiment


def of_recording(stanza: Stanza) -> bool:
    """Return True if an effect entry corrects the recordings instead of being a term of the model.

    Wiring errors always do. A torque correction (delay, lag, saturation) does if the entry gives its value; otherwise
    the value is a parameter of the model and estimated with the rest.
    """
    effect = of_entry(stanza)
    return effect.rewires or (effect.undo is not None and bool(stanza.parameters.get(effect.linear[0].name)))


def put_right(experiments: Sequence[Experiment], robot: RobotConfig) -> list[Experiment]:
    """Return the experiments corrected for the effects on signals of a robot's configuration.

    Parameters
    ----------
    experiments
        As recorded.
    robot
        Configuration with the effect entries.

    Raises
    ------
    ConfigError
        If the entry of a wiring error does not name the signal or the other joint.
    """
    experiments = rewired(experiments, robot)
    names = [joint.name for joint in robot.joints]
    for stanza in robot.effects:
        effect = of_entry(stanza)
        if effect.undo is None or not of_recording(stanza):
            continue
        motor, value = names.index(stanza.joint), stanza.parameters[effect.linear[0].name]
        done = []
        for e in experiments:
            at_motors = e.tau @ np.linalg.inv(robot.transmission_matrix)
            at = Recorded(e.dt, motor_limit(robot, motor))
            at_motors[:, motor] = effect.undo(at_motors[:, motor], at, value)
            done.append(replace(e, tau=np.ascontiguousarray(at_motors @ robot.transmission_matrix)))
        experiments = done
    return list(experiments)
