"""Physically consistent standard parameters nearest to a base estimate, by semidefinite programming.

A link is physical if its pseudo-inertia matrix is positive semidefinite (Wensing, Kim and Slotine 2018; Sousa and
Cortesao 2014). Rotor inertias and friction must not be negative. Torques determine only ``theta_base = K theta`` (A.3):
many standard vectors have the same base vector, and some base vectors have no physical one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import clarabel as untyped_clarabel
import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, sparse
from scipy.special import chdtrc

from armident.arrays import Array, Ints
from armident.configs import ArmidentError, DataError
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import INERTIAL

clarabel: Any = untyped_clarabel

Identifiability = Literal["alone", "group", "no"]

REGULARISATION = 1e-8
"""Weight of a kilogram in the minimised distance, in units of the mean square t value: so small that it decides only
what data and constraints leave open."""

INDIFFERENCE = 0.1
"""Increase of the squared distance, in standard deviations squared, allowed for a lighter arm. Data do not tell such
arms apart; the nearest is often a limit case whose bodies shrink to points of arbitrary mass."""

PRICE_STEP = 3.0
"""Factor between successive mass weights in the search for a lighter arm: between factors of 1.5 and 9 the mass changes
by 1.5 %, which `INDIFFERENCE` allows; small factors take more time."""

SIGNIFICANCE = 0.05
"""Significance level of the test: probability that the estimate of a physical arm is rejected."""

NOTHING = 1e-3
"""Distance (standard deviations) that counts as zero: the error that the solver's tolerance allows."""

PROBE = 0.1
"""Step (standard deviations) of the finite differences of the projection."""

TOLERANCE = 1e-9
"""Relative and absolute tolerance of the solver."""

NULL = 1e-9
"""Distance of a unit vector from the row space of K below which it counts as inside."""


@dataclass(frozen=True, eq=False)
class ConsistentParameters:
    """Physically consistent parameters (p,), their base parameters (b,) and distance from the estimate; SI, joint side.

    ``identifiable``: determined ``alone``, in a ``group`` (values by the regularisation), or ``no`` effect on torques.
    ``groups``: base parameters that contain each parameter. ``std``: of the estimate before the constraints; NaN if not
    ``alone``. ``shifts``: changes of the base parameters, in their standard deviations. ``distance_std``: Mahalanobis
    distance. ``degrees``: dimensions removed by the active constraints, 0 if the estimate is consistent. ``p_value``:
    of this distance or more for a physical arm; ``compatible`` if it reaches the significance level.
    ``smallest_eigenvalues``: of each link's pseudo-inertia (n,), kg or kg m^2.
    """

    names: tuple[str, ...]
    theta: Array
    base_names: tuple[str, ...]
    theta_base: Array
    identifiable: tuple[Identifiability, ...]
    groups: tuple[tuple[str, ...], ...]
    std: Array
    shifts: Array
    distance_std: float
    degrees: float
    p_value: float
    compatible: bool
    verdict: str
    smallest_eigenvalues: Array

    def document(self) -> dict[str, Any]:
        """Return the result as plain numbers, strings, lists and dictionaries, for a JSON document."""
        rows = zip(self.names, self.theta, self.identifiable, self.groups, self.std, strict=True)
        return {
            "parameters": [
                {
                    "name": name,
                    "value": float(value),
                    "identifiable": how,
                    "acts_through": list(group),
                    "std": float(std) if np.isfinite(std) else None,
                }
                for name, value, how, group, std in rows
            ],
            "base": [
                {"name": name, "value": float(value), "shift_std": float(shift)}
                for name, value, shift in zip(self.base_names, self.theta_base, self.shifts, strict=True)
            ],
            "distance_std": self.distance_std,
            "degrees": self.degrees,
            "p_value": self.p_value,
            "compatible": self.compatible,
            "verdict": self.verdict,
        }


