"""Recordings as they would be without what a robot's effects say of them: wiring, late torques."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Stanza
from armident.identify.effects.effect import Recorded, motor_limit
from armident.identify.effects.registry import known
from armident.identify.effects.wiring import rewired
from armident.identify.experiment import Experiment


def of_recording(stanza: Stanza) -> bool:
    """Whether a stanza is put right in the recordings instead of being a term of the model.

    Mistakes of wiring always are. A torque that is recorded late is where the stanza says how late; where it does not,
    that is a parameter of the model, to be estimated with the rest.
    """
    effect = known(stanza.effect)
    return effect.rewires or (effect.undo is not None and bool(stanza.parameters.get(effect.linear[0].name)))


def put_right(experiments: Sequence[Experiment], robot: RobotConfig) -> list[Experiment]:
    """The experiments without what the stanzas of a robot say of recordings.

    Raises
    ------
    ConfigError
        If a stanza of wiring does not say which signal, or which other joint.
    """
    experiments = rewired(experiments, robot)
    names = [joint.name for joint in robot.joints]
    for stanza in robot.effects:
        effect = known(stanza.effect)
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
