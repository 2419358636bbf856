"""A regression that keeps its rows, against the plain formulas with all columns of all joints."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import InstrumentedEquations, stacked
from armident.identify.regression.iv import JointEquations, factored, iv_products
from armident.identify.regression.iv_regression import IvRegression
from armident.identify.regression.whitening import whitened

Array = NDArray[np.float64]

NOISE = [ArModel(np.array([-0.9, 0.1]), 0.5, 0.0), ArModel(np.empty(0), 2.0, 0.0)]
"""Noise models of two joints, one of them white."""


@dataclass
class Given:
    """Equations of two joints and five parameters, which count how often the joints are made."""

    blocks: Sequence[InstrumentedEquations]
    made: list[int] = field(default_factory=list)
    held_at_zero: Array = field(default_factory=lambda: np.zeros(5))
    tied: Sequence[tuple[int, int]] = ()

    @cached_property
    def joints(self) -> tuple[JointEquations, ...]:
        """Equations of each joint."""
        self.made.append(1)
        return tuple(JointEquations.of(self.blocks, j, copied=True) for j in range(2))

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return 5

    def release(self) -> None:
        """Free the joints."""
        self.__dict__.pop("joints", None)


@pytest.fixture
def given() -> Given:
    """Two experiments; the first two parameters do not act on the second joint."""
    rng = np.random.default_rng(7)
    blocks = []
    for m in (2500, 300):
        z = rng.standard_normal((m, 2, 5)) * np.logspace(-2, 2, 5)
        z[:, 1, :2] = 0.0
        x = z * (1 + 0.1 * rng.standard_normal(z.shape))
        y = x @ np.logspace(2, -2, 5) + rng.standard_normal((m, 2))
        blocks.append(InstrumentedEquations(y, x, np.ones((m, 2), np.bool_), np.arange(float(m)), z))
    return Given(blocks)


def dense(given: Given) -> tuple[Array, Array, Array]:
    """Whitened instruments, regressor and torques of all joints."""
    return whitened([b.z for b in given.blocks], NOISE), *stacked(given.blocks, NOISE)


def test_solution_is_that_of_the_estimators(given: Given) -> None:
    found = IvRegression.of(given, NOISE)
    z, x, y = dense(given)
    for other in (factored(z, x, y), iv_products(given.blocks, NOISE)):
        np.testing.assert_allclose(found.solution.theta, other.theta, rtol=1e-10)
        np.testing.assert_allclose(found.solution.covariance, other.covariance, rtol=1e-8, atol=1e-20)
    np.testing.assert_allclose(found.residual, y - x @ found.solution.theta, atol=1e-10)


def test_parameters_and_instruments_beside_are_those_of_the_formulas(given: Given) -> None:
    found = IvRegression.of(given, NOISE)
    z, x, y = dense(given)
    columns = np.random.default_rng(8).standard_normal((y.size, 4))
    columns[found.rows_of[0], :2] = 0.0
    expected = np.linalg.solve(z.T @ x, z.T @ columns)
    np.testing.assert_allclose(found.absorbed(columns), expected, rtol=1e-8, atol=1e-10)
    beside = found.orthogonalized(columns)
    np.testing.assert_allclose(beside, columns - z @ np.linalg.solve(x.T @ z, x.T @ columns), atol=1e-9)
    np.testing.assert_allclose(beside.T @ x / np.linalg.norm(x, axis=0), 0.0, atol=1e-9)
    parts = [(j, columns[own]) for j, own in enumerate(found.rows_of)]
    gram, score = found.orthogonal_products(parts, 2)
    for k in range(2):
        own = beside[:, 2 * k : 2 * k + 2]
        np.testing.assert_allclose(gram[k], own.T @ own, rtol=1e-9)
        np.testing.assert_allclose(score[k], own.T @ found.residual, rtol=1e-8, atol=1e-8)


def test_freed_rows_come_back_with_the_same_values(given: Given) -> None:
    found = IvRegression.of(given, NOISE)
    before = [rows.copy() for rows in found.rows]
    residual = found.residual.copy()
    found.release()
    assert "rows" not in found.__dict__
    for old, new in zip(before, found.rows, strict=True):
        np.testing.assert_array_equal(old, new)
    np.testing.assert_array_equal(found.residual, residual)
    assert len(given.made) == 2


def test_columns_that_are_zero_at_a_joint_are_left_out_whether_copied_or_not(given: Given) -> None:
    for j, columns in enumerate(([0, 1, 2, 3, 4], [2, 3, 4])):
        copied, collected = (JointEquations.of(given.blocks, j, copied=one) for one in (True, False))
        for joint in (copied, collected):
            np.testing.assert_array_equal(joint.x, columns)
            np.testing.assert_array_equal(joint.z, columns)
        for one, other in zip(copied.whitened(NOISE[j]), collected.whitened(NOISE[j]), strict=True):
            np.testing.assert_array_equal(one, other)


def test_equations_left_out_are_in_no_product(given: Given) -> None:
    for block in given.blocks:
        block.keep[::3, 0], block.keep[100:200, 1] = False, False
    z = whitened([b.z for b in given.blocks], NOISE, [b.keep for b in given.blocks])
    expected = factored(z, *stacked(given.blocks, NOISE)).theta
    np.testing.assert_allclose(IvRegression.of(given, NOISE).solution.theta, expected, rtol=1e-10)
    np.testing.assert_allclose(iv_products(given.blocks, NOISE).theta, expected, rtol=1e-10)


def test_a_parameter_that_two_columns_share_belongs_to_the_one_that_is_not_held_at_zero(given: Given) -> None:
    for block in given.blocks:
        block.x[:, :, 4], block.z[:, :, 4] = block.x[:, :, 3], block.z[:, :, 3]
    given.held_at_zero[4] = 1e-10
    theta = IvRegression.of(given, NOISE).solution.theta
    assert abs(theta[4]) < 1e-4 * abs(theta[3])
    both = [replace(b, x=b.x[:, :, :4], z=b.z[:, :, :4]) for b in given.blocks]
    z, x, y = whitened([b.z for b in both], NOISE), *stacked(both, NOISE)
    np.testing.assert_allclose(theta[:4], factored(z, x, y).theta, rtol=1e-4)


def test_tied_parameters_have_one_value_and_fit_as_one_column(given: Given) -> None:
    given.tied = [(4, 2)]
    theta = IvRegression.of(given, NOISE).solution.theta
    assert theta[4] == pytest.approx(theta[2], rel=1e-3)
    both = [replace(b, x=merged(b.x), z=merged(b.z)) for b in given.blocks]
    z, x, y = whitened([b.z for b in both], NOISE), *stacked(both, NOISE)
    np.testing.assert_allclose(theta[:4], factored(z, x, y).theta, rtol=1e-3)


def merged(columns: Array) -> Array:
    """Columns (M, n, 5) with the last one added to the third."""
    return np.concatenate([columns[:, :, :2], columns[:, :, 2:3] + columns[:, :, 4:], columns[:, :, 3:4]], axis=2)
