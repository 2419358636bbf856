"""How sure the parameters of the effects in a model are, the nonlinear ones included."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from identify.catalogue.terms import Term
from identify.discrepancy.candidates import Workshop
from identify.discrepancy.regression import Fit
from identify.discrepancy.search import State
from identify.estimators.noise import ArModel

Array = NDArray[np.float64]

STEP = 0.01
"""Relative change of a nonlinear parameter for its derivative."""


def standard_deviations(state: State) -> list[dict[str, float]]:
    """Standard deviations of all parameters of every term of the model, by their names in the configuration.

    The derivative of the torque with respect to a nonlinear parameter is one more column, so that its uncertainty
    enters that of the linear ones (Gauss-Newton); parameters taken from a set of whole numbers count as known.
    """
    study, fit = state.study, state.fit
    slopes: list[Array] = []
    owners: list[tuple[int, str]] = []
    for k, term in enumerate(study.model.terms):
        own = [study.model.base.names.index(name) for name in term.names]
        for shape in term.effect.shapes:
            if shape.continuous:
                slopes.append(_slope(state.workshop, fit.noise, term, shape.name, fit.theta[own]))
                owners.append((k, shape.name))
    covariance = _extended(fit, slopes)
    b = fit.theta.size
    found: list[dict[str, float]] = []
    for k, term in enumerate(study.model.terms):
        own = [study.model.base.names.index(name) for name in term.names]
        std = {p.name: float(np.sqrt(covariance[i, i])) for p, i in zip(term.effect.linear, own, strict=True)}
        for place, (owner, name) in enumerate(owners):
            if owner == k:
                std[name] = float(np.sqrt(covariance[b + place, b + place]))
        found.append(std)
    return found


def _slope(workshop: Workshop, noise: Sequence[ArModel], term: Term, name: str, values: Array) -> Array:
    """Derivative of a term's whitened torque at the simulated signals with respect to a nonlinear parameter, (R,)."""

    def torque(shapes: Mapping[str, float]) -> Array:
        key = tuple((shape.name, shapes[shape.name]) for shape in term.effect.shapes)
        rows: Array = workshop.instruments(term.effect, term.place, key, noise, keep=False) @ values
        return rows

    step = STEP * term.shapes[name]
    up, down = (
        torque({**term.shapes, name: term.shapes[name] + step}),
        torque({**term.shapes, name: term.shapes[name] - step}),
    )
    slope: Array = (up - down) / (2 * step)
    return slope


def _extended(fit: Fit, slopes: list[Array]) -> Array:
    """Covariance of the parameters and of further ones whose columns at the simulated signals are ``slopes``."""
    if not slopes:
        return fit.covariance
    z = np.column_stack([fit.train.z, *slopes])
    scale = np.linalg.norm(z, axis=0)
    scale[scale == 0] = 1.0
    gram = (z / scale).T @ (z / scale)
    covariance: Array = np.linalg.pinv(gram, rcond=1e-12, hermitian=True) / np.outer(scale, scale)
    # Where the simulator is not exact, 4.34 is wider than (Z'Z)^-1; the further columns only widen it.
    b = fit.theta.size
    alone = np.linalg.pinv(gram[:b, :b], rcond=1e-12, hermitian=True) / np.outer(scale[:b], scale[:b])
    covariance[:b, :b] += fit.covariance - alone
    return covariance
