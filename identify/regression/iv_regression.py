"""Instrumental-variable regression that keeps its whitened rows, for comparison with further columns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from armident.arrays import Array
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.iv import IvProducts, JointEquations, together
from armident.identify.regression.whitening import rows_of_joints

TIED = 1e4
"""Weight of the difference of two parameters that have one value, over that of the data: a ten-thousandth is left."""


class Jointwise(Protocol):
    """Equations of all joints, which may be computed again after they were freed."""

    @property
    def joints(self) -> tuple[JointEquations, ...]:
        """Equations of each joint."""

    @property
    def parameters(self) -> int:
        """Number of parameters, b."""

    @property
    def held_at_zero(self) -> Array:
        """Weight by which each parameter is held at zero, over the norms of its columns, (b,)."""

    @property
    def tied(self) -> Sequence[tuple[int, int]]:
        """Pairs of parameters that have one value."""

    def release(self) -> None:
        """Free the equations; they are computed again, with the same values, when they are next used."""


@dataclass(frozen=True, eq=False)
class IvRegression:
    """Solution of whitened equations with instruments (in units of their norms), and products ``Z' [X, Z, y]``."""

    equations: Jointwise
    noise: tuple[ArModel, ...]
    products: tuple[Array, ...]
    solution: IvProducts

    @classmethod
    def of(cls, equations: Jointwise, noise: Sequence[ArModel], known: "IvRegression | None" = None) -> "IvRegression":
        """Regression under given noise models; reuses joints of ``known`` that have the same noise model."""
        joints = equations.joints
        rows: dict[int, Array] = {}
        products: list[Array] = []
        for j, (joint, ar) in enumerate(zip(joints, noise, strict=True)):
            if known is not None and known.noise[j] is ar:
                products.append(known.products[j])
                if "rows" in known.__dict__:
                    rows[j] = known.rows[j]
            elif ar.order == 0:
                products.append(joint.plain / ar.variance)
            else:
                rows[j] = _whitened(joint, ar)
                products.append(joint.products([rows[j]]))
        solution = together(zip(joints, products, strict=True), equations.parameters)
        weights = np.diag(equations.held_at_zero) + ties(equations.tied, solution.scale)
        solution = replace(solution, cross=solution.cross + weights)
        made = cls(equations, tuple(noise), tuple(products), solution)
        if len(rows) == len(joints):
            made.__dict__["rows"] = tuple(rows[j] for j in range(len(joints)))
        return made

    @cached_property
    def rows(self) -> tuple[Array, ...]:
        """Whitened rows ``[X, Z, y]`` of each joint without the columns that are zero there."""
        return tuple(_whitened(joint, ar) for joint, ar in zip(self.equations.joints, self.noise, strict=True))

    @cached_property
    def residual(self) -> Array:
        """Whitened residual, joint after joint, (R,)."""
        own = zip(self.equations.joints, self.rows, strict=True)
        theta = self.solution.theta
        return np.concatenate([rows[:, -1] - rows[:, : joint.x.size] @ theta[joint.x] for joint, rows in own])

    @cached_property
    def rows_of(self) -> list[slice]:
        """Rows of each joint among those of all joints."""
        return rows_of_joints(rows.shape[0] for rows in self.rows)

    def release(self) -> None:
        """Free equations and rows; they are computed again, with the same values, when they are next used."""
        self.equations.release()
        for name in ("rows", "residual"):
            self.__dict__.pop(name, None)

    def absorbed(self, columns: Array) -> Array:
        """Parameters (b, k) that the model would give to whitened torques (R, k): ``(Z'X)^-1 Z' columns``."""
        _, q = self._through([(j, columns[own]) for j, own in enumerate(self.rows_of)], columns.shape[1])
        return self.solution.parameters(q)

    def without_model(self, torques: Array) -> Array:
        """Whitened torques (R, k) less those that the model gives to them: ``T - X (Z'X)^-1 Z'T``."""
        theta, rest = self.absorbed(torques), torques.copy()
        for joint, rows, own in zip(self.equations.joints, self.rows, self.rows_of, strict=True):
            rest[own] -= rows[:, : joint.x.size] @ theta[joint.x]
        return rest

    def orthogonalized(self, instruments: Array) -> Array:
        """Whitened instruments (R, k) orthogonal to the regressor: ``D - Z (X'Z)^-1 X'D``."""
        x, _ = self._through([(j, instruments[own]) for j, own in enumerate(self.rows_of)], instruments.shape[1])
        weights = self.solution.projection_weights(x) / self.solution.scale[:, None]
        rest = instruments.copy()
        for joint, rows, own in zip(self.equations.joints, self.rows, self.rows_of, strict=True):
            rest[own] -= rows[:, joint.x.size : -1] @ weights[joint.z]
        return rest

    def orthogonal_products(self, columns: Sequence[tuple[int, Array]], count: int) -> tuple[Array, Array]:
        """``B'B`` (G, k, k) and ``B' residual`` (G, k) of ``B = orthogonalized(D)``, columns (R_j, G k), without B."""
        width = columns[0][1].shape[1]
        gram, score = np.zeros((count, width // count, width // count)), np.zeros(width)
        for joint, own in columns:
            score += own.T @ self.residual[self.rows_of[joint]]
            groups = own.reshape(own.shape[0], count, -1).transpose(1, 0, 2)
            gram += groups.transpose(0, 2, 1) @ groups
        x, q = self._through(columns, width)
        weights = self.solution.projection_weights(x)

        def products(right: Array) -> Array:
            left, other = (part.reshape(part.shape[0], count, -1).transpose(1, 0, 2) for part in (weights, right))
            return left.transpose(0, 2, 1) @ other

        # The residual is orthogonal to the model's own instruments.
        both = products(q)
        gram = gram - both - both.transpose(0, 2, 1) + products(self.solution.gram @ weights)
        return gram, score.reshape(count, -1)

    def _through(self, columns: Sequence[tuple[int, Array]], width: int) -> tuple[Array, Array]:
        """``X' columns`` and ``Q' columns`` (b, k) of columns (R_j, k) of some joints; Q as in `IvProducts`."""
        x, q = np.zeros((2, self.equations.parameters, width))
        for j, own in columns:
            # Most candidates act on one joint.
            if own.any():
                joint, through = self.equations.joints[j], self.rows[j][:, :-1].T @ own
                x[joint.x] += through[: joint.x.size]
                q[joint.z] += through[joint.x.size :]
        return x, q / self.solution.scale[:, None]


def ties(pairs: Sequence[tuple[int, int]], scale: Array) -> Array:
    """Weights (b, b) that hold pairs of parameters together, in units of the norms ``scale`` (b,) of the columns."""
    weights = np.zeros((scale.size, scale.size))
    for pair in pairs:
        apart = np.zeros(scale.size)
        apart[list(pair)] = scale[pair[0]] / scale[list(pair)] * [1.0, -1.0]
        weights += TIED * np.outer(apart, apart)
    return weights


def _whitened(joint: JointEquations, ar: ArModel) -> Array:
    rows = list(joint.whitened(ar))
    return rows[0] if len(rows) == 1 else np.concatenate(rows)
