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
from armident.identify.effects.registry import known, of_entry
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
    """A free nonlinear parameter: number of its term, its name and its range."""

    term: int
    name: str
    low: float
    high: float


def polished(study: Study, robot: RobotConfig, before: Fit) -> RobotConfig:
    """Robot with the nonlinear parameters of its new effects estimated from the training data (Gauss-Newton).

    The model's own parameters are estimated at the same time. Columns are derivatives of the torques at measured
    signals. Instruments are the same at simulated signals, which are free of noise. The loop is simulated again after
    large steps. Steps are kept as long as they reduce the errors of the training data.

    Parameters
    ----------
    study
        Data, with the model at the start of the search, whose effects stay as they are.
    robot
        Configuration with effects found.
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
    """Fit with other nonlinear parameters, at the present simulated motion or at its own.

    Raises
    ------
    DataError
        If the motion does not determine the parameters of the model.
    """
    if simulate and any(of_entry(stanza).predicts for stanza in robot.effects):
        return refit(study, robot, before)[1]
    model = arm_model(robot)
    return fit(replace(before.study, robot=robot, model=model), padded(before, model))


def training_errors(fit: Fit) -> float:
    """Sum over the joints of the logarithm of the power of their training errors."""
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
    """Free parameters with their ranges."""
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

    Effects with jumps are their own instruments: a simulation does not reproduce the instants of jumps.
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
