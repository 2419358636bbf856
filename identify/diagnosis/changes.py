"""Candidate changes of a plant, with the directions in which they move the parameters of the same model."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.effect import Effect, Place
from armident.identify.effects.parameter_change import FrictionChange, ParameterChange
from armident.identify.effects.registry import catalogue
from armident.identify.effects.terms import arm_model


@dataclass(frozen=True, eq=False)
class Change:
    """Effect at a place; ``joints``: names of one joint, or of the two of a coupling.

    ``directions`` (k, m): change of the parameters per unit of its linear parameters, whose typical ratios are
    ``sizes`` (m,). ``scores`` (n, m, s): of the residual statistics; ``None`` if the parameters take the whole change.
    """

    effect: Effect
    joints: tuple[str, ...]
    directions: Array
    sizes: Array
    scores: Array | None = None

    @property
    def structure(self) -> bool:
        """True if the change adds a term that the model lacks."""
        return self.effect.compared and not self.effect.change_title

    def reported(self, values: Array, std: Array) -> tuple[Array, Array]:
        """Linear parameters (m,) and standard deviations from the coefficients of the directions.

        A share of the torque is one of the torque now, its parameter one of the torque before.
        """
        if not self.effect.scales_torque:
            return values, std
        rest = np.maximum(1.0 - values, 1e-3)
        return values / rest, std / rest**2


def changes(robot: RobotConfig, now: IdentificationDocument) -> Iterator[Change]:
    """All changes of the catalogue that move parameters of an identification, at all their places."""
    model = arm_model(robot)
    if model.base.names != tuple(p.name for p in now.parameters):
        return
    joints = [joint.name for joint in robot.joints]
    standard = dict(zip(model.names, model.standard_from_base([p.value for p in now.parameters]), strict=True))
    for effect in catalogue().values():
        if not isinstance(effect, ParameterChange):
            continue
        for place in effect.places(model.n):
            yield from _moving(
                Change(effect, (joints[place.joint],), effect.change(model, place), effect.sizes(place, standard))
            )
    for coupling in robot.couplings:
        names = [f"{kind}{coupling.name}" for kind in ("fv", "fc")]
        directions = model.base.regroup[:, [model.names.index(name) for name in names]]
        sizes = np.array([max(abs(standard[name]), 1e-3) for name in names])
        yield from _moving(Change(FrictionChange(), tuple(coupling.joints), directions, sizes))
    for each in now.change_directions or ():
        if each.effect in catalogue():
            directions, scores = np.array(each.parameters).T, np.array(each.scores)
            change = Change(catalogue()[each.effect], (each.joint,), directions, np.ones(directions.shape[1]), scores)
            yield from _moving(change)


def _moving(change: Change) -> Iterator[Change]:
    """The change, if it moves a parameter."""
    if change.directions.any():
        yield change


def place_of(change: Change, robot: RobotConfig) -> Place:
    """Place of a change in a robot."""
    numbers = [[joint.name for joint in robot.joints].index(name) for name in change.joints]
    return Place(*numbers)
