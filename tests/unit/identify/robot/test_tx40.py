"""The model of the TX40 and of the EMPS: counts, names and formulas of the thesis, dynamics of Pinocchio."""

import re

import numpy as np
import pinocchio as pin
import pytest

from armident.configs import ArmidentError, load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.base_parameters import independent_columns
from tests.pinocchio_oracle import pinocchio_model, random_parameters

TABLE_B2 = {
    "1": "zz1r",
    "2": "xx2r xy2 xz2r yz2 zz2r mx2r my2",
    "3": "xx3r xy3 xz3 yz3 zz3r mx3 my3r ia3",
    "4": "xx4r xy4 xz4 yz4 zz4r mx4 my4r ia4",
    "5": "xx5r xy5 xz5 yz5 zz5r mx5 my5r ia5",
    "6": "xx6r xy6 xz6 yz6 zz6 mx6 my6 ia6",
}
"""Base inertial parameters by link; my2 is needed for the 61 of the text."""

TABLE_B3 = {
    "zz1r": "zz1 + ia1 + yy2 + yy3 + 2*r3*mz3 + (r3^2 + d3^2)*(m3+m4+m5+m6)",
    "xx2r": "xx2 - yy2 - d3^2*(m3+m4+m5+m6)",
    "xz2r": "xz2 - d3*mz3 - r3*d3*(m3+m4+m5+m6)",
    "zz2r": "zz2 + ia2 + d3^2*(m3+m4+m5+m6)",
    "mx2r": "mx2 + d3*(m3+m4+m5+m6)",
    "xx3r": "xx3 - yy3 + yy4 + 2*r4*mz4 + r4^2*(m4+m5+m6)",
    "zz3r": "zz3 + yy4 + 2*r4*mz4 + r4^2*(m4+m5+m6)",
    "my3r": "my3 - mz4 - r4*(m4+m5+m6)",
    "xx4r": "xx4 - yy4 + yy5",
    "zz4r": "zz4 + yy5",
    "my4r": "my4 + mz5",
    "xx5r": "xx5 - yy5 + yy6",
    "zz5r": "zz5 + yy6",
    "my5r": "my5 - mz6",
    "xx6r": "xx6 - yy6",
}


@pytest.fixture(scope="module")
def tx40() -> ArmModel:
    return arm_model(load_robot("tx40"))


def value(formula: str, numbers: dict[str, float]) -> float:
    python = re.sub(r"[a-z]+\d", lambda name: repr(numbers[name.group()]), formula.replace("^", "**"))
    return float(eval(python, {"__builtins__": {}}))


def numbers_of(model: ArmModel, theta: np.ndarray) -> dict[str, float]:
    numbers = dict(zip(model.names, (float(v) for v in theta), strict=True))
    for k, joint in enumerate(model.robot.joints, start=1):
        numbers |= {f"d{k}": joint.mdh.d, f"r{k}": joint.mdh.r}
    return numbers


def test_tx40_has_87_standard_and_61_base_parameters(tx40: ArmModel) -> None:
    assert len(tx40.names) == 87
    assert tx40.base.b == 61
    assert len(tx40.base.eliminated) == 11
    assert len(tx40.base.regrouped) == 15


def test_tx40_base_parameters_have_the_names_of_table_b2(tx40: ArmModel) -> None:
    inertial = [name for name in tx40.base.names if not name.startswith(("fv", "fc", "off", "iam"))]
    assert inertial == " ".join(TABLE_B2.values()).split()
    friction = [f"{kind}{k}" for k in range(1, 7) for kind in ("fv", "fc", "off")]
    assert set(tx40.base.names) - set(inertial) == {*friction, "iam6", "fvm6", "fcm6"}


def test_tx40_regrouping_is_that_of_table_b3(tx40: ArmModel) -> None:
    theta = np.random.default_rng(0).normal(size=87)
    numbers = numbers_of(tx40, theta)
    base = dict(zip(tx40.base.names, tx40.base.regroup @ theta, strict=True))
    assert {name for name in base if name.endswith("r")} == set(TABLE_B3)
    for name, formula in TABLE_B3.items():
        assert base[name] == pytest.approx(value(formula, numbers), abs=1e-12), name


def test_formulas_say_what_the_regrouping_matrix_does(tx40: ArmModel) -> None:
    theta = np.random.default_rng(1).normal(size=87)
    numbers = numbers_of(tx40, theta)
    for name, expected in zip(tx40.base.names, tx40.base.regroup @ theta, strict=True):
        formula = tx40.base.formulas[name]
        if name in TABLE_B3:
            assert value(formula, numbers) == pytest.approx(expected, abs=1e-12), formula
        else:
            assert formula == name