def nearest_consistent(
    model: ArmModel, theta_base: ArrayLike, covariance: ArrayLike, smallest_link: Array | None = None
) -> ConsistentParameters:
    """Find the physically consistent parameters nearest to a base estimate (b,) with covariance P.

    Minimises ``(K theta - theta_base)' P^-1 (K theta - theta_base)``. Of several solutions the lightest arm is
    returned: the smallest sum of the traces of the pseudo-inertias, second moments over the square of the arm's mean
    length. A consistent estimate keeps its base parameters; otherwise the squared distance may exceed its minimum by
    `INDIFFERENCE`. ``smallest_link``: pseudo-inertia (4, 4) that every link contains: none is a point or a thin disc.

    Test: ``N(truth, P)`` of a physical arm is projected onto the convex set of physical base parameters. Given its
    face, the squared distance is at most chi-square with the face's codimension (Wollan and Dykstra 1986). That is the
    trace of ``I`` minus the derivative of the projection, also for curved faces.
    """
    theta, std, factor, whitened = _whitened(model, theta_base, covariance)
    projection = _Projection(model, factor, max(float(np.sqrt(np.mean(whitened**2))), 1.0), smallest_link)
    standard, residual = projection.nearest(whitened)
    distance = float(np.linalg.norm(residual))
    degrees, p_value = 0.0, 1.0
    if distance > NOTHING:
        standard = projection.lightest(whitened, standard, distance)
        degrees = projection.lost_dimensions(whitened)
        p_value = float(chdtrc(degrees, distance**2))
    else:
        standard = standard + np.linalg.pinv(model.base.regroup) @ (theta - model.base.regroup @ standard)
    standard = _inside(model, standard, smallest_link)
    base = model.base.regroup @ standard
    shifts = np.asarray((base - theta) / std)
    identifiable = identifiability(model)
    return ConsistentParameters(
        names=model.names,
        theta=standard,
        base_names=model.base.names,
        theta_base=base,
        identifiable=identifiable,
        groups=tuple(tuple(model.base.names[i] for i in np.flatnonzero(column)) for column in model.base.regroup.T),
        std=_standard_deviations(model, np.asarray(covariance, dtype=np.float64), identifiable),
        shifts=shifts,
        distance_std=distance,
        degrees=degrees,
        p_value=p_value,
        compatible=p_value >= SIGNIFICANCE,
        verdict=_verdict(model, distance, degrees, p_value, shifts),
        smallest_eigenvalues=np.asarray(np.linalg.eigvalsh(pseudo_inertias(model, standard))[:, 0], dtype=np.float64),
    )


@dataclass(frozen=True, eq=False)
class NearestBase:
    """Base parameters (b,) of the nearest physical arm, their shifts (b,) and Mahalanobis distance, in std."""

    theta: Array
    shifts: Array
    distance: float


def nearest_base(model: ArmModel, theta_base: ArrayLike, covariance: ArrayLike) -> NearestBase:
    """Find the base parameters of the nearest physically consistent arm: one semidefinite programme."""
    theta, std, factor, whitened = _whitened(model, theta_base, covariance)
    projection = _Projection(model, factor, max(float(np.sqrt(np.mean(whitened**2))), 1.0))
    standard, residual = projection.nearest(whitened)
    base = model.base.regroup @ _inside(model, standard)
    return NearestBase(base, np.asarray((base - theta) / std), float(np.linalg.norm(residual)))


def identifiability(model: ArmModel) -> tuple[Identifiability, ...]:
    """Identifiability of each standard parameter (p,) from torques; it depends on the model only.

    ``alone``: its unit vector is in the row space of the regrouping matrix K: equal base parameters give it one value.
    """
    grouping = model.base.regroup
    outside = np.eye(grouping.shape[1]) - np.linalg.pinv(grouping) @ grouping
    kinds: list[Identifiability] = []
    for k, column in enumerate(grouping.T):
        if not column.any():
            kinds.append("no")
        else:
            kinds.append("alone" if np.linalg.norm(outside[:, k]) < NULL else "group")
    return tuple(kinds)


def pseudo_inertias(model: ArmModel, theta: ArrayLike) -> Array:
    """Pseudo-inertias (n, 4, 4) of the links: second moments (kg m^2), first moments (kg m) and mass (kg)."""
    xx, xy, xz, yy, yz, zz, mx, my, mz, m = model.values(theta).inertial.T
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
    out = np.empty((model.n, 4, 4))
    out[:, :3, :3] = 0.5 * np.trace(inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3) - inertia
    out[:, :3, 3] = out[:, 3, :3] = np.stack([mx, my, mz], axis=1)
    out[:, 3, 3] = m
    return out


