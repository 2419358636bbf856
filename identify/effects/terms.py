"""Effects of a robot configuration as terms of its model."""

from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.effects.effect import Effect, Linear, Place
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.effects.registry import of_entry
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.motion import Motion


@dataclass(frozen=True)
class Term:
    """One entry of a robot's ``effects`` as a model term with k linear parameters (all or some of the effect's).

    ``kept`` (k,): their indices in the effect; ``values`` (k,): in the configuration, zero where it gives none.
    """

    effect: Effect
    place: Place
    shapes: dict[str, float]
    kept: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array

    def columns(self, motion: Motion) -> Array:
        """Return the torques of all joints per unit of the linear parameters, (N, n, k)."""
        every = self.effect.torque(motion, self.place, self.shapes)
        return every if len(self.kept) == every.shape[2] else every[:, :, list(self.kept)]

    def add_torque(self, motion: Motion, values: Array, torque: Array) -> None:
        """Add the torque of the term for values (k,) to ``torque`` (N, n) of all joints, in place, N m or N."""
        columns = self.effect.columns(motion, self.place, {**self.effect.defaults, **self.shapes})
        if columns.ndim == 3:
            torque += columns @ self.of_effect(values)
        else:
            torque[:, self.place.joint] += columns @ self.of_effect(values)

    @property
    def linear(self) -> tuple[Linear, ...]:
        """Linear parameters of the term."""
        return tuple(self.effect.linear[k] for k in self.kept)

    @property
    def depends_on_torque(self) -> bool:
        """True if the columns need torques that the model predicts."""
        return self.effect.depends_on_torque

    @property
    def scales_torque(self) -> bool:
        """True if the term is a share of the torque that the model predicts."""
        return self.effect.scales_torque

    def of_effect(self, values: Array) -> Array:
        """Return the values of all linear parameters of the effect: those of the term (k,), the others zero."""
        every = np.zeros(len(self.effect.linear))
        every[list(self.kept)] = values
        return every


def arm_model(robot: RobotConfig) -> ArmModel:
    """Build the model of a robot with the effects that its configuration names. Raises ConfigError as `terms_of`."""
    return ArmModel.from_config(robot, terms_of(robot))


def effect_terms(model: ArmModel) -> tuple[Term, ...]:
    """Return the terms of a model that come from effects of the catalogue, in their order."""
    return tuple(term for term in model.terms if isinstance(term, Term))


def terms_of(robot: RobotConfig) -> tuple[Term, ...]:
    """Return the terms of a robot's effects in order, without corrections of recordings; else ConfigError."""
    terms: list[Term] = []
    taken: dict[str, int] = {}
    for k, entry in enumerate(robot.effects):
        effect = of_entry(entry)
        if of_recording(entry):
            continue
        where = f"effects[{k}]: {entry.effect} of {entry.joint}"
        place = place_of_entry(entry, effect, robot, where)
        shapes = _shapes(entry, effect, where)
        kind = int(robot.joints[place.joint].type == "prismatic")
        number = f"{place.joint + 1}" if place.other is None else f"{place.joint + 1}{place.other + 1}"
        kept = _kept(entry, effect, shapes, where)
        names = []
        for linear in (effect.linear[k] for k in kept):
            name = f"{linear.name}{number}"
            taken[name] = taken.get(name, 0) + 1
            names.append(name if taken[name] == 1 else f"{name}_{taken[name]}")
        terms.append(
            Term(
                effect,
                place,
                shapes,
                kept,
                tuple(names),
                tuple(effect.linear[k].unit[kind] for k in kept),
                np.array([entry.parameters.get(effect.linear[k].name, 0.0) for k in kept]),
            )
        )
    return tuple(terms)


def place_of_entry(entry: Entry, effect: Effect, robot: RobotConfig, where: str) -> Place:
    """Return the location of an effect entry; ``where`` is its key, for messages of the ConfigError."""
    names = [joint.name for joint in robot.joints]
    joint = names.index(entry.joint)
    if not effect.two_joints:
        if entry.other is not None:
            raise ConfigError(f"{where}: other: only an effect between two joints has one")
        return Place(joint)
    if entry.other is None or entry.other == entry.joint:
        raise ConfigError(f"{where}: other: expected the second joint")
    return Place(joint, names.index(entry.other))


def entry_of(
    effect: Effect, place: Place, robot: RobotConfig, parameters: dict[str, float], without: tuple[str, ...] = ()
) -> Entry:
    """Return the configuration entry of an effect; ``without``: linear parameters that it leaves out."""
    other = None if place.other is None else robot.joints[place.other].name
    return Entry(
        effect=effect.name,
        law=effect.law,
        joint=robot.joints[place.joint].name,
        other=other,
        parameters=parameters,
        without=without,
    )


def _kept(entry: Entry, effect: Effect, shapes: dict[str, float], where: str) -> tuple[int, ...]:
    """Return the indices of the linear parameters that the effect has and ``without`` does not remove."""
    names = [parameter.name for parameter in effect.linear]
    for name in entry.without:
        if name not in names:
            raise ConfigError(f"{where}: without: {name!r} is not one of its linear parameters ({', '.join(names)})")
    kept = tuple(k for k in effect.present(shapes) if names[k] not in entry.without)
    if not kept:
        raise ConfigError(f"{where}: without: removes all its parameters")
    return kept


def _shapes(entry: Entry, effect: Effect, where: str) -> dict[str, float]:
    shapes = [shape.name for shape in effect.shapes]
    given = effect.defaults | entry.parameters
    missing = [name for name in shapes if name not in given]
    if missing:
        raise ConfigError(f"{where} needs {', '.join(missing)}")
    known = (*shapes, *(parameter.name for parameter in effect.linear))
    unknown = [name for name in entry.parameters if name not in known]
    if unknown:
        raise ConfigError(f"{where}: parameters.{unknown[0]}: unknown (takes {', '.join(known)})")
    return {name: given[name] for name in shapes}
