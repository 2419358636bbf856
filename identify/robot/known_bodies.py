"""Choice among arms of equal base parameters: the one nearest to known bodies, by semidefinite programming."""

from typing import Any

import clarabel as untyped_clarabel
import numpy as np
from scipy import linalg

from armident.arrays import Array
from armident.configs import ArmidentError
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import INERTIAL
from armident.identify.robot.consistent import (
    mean_length,
    minimise_in_cones,
    non_negative,
    pseudo_inertias,
    triangle,
    triangles,
)

clarabel: Any = untyped_clarabel

SHARES = (1.0, 0.999, 0.99, 0.9, 0.5)
"""Shares of the change that are tried: the solver may leave the cones by its tolerance."""

INSIDE = -1e-12
"""Smallest eigenvalue of a pseudo-inertia (kg and kg m^2), and smallest coefficient, that rounding may leave."""


def nearest_to_known(model: ArmModel, theta: Array, known: Array, smallest_link: Array) -> Array:
    """Return the consistent standard parameters nearest to known ones (p,), with the same base parameters.

    Distances in kg: first moments over the arm's mean length, moments of inertia over its square; only links count.
    Every link contains ``smallest_link`` (4, 4). If nothing is nearer, the result is ``theta``.
    """
    free = linalg.null_space(model.base.regroup)
    if not free.shape[1]:
        return theta
    length, columns = mean_length(model), model.columns.inertial
    weight = np.zeros(theta.size)
    for column, kind in zip(columns.T, INERTIAL, strict=True):
        weight[column] = 1 / length ** (2 if kind[0] != "m" else len(kind) - 1)
    signed, unit = non_negative(model), triangles(length)
    rows, right = [-free[signed]], [theta[signed]]
    for link in columns:
        rows.append(-unit @ free[link])
        right.append(unit @ theta[link] - triangle(smallest_link, length))
    cones = [clarabel.NonnegativeConeT(signed.size), *(clarabel.PSDTriangleConeT(4) for _ in columns)]
    weighted = weight[:, None] * free
    linear = weighted.T @ (weight * (theta - known))
    try:
        change = free @ minimise_in_cones(weighted.T @ weighted, linear, np.vstack(rows), np.concatenate(right), cones)
    except ArmidentError:
        return theta
    for share in SHARES:
        moved = theta + share * change
        smallest = np.linalg.eigvalsh(pseudo_inertias(model, moved) - smallest_link)[:, 0].min()
        if min(smallest, moved[signed].min(initial=0.0)) >= INSIDE:
            moved[signed] = np.maximum(moved[signed], 0.0)
            return np.asarray(moved, dtype=np.float64)
    return theta
