"""Validation of the effects of a scenario against the catalogue and the robot."""

import math

from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.virtual_robot.effects.catalogue import EFFECTS
from armident.virtual_robot.effects.spec import Hidden, ParameterSpec


def hidden_effects(scenario: Scenario | None, robot: RobotConfig, where: str = "scenario") -> tuple[Hidden, ...]:
    """Validate the effects of a scenario; raises ConfigError, with entry and expected value, if one is invalid."""
    out: list[Hidden] = []
    for k, entry in enumerate(() if scenario is None else scenario.effects):
        checked = _checked(entry, robot, f"{where}: effects[{k}]")
        same = [h for h in out if (h.effect, h.joint, h.other) == (checked.effect, checked.joint, checked.other)]
        if same and not checked.spec.repeatable:
            raise ConfigError(f"{checked.where}: {entry.joint} has {entry.effect} already ({same[0].where})")
        out.append(checked)
    return tuple(out)


def _checked(entry: HiddenEffect, robot: RobotConfig, at: str) -> Hidden:
    joints = [joint.name for joint in robot.joints]
    if entry.effect not in EFFECTS:
        raise ConfigError(f"{at}.effect: {entry.effect!r} is not an effect of the virtual arm ({', '.join(EFFECTS)})")
    effect = EFFECTS[entry.effect]
    for key, name in (("joint", entry.joint), ("other", entry.other)):
        if name is not None and name not in joints:
            raise ConfigError(f"{at}.{key}: {name!r} is not a joint of {robot.name} ({', '.join(joints)})")
    if effect.first_joint and entry.joint != joints[0]:
        raise ConfigError(f"{at}.joint: {entry.effect} is of the base, expected {joints[0]}, found {entry.joint}")
    if entry.other is None and effect.other == "required":
        raise ConfigError(f"{at}.other: {entry.effect} is between two joints, name the second")
    if entry.other is not None and effect.other == "none":
        raise ConfigError(f"{at}.other: {entry.effect} is of one joint")
    if entry.other == entry.joint:
        raise ConfigError(f"{at}.other: expected another joint than {entry.joint}")
    joint = joints.index(entry.joint)
    other = -1 if entry.other is None else joints.index(entry.other)
    return Hidden(entry.effect, joint, other, _values(entry, robot.joints[joint].type, at), at, effect)


def _values(entry: HiddenEffect, kind: str, at: str) -> dict[str, float]:
    known = EFFECTS[entry.effect].parameters
    for name in entry.parameters:
        if name not in known:
            takes = ", ".join(f"{one} ({parameter.unit})" for one, parameter in known.items())
            raise ConfigError(f"{at}.parameters.{name}: unknown ({entry.effect} takes {takes})")
    values: dict[str, float] = {}
    for name, parameter in known.items():
        if name in entry.parameters and parameter.only not in (None, kind):
            raise ConfigError(f"{at}.parameters.{name}: for a {parameter.only} joint, {entry.joint} is {kind}")
        value = entry.parameters.get(name, parameter.default)
        if value is None:
            raise ConfigError(f"{at}.parameters: {entry.effect} needs {name}")
        if name in entry.parameters:
            _check_range(value, parameter, f"{at}.parameters.{name}")
        values[name] = value
    if entry.effect == "stick_events" and values["duration"] >= values["every"]:
        raise ConfigError(f"{at}.parameters.duration: expected less than every = {values['every']:g} s")
    return values


def _check_range(value: float, parameter: ParameterSpec, at: str) -> None:
    low, high = parameter.low, parameter.high
    if low <= value <= high and not (parameter.above and value == low):
        return
    least = "" if math.isinf(low) else f"a number above {low:g}" if parameter.above else f"a number from {low:g}"
    most = "" if math.isinf(high) else f"{' ' if least else 'a number '}up to {high:g}"
    raise ConfigError(f"{at}: expected {least}{most}, found {value:g}")
