"""Whether parameters can belong to a real arm, and the way back from an iterate that cannot."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats

SMALLEST_EIGENVALUE = 1e-6
"""Smallest eigenvalue of the mass matrix that counts as positive, as a share of its largest."""

MOST_HALVINGS = 30
"""Halvings of a step before it is given up."""


@dataclass(frozen=True, eq=False)
class Damped:
    """A physical iterate.

    Parameters
    ----------
    theta
        The parameters, shape of those given.
    step
        Share of the way from the previous iterate to the wanted one, 0 to 1.
    reason
        What was wrong and what was done about it; empty if nothing was.
    """

    theta: Floats
    step: float
    reason: str


def is_physical(model: ArmModel, theta_base: ArrayLike, q_samples: ArrayLike) -> tuple[bool, str]:
    """Whether the mass matrix is positive definite over postures and friction dissipates.

    Parameters
    ----------
    theta_base
        Base (b,) or standard (p,) parameters.
    q_samples
        Postures (N, n) that the arm visits.

    Returns
    -------
    ok, reason
        The reason is empty where ``ok``.
    """
    theta = np.asarray(theta_base, dtype=np.float64)
    if not np.isfinite(theta).all():
        return False, "parameters are not finite"
    names = _names(model, theta)
    negative = [names[k] for k in _friction(names, model.e) if theta[k] < 0.0]
    bad, smallest = _mass_failures(model, theta, np.asarray(q_samples, dtype=np.float64))
    reasons = []
    if bad:
        reasons.append(f"mass matrix not positive definite (smallest eigenvalue {smallest:.3g}) at {bad} postures")
    if negative:
        reasons.append("negative friction " + ", ".join(negative))
    return not reasons, "; ".join(reasons)


def damp_to_physical(model: ArmModel, theta: ArrayLike, theta_previous: ArrayLike, q_samples: ArrayLike) -> Damped:
    """The physical parameters nearest to ``theta`` on the way from the last physical iterate.

    Negative friction coefficients become zero; then the step from ``theta_previous`` is halved until the mass
    matrix is positive definite at all postures.

    Parameters
    ----------
    theta, theta_previous
        Wanted and last physical parameters, both (b,) or both (p,).
    q_samples
        Postures (N, n).
    """
    previous = np.asarray(theta_previous, dtype=np.float64)
    wanted = np.asarray(theta, dtype=np.float64)
    if not np.isfinite(wanted).all():
        return Damped(previous.copy(), 0.0, "parameters are not finite: kept the previous ones")
    postures = np.asarray(q_samples, dtype=np.float64)
    names = _names(model, wanted)
    negative = [k for k in _friction(names, model.e) if wanted[k] < 0.0]
    reasons = []
    if negative:
        wanted = wanted.copy()
        wanted[negative] = 0.0
        reasons.append("negative friction set to zero: " + ", ".join(names[k] for k in negative))
    step, candidate = 1.0, wanted
    bad, smallest = _mass_failures(model, candidate, postures)
    if bad:
        first = f"mass matrix not positive definite (smallest eigenvalue {smallest:.3g}) at {bad} postures"
        for _ in range(MOST_HALVINGS):
            step /= 2.0
            candidate = previous + step * (wanted - previous)
            if not _mass_failures(model, candidate, postures)[0]:
                break
        else:
            step, candidate = 0.0, previous.copy()
        reasons.append(f"{first}: went {100.0 * step:.3g} % of the way")
    return Damped(candidate, step, "; ".join(reasons))


def _names(model: ArmModel, theta: Floats) -> tuple[str, ...]:
    return model.names if theta.size == len(model.names) else model.base.names


def _friction(names: tuple[str, ...], terms: int) -> list[int]:
    """Places of viscous and Coulomb friction; the last parameters are those of the terms."""
    return [k for k, name in enumerate(names[: len(names) - terms]) if name.startswith(("fv", "fc"))]


def _mass_failures(model: ArmModel, theta: Floats, postures: Floats) -> tuple[int, float]:
    """At how many postures the mass matrix is not positive definite, and its smallest eigenvalue."""
    eigenvalues = np.linalg.eigvalsh(model.mass_matrix(theta, postures))
    bad = eigenvalues[:, 0] <= SMALLEST_EIGENVALUE * np.abs(eigenvalues).max(axis=1)
    return int(bad.sum()), float(eigenvalues.min())