def non_negative(model: ArmModel) -> Ints:
    """Indices of the non-negative standard parameters apart from masses: rotor inertias, friction, couplings."""
    c = model.columns
    columns = np.concatenate([c.ia, c.fv, c.fc, c.coupling.ravel()])
    return np.sort(columns[columns >= 0])


class _Projection:
    """Semidefinite programme for whitened base parameters, set up once and solved for several right sides.

    Variables are the standard parameters and ``r = L^-1 (K theta - theta_base)``, with the Cholesky factor L, in units
    of ``scale`` standard deviations: t values of a thousand beside masses of one are badly conditioned.
    """

    def __init__(self, model: ArmModel, factor: Array, scale: float, smallest_link: Array | None = None) -> None:
        b, p = model.base.regroup.shape
        whitened = linalg.solve_triangular(factor, model.base.regroup, lower=True) / scale
        signed = non_negative(model)
        length = mean_length(model)
        equal = np.hstack([whitened, -np.eye(b)])
        above = np.zeros((signed.size, p + b))
        above[np.arange(signed.size), signed] = -1.0
        rows, cones = [equal, above], [clarabel.ZeroConeT(b), clarabel.NonnegativeConeT(signed.size)]
        for columns in model.columns.inertial:
            lmi = np.zeros((10, p + b))
            lmi[:, columns] = -triangles(length)
            rows.append(lmi)
            cones.append(clarabel.PSDTriangleConeT(4))
        self._rows, self._cones = np.vstack(rows), cones
        self._quadratic = np.diag(np.concatenate([np.zeros(p), np.full(b, 2.0)]))
        self._weight = np.zeros(p + b)
        for kind, share in (("xx", 0.5 / length**2), ("yy", 0.5 / length**2), ("zz", 0.5 / length**2), ("m", 1.0)):
            self._weight[model.columns.inertial[:, INERTIAL.index(kind)]] = share
        # Rotor inertias have a weight, too: otherwise their share in a group with link parameters is not unique.
        rotors = model.columns.ia[model.columns.ia >= 0]
        self._weight[rotors] = 1 / length**2
        self._p, self._b, self._scale = p, b, scale
        smallest = np.zeros(10) if smallest_link is None else triangle(smallest_link, length)
        self._limits = np.concatenate([np.zeros(b + signed.size), np.tile(-smallest, model.n)])

    def nearest(self, whitened: Array, price: float = REGULARISATION) -> tuple[Array, Array]:
        """Standard parameters and residual (b,) for ``L^-1 theta_base``; ``price``: weight of a kilogram."""
        right = self._limits.copy()
        right[: self._b] = whitened / self._scale
        x = minimise_in_cones(self._quadratic, price * self._weight, self._rows, right, self._cones)
        return x[: self._p], self._scale * x[self._p :]

    def lightest(self, whitened: Array, nearest: Array, distance: float) -> Array:
        """Find the lightest arm (p,) within `INDIFFERENCE` of the minimum, by increasing the weight of a kilogram."""
        best, price = nearest, REGULARISATION
        while price < 1.0:
            price *= PRICE_STEP
            standard, residual = self.nearest(whitened, price)
            if residual @ residual > distance**2 + INDIFFERENCE:
                break
            best = standard
        return best

    def lost_dimensions(self, whitened: Array) -> float:
        """Trace of ``I`` minus the derivative of the projection at ``whitened`` (b,), at least 1."""
        _, here = self.nearest(whitened)
        lost = 0.0
        for k in range(self._b):
            moved = whitened.copy()
            moved[k] += PROBE
            lost -= (self.nearest(moved)[1][k] - here[k]) / PROBE
        return float(np.clip(lost, 1.0, self._b))


