"""Torque error with the contribution of an effect taken at the simulated motion, without derivative noise.

An elastic joint or a torque delay takes one derivative more than the rigid model. At measured signals that derivative
adds noise, so that the correct model may have larger errors than the wrong one. At the simulated motion the
contribution of the effect is free of that noise.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs.schema.robot import Effect as Stanza
from armident.identify.diagnosis.study import Study
from armident.identify.effects.recorded import put_right
from armident.identify.effects.registry import known, of_entry
from armident.identify.experiment import Experiment

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Foretold:
    """Held-out errors of every stretch, (M, n) each, N m or N.

    Parameters
    ----------
    before
        Errors of a model at the measured motion.
    after
        The same less the change by another model at the simulated motion.
    """

    before: tuple[Array, ...]
    after: tuple[Array, ...]


def foretold(study: Study, theta: Array, other: Study, other_theta: Array) -> Foretold | None:
    """Errors of a model, and their remainder if the change by another model is right at the simulated motion.

    Parameters
    ----------
    study, theta
        Data and parameters (b,) of the model.
    other, other_theta
        The same recordings with the other model and its simulated motion, and its parameters.

    Returns
    -------
    Foretold or None
        Errors of the torques with the corrections of the other model; ``None`` where it drops a correction of the first
        model, or exchanges signals.
    """
    more = tuple(stanza for stanza in other.recorded if stanza not in study.recorded)
    undone = any(stanza not in other.recorded for stanza in study.recorded)
    if undone or any(of_entry(stanza).rewires for stanza in more):
        return None
    before, after = [], []
    for own, right in zip(study.held, other.held, strict=True):
        there = replace(own, simulated=right.simulated, before=right.before)
        seen, simulated = (
            torque_put_right(study.torques(there, kind, theta), study, more) for kind in ("measured", "simulated")
        )
        change = other.torques(right, "simulated", other_theta) - simulated
        error = right.torque - seen
        before.append(study.decimation(error))
        after.append(study.decimation(error - change))
    return Foretold(tuple(before), tuple(after))


def torque_put_right(torque: Array, study: Study, stanzas: tuple[Stanza, ...]) -> Array:
    """Torques (N, n) at the working rate with the corrections of recordings applied.

    Parameters
    ----------
    torque
        Torques, shape (N, n), N m or N.
    study
        Data with robot and sampling period.
    stanzas
        Effect entries of the configuration that correct recordings.
    """
    robot = study.robot.model_copy(update={"effects": stanzas})
    (done,) = put_right([Experiment(q=torque, tau=torque, q_ref=None, dt=study.dt)], robot)
    return done.tau
