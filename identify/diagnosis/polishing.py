"""Gauss-Newton refinement of the nonlinear parameters of all findings at once, by instrumental variables."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.identify.diagnosis.candidates import Shapes, Workshop
from armident.identify.diagnosis.regression import Fit, fit
from armident.identify.diagnosis.stanzas import stanza_number
from armident.identify.diagnosis.state import padded, refit
from armident.identify.diagnosis.study import Study
from armident.identify.diagnosis.whitening import whitened
from armident.identify.effects.effect import Shape
from armident.identify.effects.registry import known
from armident.identify.effects.terms import Term, arm_model, effect_terms

Array = NDArray[np.float64]

STEP = 0.02
"""Relative change of a parameter for its derivative."""
ROUNDS = 6
"""Greatest number of steps."""
LONGEST = 0.35
"""Longest step, on a logarithmic scale."""
SETTLED = 0.01
"""Length of a step, on a logarithmic scale, that ends the iterations."""
FAR = 0.1
"""Sum of the longest steps, on a logarithmic scale, after which the closed loop is simulated again."""
RANK = 1e-9
"""Singular value, over the largest, below which a direction counts as undetermined."""


@dataclass(frozen=True)
class _Free:
    """A nonlinear parameter that may be moved: of which term, and between which values."""

    term: int
    name: str
    low: float
    high: float


def polished(study: Study, robot: RobotConfig, before: Fit) -> RobotConfig:
    """The robot with the nonlinear parameters of its new effects where the training data have them.

    Gauss-Newton steps with the model's own parameters beside: columns are derivatives of the torques at measured
    signals, instruments the same at simulated ones, where noise makes a wrong value no better. The loop is simulated
    anew where it has gone far. Steps are kept as long as they make the errors of the training data smaller.

    Parameters
    ----------
    study
        The data, with the model that the search began with: its effects stay as they are.
    robot
        With effects found.
    before
        A fit without the last of them.
    """
    own = len(study.robot.effects)
    try:
        _, found = refit(study, robot, before)
    except DataError:
        return robot
    gone = 0.0
    for _ in range(ROUNDS):
        step = _step(found, own)
        if step is None:
            break
        length = max(abs(change) for _, change in step)
        gone += length
        try:
            after = _fitted(study, _moved(robot, step), found, simulate=gone > FAR)
        except DataError:
            break
        if not training_errors(after) < training_errors(found):
            break
        robot, found = after.study.robot, after
        if length < SETTLED:
            break
        gone = 0.0 if gone > FAR else gone
    return robot


def _fitted(study: Study, robot: RobotConfig, before: Fit, *, simulate: bool) -> Fit:
    """A fit of other nonlinear parameters, with the simulated motion that there is or with its own.

    Raises
    ------
    DataError
        If the motion does not determine the parameters of the model.
    """
    if simulate and any(known(stanza.effect).predicts for stanza in robot.effects):
        return refit(study, robot, before)[1]
    model = arm_model(robot)
    return fit(replace(before.study, robot=robot, model=model), padded(before, model))


def training_errors(fit: Fit) -> float:
    """Sum over the joints of the logarithms of their training errors' powers."""
    errors = np.concatenate(fit.errors(fit.theta, held=False))
    return float(np.sum(np.log(np.maximum(np.sum(errors**2, axis=0), 1e-300))))


def _step(fit: Fit, own: int) -> list[tuple[_Free, float]] | None:
    """Relative changes of the free parameters; ``None`` if there are none."""
    bench = Workshop(fit.study, fit.theta)
    free = _free(bench, own)
    if not free:
        return None
    slopes = [_slopes(bench, fit, one) for one in free]
    x = np.column_stack([fit.train.x, *(measured for measured, _ in slopes)])
    z = np.column_stack([fit.train.z, *(simulated for _, simulated in slopes)])
    scale = np.maximum(np.linalg.norm(z, axis=0), 1e-300)
    change = np.linalg.lstsq((z / scale).T @ (x / scale), (z / scale).T @ fit.residual, rcond=RANK)[0] / scale
    steps = np.clip(change[fit.theta.size :], -LONGEST, LONGEST)
    return list(zip(free, steps.tolist(), strict=True))


def _free(bench: Workshop, own: int) -> list[_Free]:
    """Parameters that may be moved."""
    study, found = bench.study, []
    for k, term in enumerate(effect_terms(study.model)):
        if stanza_number(study.robot, k) < own:
            continue
        movable = term.effect.movable(study.robot, term.place, term.shapes)
        for shape in term.effect.shapes:
            if shape.name in movable:
                values = [float(term.shapes[shape.name]), *_values(shape, bench, term)]
                found.append(_Free(k, shape.name, min(v for v in values if v > 0.0), max(values)))
    return found


def _values(shape: Shape, bench: Workshop, term: Term) -> list[float]:
    motion = bench.motion(bench.study.train[0], "measured")
    return [*shape.grid(motion, term.place.joint), *shape.closer]


def _slopes(bench: Workshop, fit: Fit, one: _Free) -> tuple[Array, Array]:
    """Derivative (R,) of a term's whitened torque over the logarithm of a parameter, at measured and simulated signals.

    Leaps are their own instruments: no simulation meets them to the sample.
    """
    term = effect_terms(fit.study.model)[one.term]
    own = [fit.study.model.base.names.index(name) for name in term.names]
    values = term.of_effect(fit.theta[own])

    def torque(kind: str, value: float) -> Array:
        shapes = {**term.shapes, one.name: value}
        key: Shapes = tuple((shape.name, shapes[shape.name]) for shape in term.effect.shapes)
        made: Array = whitened(bench.band(term.effect, term.place, key, "train", kind, keep=False), fit.noise) @ values
        return made

    here = float(term.shapes[one.name])
    measured, simulated = (
        (torque(kind, here * (1 + STEP)) - torque(kind, here * (1 - STEP))) / (2 * STEP)
        for kind in ("measured", "measured" if term.effect.sudden else "simulated")
    )
    return measured, simulated


def _moved(robot: RobotConfig, steps: list[tuple[_Free, float]]) -> RobotConfig:
    """The robot after a step, with every parameter kept in its range."""
    effects = list(robot.effects)
    for one, step in steps:
        k = stanza_number(robot, one.term)
        value = float(np.clip(effects[k].parameters[one.name] * np.exp(step), one.low, one.high))
        effects[k] = effects[k].model_copy(update={"parameters": {**effects[k].parameters, one.name: value}})
    return robot.model_copy(update={"effects": tuple(effects)})