def minimise_in_cones(quadratic: Array, linear: Array, rows: Array, right: Array, cones: Sequence[Any]) -> Array:
    """Minimise ``x'Qx/2 + c'x`` subject to ``right - rows x`` in the solver's cones, one after the other."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(quadratic)), linear, sparse.csc_matrix(rows), right, list(cones), settings
    ).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise ArmidentError(f"no physically consistent parameters found: solver status {solution.status}")
    return np.asarray(solution.x, dtype=np.float64)


def _whitened(model: ArmModel, theta_base: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """Theta and its standard deviations (b,), factor L (b, b) of the covariance, and ``L^-1 theta``."""
    theta, p = np.asarray(theta_base, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    b = model.base.b
    if theta.shape != (b,) or p.shape != (b, b):
        raise DataError(
            f"{model.robot.name} has {b} base parameters: found an estimate of shape {theta.shape} with a covariance "
            f"of shape {p.shape}"
        )
    if not (np.isfinite(theta).all() and np.isfinite(p).all()):
        raise DataError("the base estimate or its covariance is not finite")
    std = np.sqrt(np.maximum(np.diag(p), 0.0))
    if not std.all() or np.linalg.eigvalsh(p / np.outer(std, std))[0] <= b * np.finfo(np.float64).eps:
        raise DataError("the covariance of the base estimate is not positive definite")
    factor = std[:, None] * linalg.cholesky(p / np.outer(std, std), lower=True)
    return theta, std, factor, linalg.solve_triangular(factor, theta, lower=True)


def _inside(model: ArmModel, theta: Array, smallest_link: Array | None = None) -> Array:
    """Standard parameters (p,) moved into the cones: the solver may violate them by its tolerance."""
    inside = theta.copy()
    signed = non_negative(model)
    inside[signed] = np.maximum(inside[signed], 0.0)
    # Adding s to a pseudo-inertia adds s to its mass and second moments, and 2 s to the moments of inertia.
    floor = np.zeros((4, 4)) if smallest_link is None else smallest_link
    smallest = np.linalg.eigvalsh(pseudo_inertias(model, inside) - floor)[:, 0]
    missing = np.where(smallest < 0, -smallest * (1 + 1e-6) + 1e-16, 0.0)
    for kind, share in (("xx", 2.0), ("yy", 2.0), ("zz", 2.0), ("m", 1.0)):
        inside[model.columns.inertial[:, INERTIAL.index(kind)]] += share * missing
    return inside


def triangles(length: float) -> Array:
    """Upper triangles of the pseudo-inertia of each unit inertial parameter, lengths in ``length`` (m): (10, 10).

    Column by column with off-diagonals times sqrt(2), an isometry, as of `clarabel.PSDTriangleConeT`.
    """
    out = np.empty((10, 10))
    for k, ten in enumerate(np.eye(10)):
        xx, xy, xz, yy, yz, zz, mx, my, mz, m = ten
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        matrix = np.zeros((4, 4))
        matrix[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        matrix[:3, 3] = matrix[3, :3] = mx, my, mz
        matrix[3, 3] = m
        out[:, k] = triangle(matrix, length)
    return out


def triangle(matrix: Array, length: float) -> Array:
    """Upper triangle (10,) of a pseudo-inertia (4, 4), in the units and the order of `triangles`."""
    scale = np.array([1 / length, 1 / length, 1 / length, 1.0])
    scaled = matrix * np.outer(scale, scale)
    return np.array([scaled[i, j] * (1.0 if i == j else np.sqrt(2.0)) for j in range(4) for i in range(j + 1)])


def mean_length(model: ArmModel) -> float:
    """Mean of the nonzero lengths ``d`` and ``r`` of the arm, m; 1 if all are zero."""
    lengths = np.abs(np.concatenate([model.chain.d, model.chain.r]))
    return float(lengths[lengths > 0].mean()) if lengths.any() else 1.0


def _standard_deviations(model: ArmModel, p: Array, identifiable: Sequence[Identifiability]) -> Array:
    """Standard deviations (p,), NaN if not alone: the variance is ``a' P a`` where the unit vector is ``K' a``."""
    combinations = np.linalg.pinv(model.base.regroup)
    std = np.sqrt(np.einsum("ki,ij,kj->k", combinations, p, combinations))
    return np.where(np.array(identifiable) == "alone", std, np.nan)


def _verdict(model: ArmModel, distance: float, degrees: float, p_value: float, shifts: Array) -> str:
    if distance <= NOTHING:
        return "the estimate is physically consistent as it is"
    worst = int(np.argmax(np.abs(shifts)))
    far = (
        f"the nearest consistent parameters are {distance:.2g} standard deviations away "
        f"({degrees:.1f} degrees of freedom, p = {p_value:.2g}); "
        f"{model.base.names[worst]} changes most, by {shifts[worst]:+.2g} standard deviations"
    )
    if p_value >= SIGNIFICANCE:
        return f"compatible with physics: {far}"
    return f"not compatible with physics: {far}; the model misses an effect or the standard deviations are too small"
