"""Correction of recordings for effects on signals: wiring; torques that are scaled, delayed or saturated."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.effects.drive import Correction
from armident.identify.effects.registry import of_entry
from armident.identify.effects.wiring import rewired
from armident.identify.experiment import Experiment


def of_recording(entry: Entry) -> bool:
    """Return True if an effect entry corrects the recordings instead of being a term of the model.

    Wiring errors always do. A torque correction (gain, delay, lag, saturation) does if the entry gives its value;
    otherwise the value is a parameter of the model and estimated with the rest.
    """
    return of_entry(entry).corrects(entry)


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
    for entry in robot.effects:
        effect = of_entry(entry)
        if isinstance(effect, Correction) and effect.corrects(entry):
            experiments = [effect.put_right(e, robot, entry) for e in experiments]
    return experiments


STEP = 0.01
"""Relative change of the value of a correction for its derivative."""


def relative_slope(experiments: Sequence[Experiment], robot: RobotConfig, entry: Entry) -> float:
    """Change of the corrected torques by a change of a correction's value, over that by a further small correction.

    One for corrections that add up, such as delays; ``1 / (1 + gain_error)`` for a gain.

    Parameters
    ----------
    experiments
        As recorded.
    robot
        Configuration with the entry of the correction.
    entry
        The entry; its one linear parameter has a value.
    """
    name = of_entry(entry).linear[0].name
    step = STEP * entry.parameters[name]
    others = [other for other in robot.effects if other is not entry]

    def corrected(*values: float) -> NDArray[np.float64]:
        own = [entry.model_copy(update={"parameters": {**entry.parameters, name: value}}) for value in values]
        found = put_right(experiments, robot.model_copy(update={"effects": (*others, *own)}))
        return np.concatenate([e.tau for e in found])

    value = entry.parameters[name]
    before = corrected(value)
    changed, further = corrected(value + step) - before, corrected(value, step) - before
    return float(np.vdot(changed, further) / max(float(np.vdot(further, further)), 1e-300))
