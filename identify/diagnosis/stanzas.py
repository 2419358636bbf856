"""Robot configurations with the findings of a search as effect entries."""

from armident.configs import RobotConfig
from armident.identify.diagnosis.trial import Trial
from armident.identify.effects.recorded import of_recording
from armident.identify.effects.registry import known, of_entry
from armident.identify.effects.terms import stanza_of


def added(robot: RobotConfig, trial: Trial) -> RobotConfig:
    """Robot with the result of a trial as its last effect entry, without optional parameters of the effect.

    Parameters
    ----------
    robot
        Configuration.
    trial
        Trial of the effect to add.
    """
    parameters = dict(trial.shapes) | values_of(trial)
    effect = trial.candidate.effect
    contained = tuple(p.name for p, there in zip(effect.linear, trial.contained, strict=True) if there)
    spared = tuple(p.name for p in known(effect.key).linear if p.through is not None)
    stanza = stanza_of(effect, trial.candidate.place, robot, parameters, contained + spared)
    return robot.model_copy(update={"effects": (*robot.effects, stanza)})


def completed(robot: RobotConfig) -> RobotConfig | None:
    """Robot with the optional parameters of its last effect entry; ``None`` if there are none."""
    last = robot.effects[-1]
    spared = [p.name for p in of_entry(last).linear if p.through is not None]
    if not any(name in last.without for name in spared):
        return None
    changed = last.model_copy(update={"without": tuple(name for name in last.without if name not in spared)})
    return robot.model_copy(update={"effects": (*robot.effects[:-1], changed)})


def valued(robot: RobotConfig, name: str, value: float) -> RobotConfig:
    """Robot with another value of a parameter of its last effect entry.

    Parameters
    ----------
    robot
        Configuration.
    name, value
        Parameter and its new value.
    """
    last = robot.effects[-1]
    changed = last.model_copy(update={"parameters": {**last.parameters, name: value}})
    return robot.model_copy(update={"effects": (*robot.effects[:-1], changed)})


def without(robot: RobotConfig, stanza: int) -> RobotConfig:
    """Robot without one of its effect entries.

    Parameters
    ----------
    robot
        Configuration.
    stanza
        Number of the entry.
    """
    return robot.model_copy(update={"effects": (*robot.effects[:stanza], *robot.effects[stanza + 1 :])})


def values_of(trial: Trial) -> dict[str, float]:
    """Linear parameters of a trial by name; none of those that the model contains."""
    each = zip(trial.candidate.effect.linear, trial.values, trial.contained, strict=True)
    return {parameter.name: float(value) for parameter, value, contained in each if not contained}


def stanza_number(robot: RobotConfig, term: int) -> int:
    """Number of the effect entry of a term; corrections of recordings are entries, but no terms.

    Parameters
    ----------
    robot
        Configuration.
    term
        Number of the term.
    """
    return [k for k, stanza in enumerate(robot.effects) if not of_recording(stanza)][term]
