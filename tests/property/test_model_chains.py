"""The model of random chains against Pinocchio, and the two ways to base parameters against each other."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identify.model.arm import ArmModel
from identify.model.base_parameters import independent_columns
from identify.model.chain import chain_of, columns_of, standard_names
from identify.model.khalil import evaluate, khalil_rules, lengths_of
from tests.pinocchio_oracle import TO_OURS, pinocchio_model, random_parameters, random_robot

chains = st.tuples(st.integers(0, 2**31), st.integers(1, 7), st.booleans())


@settings(max_examples=30, deadline=None)
@given(chains)
def test_dynamics_agree_with_pinocchio_on_random_chains(chain: tuple[int, int, bool]) -> None:
    seed, n, right_angles = chain
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n, right_angles)
    model = ArmModel.from_config(robot)
    theta = random_parameters(model, rng)
    values = model.values(theta)
    oracle = pinocchio_model(robot, values.inertial, values.ia)
    data = oracle.createData()
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 5, n))
    tau = model.inverse_dynamics(theta, q, qd, qdd)
    mass = model.mass_matrix(theta, q)
    accelerations = model.forward_dynamics(theta, q, qd, tau)
    regressor = model.regressor(q, qd, qdd)
    for k in range(5):
        expected = pin.rnea(oracle, data, q[k], qd[k], qdd[k])
        scale = 1.0 + np.abs(expected).max()
        assert np.abs(tau[k] - expected).max() < 1e-10 * scale
        upper = np.triu(pin.crba(oracle, data, q[k]))
        assert np.abs(mass[k] - upper - np.triu(upper, 1).T).max() < 1e-10 * (1.0 + np.abs(upper).max())
        expected = pin.computeJointTorqueRegressor(oracle, data, q[k], qd[k], qdd[k]).reshape(n, n, 10)
        ours = regressor[k][:, model.columns.inertial[:, TO_OURS]]
        assert np.abs(ours - expected).max() < 1e-10 * (1.0 + np.abs(expected).max())
        expected = pin.aba(oracle, data, q[k], qd[k], tau[k])
        # The conditioning of the mass matrix amplifies the rounding of both sides.
        assert np.abs(accelerations[k] - expected).max() < 1e-10 * np.linalg.cond(mass[k]) * (
            1 + np.abs(expected).max()
        )


@settings(max_examples=30, deadline=None)
@given(chains)
def test_regressor_times_parameters_is_inverse_dynamics(chain: tuple[int, int, bool]) -> None:
    seed, n, right_angles = chain
    rng = np.random.default_rng(seed)
    model = ArmModel.from_config(random_robot(rng, n, right_angles))
    theta = random_parameters(model, rng, friction=True)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 20, n))
    for sharp in (False, True):
        tau = model.inverse_dynamics(theta, q, qd, qdd, sharp_sign=sharp)
        scale = 1.0 + np.abs(tau).max()
        assert np.abs(model.regressor(q, qd, qdd, sharp_sign=sharp) @ theta - tau).max() < 1e-12 * scale
        base = model.base.regroup @ theta
        assert np.abs(model.base_regressor(q, qd, qdd, sharp_sign=sharp) @ base - tau).max() < 1e-9 * scale
        assert np.abs(model.inverse_dynamics(base, q, qd, qdd, sharp_sign=sharp) - tau).max() < 1e-9 * scale


@pytest.mark.parametrize("right_angles", [True, False])
@settings(max_examples=75, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 7))
def test_rules_and_qr_find_the_same_base_parameters(right_angles: bool, seed: int, n: int) -> None:
    robot = random_robot(np.random.default_rng(seed), n, right_angles)
    chain, names = chain_of(robot), standard_names(robot)
    forms = khalil_rules(robot, chain, names)
    kept, mixing = independent_columns(robot, chain, columns_of(robot, names), names)
    assert list(forms) == [names[k] for k in kept]
    lengths = lengths_of(chain)
    rules = np.array([evaluate(form, lengths, names) for form in forms.values()])
    assert np.abs(rules - mixing).max() < 1e-7
