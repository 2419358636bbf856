"""Physical least squares of the set-up check against a general solver, with and without the elimination."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize

from armident.identify.setup.limited_least_squares import every_column, normal_equations

Array = NDArray[np.float64]

N, OWN, SHARED, ROWS = 3, 2, 3, 40
C = N * OWN + SHARED
PLACES = SHARED + np.arange(N * OWN).reshape(N, OWN)


def problem(seed: int) -> tuple[Array, Array, Array]:
    """Regressors (n, M, c), torques (n, M) of parameters that pass their limits, and limits (2 n, c)."""
    rng = np.random.default_rng(seed)
    x, limits = np.zeros((N, ROWS, C)), np.zeros((2 * N, C))
    for m in range(N):
        columns = [*range(SHARED), *PLACES[m]]
        x[m][:, columns] = rng.normal(size=(ROWS, len(columns)))
        limits[m, columns] = rng.normal(size=len(columns))
        limits[N + m, PLACES[m]] = rng.normal(size=OWN)
    y = x @ rng.normal(size=C) + (1.0 + np.arange(N)[:, None]) * rng.normal(size=(N, ROWS))
    return x, y, limits


@pytest.mark.parametrize("seed", range(4))
def test_the_fit_is_that_of_a_general_solver(seed: int) -> None:
    x, y, limits = problem(seed)
    power = (y**2).sum(axis=1)
    grams, products = x.transpose(0, 2, 1) @ x, np.einsum("mkc,mk->mc", x, y)
    normal = normal_equations(grams, limits, np.ones(N, np.bool_), PLACES, np.arange(SHARED))
    found = normal.solve(products, power, 1)

    def loss(theta: Array) -> float:
        return float((((y - x @ theta) ** 2).sum(axis=1) / power).sum())

    constraints = optimize.LinearConstraint(limits, 0.0, np.inf)
    best = optimize.minimize(loss, np.zeros(C), method="SLSQP", constraints=constraints, options={"ftol": 1e-14})
    assert np.any(limits @ np.linalg.lstsq(np.concatenate(x), np.concatenate(y), rcond=None)[0] < 0.0)
    # The ridge is a millionth of the columns' powers.
    np.testing.assert_allclose(found.theta, best.x, atol=1e-4)
    np.testing.assert_allclose(found.shares, ((y - x @ found.theta) ** 2).sum(axis=1) / power, rtol=1e-9)
    np.testing.assert_allclose(found.explained, products @ found.theta, rtol=1e-9)


def test_the_elimination_changes_nothing_with_a_torque_that_does_not_count_and_a_zero_column() -> None:
    x, y, limits = problem(5)
    x[:, :, PLACES[1, 0]] = 0.0
    used, power = np.array([True, True, False]), (y**2).sum(axis=1)
    grams, products = x.transpose(0, 2, 1) @ x, np.einsum("mkc,mk->mc", x, y)
    with_it = normal_equations(grams, limits, used, PLACES, np.arange(SHARED)).solve(products, power)
    without = every_column(grams, limits, used).solve(products, power)
    np.testing.assert_allclose(with_it.theta, without.theta, atol=1e-10)
    np.testing.assert_allclose(with_it.shares[used], without.shares[used], rtol=1e-9)
    assert not with_it.theta[[PLACES[1, 0], *PLACES[2]]].any()
    assert (limits @ with_it.theta)[:2].min() > -1e-9


def test_equations_of_some_torques_are_those_in_which_only_these_count() -> None:
    x, y, limits = problem(6)
    used, power = np.array([True, False, True]), (y**2).sum(axis=1)
    grams, products = x.transpose(0, 2, 1) @ x, np.einsum("mkc,mk->mc", x, y)
    every = normal_equations(grams, limits, np.ones(N, np.bool_), PLACES, np.arange(SHARED))
    held = limits * np.tile(used, 2)[:, None]
    alone = normal_equations(grams, held, used, PLACES, np.arange(SHARED)).solve(products, power)
    found = every.of(used).solve(products, power)
    np.testing.assert_allclose(found.shares[used], alone.shares[used], rtol=1e-9)
    np.testing.assert_allclose(found.theta[[*range(SHARED), *PLACES[0], *PLACES[2]]], alone.theta[alone.theta != 0])
    assert np.abs(found.shares / every.solve(products, power).shares - 1.0)[used].max() > 1e-3