def test_qr_of_the_full_regressor_keeps_the_columns_of_the_tables(tx40: ArmModel) -> None:
    kept, mixing = independent_columns(tx40.robot, tx40.chain, tx40.columns, tx40.names)
    assert np.array_equal(kept, tx40.base.independent)
    assert np.abs(mixing - tx40.base.regroup).max() < 1e-9


def test_base_parameters_put_back_as_standard_ones_give_the_same_dynamics(tx40: ArmModel) -> None:
    rng = np.random.default_rng(2)
    theta = random_parameters(tx40, rng, friction=True)
    again = tx40.standard_from_base(tx40.base.regroup @ theta)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 50, 6))
    tau = tx40.inverse_dynamics(theta, q, qd, qdd)
    assert np.abs(tx40.inverse_dynamics(again, q, qd, qdd) - tau).max() < 1e-11
    assert np.abs(tx40.mass_matrix(again, q) - tx40.mass_matrix(theta, q)).max() < 1e-11


def test_tx40_dynamics_agree_with_pinocchio(tx40: ArmModel) -> None:
    rng = np.random.default_rng(3)
    theta = random_parameters(tx40, rng)
    values = tx40.values(theta)
    oracle = pinocchio_model(tx40.robot, values.inertial, values.ia)
    data = oracle.createData()
    q, qd, qdd = rng.uniform(-3.0, 3.0, (3, 200, 6))
    tau = tx40.inverse_dynamics(theta, q, qd, qdd)
    back = tx40.forward_dynamics(theta, q, qd, tau)
    for k in range(200):
        expected = pin.rnea(oracle, data, q[k], qd[k], qdd[k])
        assert np.abs(tau[k] - expected).max() < 1e-10
        assert np.abs(back[k] - pin.aba(oracle, data, q[k], qd[k], expected)).max() < 1e-10


def test_wrist_coupling_acts_on_both_joints_as_in_b1(tx40: ArmModel) -> None:
    theta = np.zeros(87)
    where = {name: k for k, name in enumerate(tx40.names)}
    theta[[where["iam6"], where["fvm6"], where["fcm6"]]] = 0.02, 0.6, 1.9
    rng = np.random.default_rng(4)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 20, 6))
    tau = tx40.inverse_dynamics(theta, q, qd, qdd, sharp_sign=True)
    common = 1.9 * np.sign(qd[:, 4] + qd[:, 5])
    assert np.allclose(tau[:, :4], 0.0)
    assert np.allclose(tau[:, 4], 0.02 * qdd[:, 5] + 0.6 * qd[:, 5] + common)
    assert np.allclose(tau[:, 5], 0.02 * qdd[:, 4] + 0.6 * qd[:, 4] + common)


def test_smoothed_sign_is_the_arctangent_of_the_thesis(tx40: ArmModel) -> None:
    qd = np.linspace(-0.1, 0.1, 21)[:, None] * np.ones(6)
    still = np.zeros_like(qd)
    column = tx40.names.index("fc3")
    smooth = tx40.regressor(still, qd, still)[:, 2, column]
    assert np.allclose(smooth, 2.0 / np.pi * np.arctan(150.0 * qd[:, 2]), atol=1e-15)
    assert np.array_equal(tx40.regressor(still, qd, still, sharp_sign=True)[:, 2, column], np.sign(qd[:, 2]))


def test_emps_has_mass_friction_and_offset_only() -> None:
    model = arm_model(load_robot("emps"))
    assert model.base.names == ("m1", "fv1", "fc1", "off1")
    qd = np.array([[0.2], [-0.1]])
    phi = model.base_regressor(np.zeros((2, 1)), qd, np.array([[3.0], [4.0]]), sharp_sign=True)
    assert np.array_equal(phi[:, 0], [[3.0, 0.2, 1.0, 1.0], [4.0, -0.1, -1.0, 1.0]])


def test_parameters_that_are_not_physical_are_refused_by_direct_dynamics(tx40: ArmModel) -> None:
    with pytest.raises(ArmidentError, match="not positive definite at sample 0"):
        tx40.forward_dynamics(np.zeros(87), np.zeros((1, 6)), np.zeros((1, 6)), np.zeros((1, 6)))


def test_signals_of_the_wrong_shape_are_refused(tx40: ArmModel) -> None:
    with pytest.raises(ValueError, match="expected signals of shape"):
        tx40.regressor(np.zeros((4, 6)), np.zeros((5, 6)), np.zeros((4, 6)))
    with pytest.raises(ValueError, match=r"expected \(87,\) standard or \(61,\) base"):
        tx40.inverse_dynamics(np.zeros(60), np.zeros((4, 6)), np.zeros((4, 6)), np.zeros((4, 6)))
