"""Step reduction for iterates whose parameters are not physical."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.identify.robot.arm import ArmModel

SMALLEST_EIGENVALUE = 1e-6
"""Ratio of smallest to largest eigenvalue above which a mass matrix counts as positive definite: physical arms have
more than 7e-5 (110 arms with random bodies on the shipped kinematics)."""

MOST_HALVINGS = 30
"""Maximum number of halvings of a step, which leave 1e-9 of it; after these the previous iterate is kept."""


@dataclass(frozen=True, eq=False)
class Damped:
    """Physical iterate, applied fraction of its step (0 to 1), and the corrected defects; empty if there were none."""

    theta: Array
    step: float
    reason: str


def damp_to_physical(model: ArmModel, theta: ArrayLike, theta_previous: ArrayLike, q_samples: ArrayLike) -> Damped:
    """Set negative friction to zero, then halve the step until mass matrices at all postures are positive definite."""
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
        reasons.append(f"{first}: step reduced to {100.0 * step:.3g} %")
    return Damped(candidate, step, "; ".join(reasons))


def _names(model: ArmModel, theta: Array) -> tuple[str, ...]:
    return model.names if theta.size == len(model.names) else model.base.names


def _friction(names: tuple[str, ...], terms: int) -> list[int]:
    """Indices of viscous and Coulomb friction; the last ``terms`` parameters belong to the terms and are skipped."""
    return [k for k, name in enumerate(names[: len(names) - terms]) if name.startswith(("fv", "fc"))]


def _mass_failures(model: ArmModel, theta: Array, postures: Array) -> tuple[int, float]:
    """Number of postures without positive definite mass matrix, and the smallest eigenvalue of all postures."""
    eigenvalues = np.linalg.eigvalsh(model.mass_matrix(theta, postures))
    bad = eigenvalues[:, 0] <= SMALLEST_EIGENVALUE * np.abs(eigenvalues).max(axis=1)
    return int(bad.sum()), float(eigenvalues.min())
