"""The model of random chains against Pinocchio, and the two ways to base parameters against each other."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from armident.configs import ConfigError, RobotConfig, load_robot
from armident.configs.urdf import mdh_of
from armident.configs.urdf_tree import read_chain
from armident.identify.effects.terms import arm_model
from armident.identify.robot.base_parameters import independent_columns
from armident.identify.robot.chain import chain_of, columns_of, standard_names
from armident.identify.robot.khalil import coefficients_at, khalil_rules, lengths_of
from tests.pinocchio_oracle import TO_OURS, Floats, pinocchio_model, random_parameters, random_robot
from tests.urdf_chains import configuration, link_frames, random_urdf

chains = st.tuples(st.integers(0, 2**31), st.integers(1, 7), st.booleans())


@pytest.mark.slow
@given(chains)
def test_dynamics_agree_with_pinocchio_on_random_chains(chain: tuple[int, int, bool]) -> None:
    seed, n, right_angles = chain
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n, right_angles)
    model = arm_model(robot)
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


@pytest.mark.slow
@given(chains)
def test_regressor_times_parameters_is_inverse_dynamics(chain: tuple[int, int, bool]) -> None:
    seed, n, right_angles = chain
    rng = np.random.default_rng(seed)
    model = arm_model(random_robot(rng, n, right_angles))
    theta = random_parameters(model, rng, friction=True)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 20, n))
    for sharp in (False, True):
        tau = model.inverse_dynamics(theta, q, qd, qdd, sharp_sign=sharp)
        scale = 1.0 + np.abs(tau).max()
        assert np.abs(model.regressor(q, qd, qdd, sharp_sign=sharp) @ theta - tau).max() < 1e-12 * scale
        base = model.base.regroup @ theta
        assert np.abs(model.base_regressor(q, qd, qdd, sharp_sign=sharp) @ base - tau).max() < 1e-9 * scale
        assert np.abs(model.inverse_dynamics(base, q, qd, qdd, sharp_sign=sharp) - tau).max() < 1e-9 * scale


def from_urdf(folder: Path, rng: np.random.Generator, n: int, right_angles: bool) -> tuple[RobotConfig, Any, Floats]:
    """A random URDF as our configuration, as Pinocchio's model, and its link frames in ours (n, 4, 4)."""
    gravity = np.array([0.0, 0.0, -9.81]) if right_angles else rng.normal(size=3)
    file = folder / "random.urdf"
    file.write_text(random_urdf(rng, n, right_angles))
    (folder / "random.yaml").write_text(configuration(file, n, gravity))
    oracle = pin.buildModelFromXML(file.read_text())
    oracle.gravity.linear = gravity
    joints = read_chain(file)
    try:
        robot = load_robot(folder / "random.yaml")
    except ConfigError as error:
        assume("nearly parallel" not in str(error))
        raise
    return robot, oracle, link_frames(joints, mdh_of(joints, file))


def in_our_frames(bodies: list[Any], theirs_in_ours: Floats) -> Floats:
    """Inertial parameters of bodies given in the links of a URDF, in our frames and our order (n, 10)."""
    placed = [body.se3Action(pin.SE3(frame)) for body, frame in zip(bodies, theirs_in_ours, strict=True)]
    return np.array([body.toDynamicParameters()[np.argsort(TO_OURS)] for body in placed])


@pytest.mark.slow
@given(chains)
def test_a_urdf_has_the_dynamics_that_pinocchio_reads_from_it(
    tmp_path_factory: pytest.TempPathFactory, chain: tuple[int, int, bool]
) -> None:
    seed, n, right_angles = chain
    rng = np.random.default_rng(seed)
    robot, oracle, frames = from_urdf(tmp_path_factory.mktemp("urdf"), rng, n, right_angles)
    model, data = arm_model(robot), oracle.createData()
    theta = np.zeros(len(model.names))
    theta[model.columns.inertial] = in_our_frames(list(oracle.inertias)[1:], frames)
    for j in np.flatnonzero(model.columns.ia >= 0):
        theta[model.columns.ia[j]] = oracle.armature[j] = rng.uniform(0.05, 0.5)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 4, n))
    tau = model.inverse_dynamics(theta, q, qd, qdd)
    mass = model.mass_matrix(theta, q)
    accelerations = model.forward_dynamics(theta, q, qd, tau)
    regressor = model.regressor(q, qd, qdd)
    base_tau = model.base_regressor(q, qd, qdd) @ (model.base.regroup @ theta)
    # Ten bodies per link, columns of (n, 10, 10): any inertial parameters are a mixture of theirs.
    samples = [[pin.Inertia.Random() for _ in range(n)] for _ in range(10)]
    in_ours = np.stack([in_our_frames(bodies, frames) for bodies in samples], axis=2)
    in_theirs = np.stack([[body.toDynamicParameters() for body in bodies] for bodies in samples], axis=2)
    for k in range(4):
        # Joints without end have cosine and sine in Pinocchio.
        posture = pin.integrate(oracle, pin.neutral(oracle), q[k])
        expected = pin.rnea(oracle, data, posture, qd[k], qdd[k])
        scale = 1.0 + np.abs(expected).max()
        assert np.abs(tau[k] - expected).max() < 1e-10 * scale
        assert np.abs(base_tau[k] - expected).max() < 1e-9 * scale
        upper = np.triu(pin.crba(oracle, data, posture))
        assert np.abs(mass[k] - upper - np.triu(upper, 1).T).max() < 1e-10 * (1.0 + np.abs(upper).max())
        expected = pin.computeJointTorqueRegressor(oracle, data, posture, qd[k], qdd[k]).reshape(n, n, 10)
        expected = np.einsum("jlp,lpc->jlc", expected, in_theirs)
        ours = np.einsum("jlp,lpc->jlc", regressor[k][:, model.columns.inertial], in_ours)
        assert np.abs(ours - expected).max() < 1e-10 * (1.0 + np.abs(expected).max())
        expected = pin.aba(oracle, data, posture, qd[k], tau[k])
        assert np.abs(accelerations[k] - expected).max() < 1e-10 * np.linalg.cond(mass[k]) * (
            1 + np.abs(expected).max()
        )


def assert_rules_and_qr_agree(robot: RobotConfig) -> None:
    chain, names = chain_of(robot), standard_names(robot)
    forms = khalil_rules(robot, chain, names)
    kept, mixing = independent_columns(robot, chain, columns_of(robot, names), names)
    assert list(forms) == [names[k] for k in kept]
    lengths = lengths_of(chain)
    rules = np.array([coefficients_at(form, lengths, names) for form in forms.values()])
    assert np.abs(rules - mixing).max() < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("right_angles", [True, False])
@given(seed=st.integers(0, 2**31), n=st.integers(1, 7))
def test_rules_and_qr_find_the_same_base_parameters(right_angles: bool, seed: int, n: int) -> None:
    assert_rules_and_qr_agree(random_robot(np.random.default_rng(seed), n, right_angles))


@pytest.mark.slow
@pytest.mark.parametrize("right_angles", [True, False])
@given(seed=st.integers(0, 2**31), n=st.integers(1, 7))
def test_rules_and_qr_find_the_same_base_parameters_of_a_urdf(
    tmp_path_factory: pytest.TempPathFactory, right_angles: bool, seed: int, n: int
) -> None:
    robot, _, _ = from_urdf(tmp_path_factory.mktemp("urdf"), np.random.default_rng(seed), n, right_angles)
    assert_rules_and_qr_agree(robot)
