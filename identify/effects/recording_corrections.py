"""Correction of recordings for effects on signals: wiring, zeros; torques that are scaled, delayed or saturated."""

from collections.abc import Sequence

from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.effects.drive import Correction
from armident.identify.effects.registry import of_entry
from armident.identify.effects.wiring import rewired, with_zeros
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import kept


def of_recording(entry: Entry) -> bool:
    """Return True if an entry corrects the recordings: wiring errors always, torque corrections if it has the value."""
    return of_entry(entry).corrects(entry)


def corrected_experiments(experiments: Sequence[Experiment], robot: RobotConfig) -> Sequence[Experiment]:
    """Return the experiments corrected for effects on signals; ConfigError if a wiring error lacks signal or joint."""
    experiments = with_zeros(rewired(experiments, robot), robot)
    for entry in robot.effects:
        effect = of_entry(entry)
        if isinstance(effect, Correction) and effect.corrects(entry):
            experiments = kept((effect.corrected(e, robot, entry) for e in experiments), like=experiments)
    return experiments
