"""Standard deviations of the parameters of the effects in a model, the nonlinear ones included."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import chdtrc

from armident.arrays import Array
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidates import ColumnCache
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.regression import IvFit
from armident.identify.effects.drive import Correction
from armident.identify.effects.effect import Place
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.effects.registry import of_entry
from armident.identify.effects.terms import Term
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.hac import newey_west, newey_west_matrix

NEWEY_WEST_LAGS = 20
RANK = 1e-10
"""Variance of a combination of parameters over the largest below which it is a rounding error."""
STEP = 0.01
"""Relative change of a nonlinear parameter for its derivative."""


def standard_deviations(state: ModelState) -> dict[int, dict[str, float]]:
    """Standard deviations of all parameters of every effect of the model, by the number of its entry and their names.

    Nonlinear parameters (Gauss-Newton) and corrections are further columns; whole numbers count as known. If larger,
    the variances along the influence of each parameter count (Newey, West 1987, Econometrica 55(3)).
    """
    fit, terms = state.fit, _terms(state)
    slopes, owners = _further_columns(state)
    deviations = _deviations(fit, slopes)
    b = fit.theta.size
    found: dict[int, dict[str, float]] = {k: {} for k in range(len(state.robot.effects))}
    for k, term in terms.items():
        found[k] = {p.name: float(deviations[i]) for p, i in zip(term.linear, _own(state, term), strict=True)}
    for number, (owner, name) in enumerate(owners):
        found[owner][name] = float(deviations[b + number])
    return found


def p_value_of_effect(state: ModelState, entry: Entry) -> float:
    """Probability of linear parameters of an effect so far from zero if it is not there (Wald's test).

    Its own nonlinear parameters are fixed: without it, they mean nothing. A likelihood can rise without such evidence.
    """
    number = list(state.robot.effects).index(entry)
    every, owners = _further_columns(state)
    slopes = [slope for slope, (owner, _) in zip(every, owners, strict=True) if owner != number]
    if of_recording(entry):
        own = [(slope, name) for slope, (owner, name) in zip(every, owners, strict=True) if owner == number]
        if not own:
            return 0.0
        ((slope, name),) = own
        slopes.append(slope)
        tested, values = [state.fit.theta.size + len(slopes) - 1], np.array([entry.parameters[name]])
    else:
        term = state.term_of(entry)
        tested, values = _own(state, term), state.values_of(term)[0]
    statistics = []
    for covariance in _covariances(state.fit, slopes, tested):
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        unit = values / scale
        statistics.append(float(unit @ np.linalg.lstsq(covariance / np.outer(scale, scale), unit, rcond=RANK)[0]))
    return float(chdtrc(len(tested), max(min(statistics), 0.0)))


def _terms(state: ModelState) -> dict[int, Term]:
    """Terms of the model by the number of their entry."""
    return {k: state.term_of(e) for k, e in enumerate(state.robot.effects) if not of_recording(e)}


def _own(state: ModelState, term: Term) -> list[int]:
    """Positions of the linear parameters of a term among those of the model."""
    return [state.study.model.base.names.index(name) for name in term.names]


def _further_columns(state: ModelState) -> tuple[list[Array], list[tuple[int, str]]]:
    """Columns (R,) of nonlinear parameters and of corrections, and number of the entry and name of each."""
    study, fit = state.study, state.fit
    column_cache = ColumnCache(study, fit.theta)
    slopes: list[Array] = []
    owners: list[tuple[int, str]] = []
    for k, term in _terms(state).items():
        values = term.of_effect(state.values_of(term)[0])
        for name in term.effect.movable(study.robot, term.place, term.shapes):
            slopes.append(_slope(column_cache, fit.noise, term, name, values))
            owners.append((k, name))
    for k, entry in enumerate(state.robot.effects):
        effect = of_entry(entry)
        if of_recording(entry) and isinstance(effect, Correction):
            place = Place(study.joints.index(entry.joint))
            name = effect.linear[0].name
            column = column_cache.instruments(effect, place, (), fit.noise, keep=False)[:, 0]
            slopes.append(column * effect.relative_slope(entry.parameters[name]))
            owners.append((k, name))
    return slopes, owners


def _slope(column_cache: ColumnCache, noise: Sequence[ArModel], term: Term, name: str, values: Array) -> Array:
    """Derivative of a term's whitened torque at the simulated signals with respect to a nonlinear parameter, (R,)."""

    def torque(shapes: Mapping[str, float]) -> Array:
        key = tuple((shape.name, shapes[shape.name]) for shape in term.effect.shapes)
        rows: Array = column_cache.instruments(term.effect, term.place, key, noise, keep=False) @ values
        return rows

    step = STEP * term.shapes[name]
    up, down = (
        torque({**term.shapes, name: term.shapes[name] + step}),
        torque({**term.shapes, name: term.shapes[name] - step}),
    )
    slope: Array = (up - down) / (2 * step)
    return slope


def _deviations(fit: IvFit, slopes: list[Array]) -> Array:
    """Standard deviations (b + s,) of the model's own parameters (4.34) and of further ones with columns ``slopes``."""
    b, e = fit.theta.size, fit.study.model.e
    variances: Array = np.concatenate([np.diag(fit.covariance), np.zeros(len(slopes))])
    if e or slopes:
        own = list(range(b - e, b + len(slopes)))
        variances[own] = np.max([np.diag(found) for found in _covariances(fit, slopes, own)], axis=0)
    return variances**0.5


def _covariances(fit: IvFit, slopes: list[Array], own: list[int]) -> tuple[Array, Array]:
    """Covariances (k, k) of parameters beside columns ``slopes``: white innovations, then along each influence."""
    b = fit.theta.size
    z = np.column_stack([fit.instruments, *slopes])
    scale = np.linalg.norm(z, axis=0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv((z / scale).T @ (z / scale), rcond=1e-12, hermitian=True)
    white = (inverse / np.outer(scale, scale))[np.ix_(own, own)]
    # With an inexact simulator 4.34 is wider than (Z'Z)^-1; the further columns only widen it.
    alone = np.linalg.pinv((z[:, :b] / scale[:b]).T @ (z[:, :b] / scale[:b]), rcond=1e-12, hermitian=True)
    within = [k for k, i in enumerate(own) if i < b]
    model = [own[k] for k in within]
    parts = np.ix_(model, model)
    white[np.ix_(within, within)] += fit.covariance[parts] - (alone / np.outer(scale[:b], scale[:b]))[parts]
    products = (z / scale) @ (inverse[:, own] / scale[own]) * fit.residual[:, None]
    return white, newey_west_matrix([products - products.mean(axis=0)], NEWEY_WEST_LAGS)


def variance_of_sum(products: Array) -> float:
    """Variance of the sum of serially correlated terms (R,), their mean removed."""
    return float(newey_west([products - products.mean()], NEWEY_WEST_LAGS))
