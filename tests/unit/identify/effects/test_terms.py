"""Effects of a robot configuration as model terms: identification, simulation, refused entries."""

from typing import Any

import numpy as np
import pytest

from armident.configs import ConfigError, RobotConfig, load_robot
from armident.configs.schema.robot import Effect
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.controller.nominal import nominal_controller
from armident.identify.effects.registry import catalogue
from armident.identify.effects.terms import arm_model
from armident.identify.effects.wiring import rewired
from armident.identify.estimators.methods import Method
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.identification.options import Options
from armident.identify.robot import relaxation
from armident.identify.robot.relaxation import simulate_with_terms
from armident.identify.robot.simulation import simulate
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.inertias import plant_parameters
from tests.fixtures.arms import FAST, recording

DT = 1e-3


def with_effects(robot: RobotConfig, *entries: Effect) -> RobotConfig:
    return robot.model_copy(update={"effects": entries})


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return load_robot("tx40")


@pytest.fixture(scope="module")
def theta(robot: RobotConfig) -> Any:
    model, plant = arm_model(robot), plant_parameters(robot)
    return model.base.regroup @ np.array([plant[name] for name in model.names])


def reference(robot: RobotConfig) -> Any:
    t = DT * np.arange(3000)
    phases = np.linspace(0.0, 2.0, robot.n)
    return np.stack([0.5 * np.sin(2 * np.pi * (0.6 + 0.1 * j) * t + phases[j]) for j in range(robot.n)], axis=1)


def test_viscous_friction_as_a_term_moves_the_simulated_arm_like_that_of_the_model(
    robot: RobotConfig, theta: Any
) -> None:
    model = arm_model(robot)
    q_ref = reference(robot)
    controller = nominal_controller(model, theta, q_ref[::50], DT, 10.0)
    more = theta.copy()
    more[model.base.names.index("fv2")] += 2.0
    expected = simulate(model, more, controller, q_ref, DT)
    entry = Effect(effect="nonlinear_viscous_friction", joint="joint_2", parameters={"velocity": 100.0})
    extended = arm_model(with_effects(robot, entry))
    # Far below its characteristic velocity, 100 rad/s, the term is viscous friction.
    found = simulate_with_terms(extended, np.append(theta, 2.0 * 100.0), controller, q_ref, DT)
    lag = np.abs(expected.q - simulate(model, theta, controller, q_ref, DT).q).max()
    # A load held over a sample instead of acting at once is worth a few thousandths of its effect.
    assert np.abs(found.q - expected.q).max() < 0.02 * lag
    assert np.linalg.norm(found.tau - expected.tau) < 0.002 * np.linalg.norm(expected.tau)


def test_the_torque_of_terms_is_their_regressor_times_their_values(robot: RobotConfig, theta: Any) -> None:
    ripple = Effect(effect="cogging_torque", joint="joint_6", parameters={"harmonic": 6.0})
    friction = Effect(effect="nonlinear_viscous_friction", joint="joint_2", parameters={"velocity": 0.3})
    model = arm_model(with_effects(robot, ripple, friction))
    q = reference(robot)
    qd = np.gradient(q, DT, axis=0)
    motion = model.motion(q, qd, np.gradient(qd, DT, axis=0), DT)
    values = np.array([0.3, -0.7, 5.0])
    torque = model.term_torque(motion, values)
    assert np.ptp(torque, axis=0)[[1, 4, 5]].min() > 0.1
    np.testing.assert_allclose(torque, model.term_regressor(motion) @ values, atol=1e-12)


@pytest.mark.parametrize("wrong", [False, True], ids=["own motion", "motion of another amplitude"])
def test_a_simulation_that_begins_at_a_motion_ends_where_the_one_without_does(
    robot: RobotConfig, theta: Any, wrong: bool
) -> None:
    q_ref = reference(robot)
    controller = nominal_controller(arm_model(robot), theta, q_ref[::50], DT, 10.0)
    entry = Effect(effect="nonlinear_viscous_friction", joint="joint_2", parameters={"velocity": 0.3})
    extended, whole = arm_model(with_effects(robot, entry)), np.append(theta, 5.0)
    expected = simulate_with_terms(extended, whole, controller, q_ref, DT)
    scale = 3.0 if wrong else 1.0
    motion = Derivatives(scale * expected.q, scale * expected.qd, scale * expected.qdd, None, DT)
    found = simulate_with_terms(extended, whole, controller, q_ref, DT, motion=motion)
    np.testing.assert_allclose(found.q, expected.q, atol=2e-3 * np.abs(expected.q).max())
    once = simulate_with_terms(extended, whole, controller, q_ref, DT, motion=motion, rounds=1)
    apart = np.linalg.norm(once.q - expected.q) / np.linalg.norm(
        expected.q - simulate(extended, whole, controller, q_ref, DT).q
    )
    assert apart > 0.1 if wrong else apart < 0.02


@pytest.mark.parametrize(
    ("effect", "linear", "shapes"),
    [
        ("time_delay", 0.006, {}),
        ("actuator_bandwidth", 0.015, {}),
        ("joint_elasticity", 0.001, {"frequency": 8.0, "rotor": 0.3}),
        ("backlash", 0.8, {"gap": 0.01, "rotor": 0.3}),
    ],
)
def test_a_simulated_arm_feels_the_torque_that_its_own_motion_gives_a_term(
    robot: RobotConfig, theta: Any, effect: str, linear: float, shapes: dict[str, float]
) -> None:
    """The torque of a late or elastic drive depends on accelerations and torques, and so on itself."""
    model = arm_model(robot)
    q_ref = reference(robot)
    controller = nominal_controller(model, theta, q_ref[::50], DT, 10.0)
    entry = Effect(effect=effect, joint="joint_1", parameters=shapes)
    whole = np.append(theta, linear)
    extended = arm_model(with_effects(robot, entry)).anchored(whole)
    found = simulate_with_terms(extended, whole, controller, q_ref, DT, band_hz=30.0)
    assert found.diverged_at is None
    torque = extended.term_regressor(extended.motion(found.q, found.qd, found.qdd, DT))[:, 0, 0] * linear
    own = butterworth(np.append(0.5 * (torque[1:] + torque[:-1]), torque[-1]), DT, 30.0)
    rigid = simulate(model, theta, controller, q_ref, DT, disturbance=-_on_joint_1(own, robot))
    felt = np.abs(rigid.q - simulate(model, theta, controller, q_ref, DT).q)[:, 0].max()
    assert np.abs(found.q - rigid.q)[:, 0].max() < 0.05 * felt


def test_the_torque_of_terms_at_the_rate_of_its_band_moves_the_arm_as_at_every_sample(
    robot: RobotConfig, theta: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 1 kHz a load below 5 Hz is computed at every tenth sample. Both filters differ for 0.2 s at the ends."""
    model, q_ref = arm_model(robot), reference(robot)
    controller = nominal_controller(model, theta, q_ref[::50], DT, 10.0)
    entry = Effect(effect="joint_spring", joint="joint_2")
    whole = np.append(theta, np.full(arm_model(with_effects(robot, entry)).e, 20.0))
    extended = arm_model(with_effects(robot, entry)).anchored(whole)
    rare = simulate_with_terms(extended, whole, controller, q_ref, DT, band_hz=5.0)
    monkeypatch.setattr(relaxation, "RATE", 1e9)
    dense = simulate_with_terms(extended, whole, controller, q_ref, DT, band_hz=5.0)
    inner = slice(200, -200)
    felt = np.abs(dense.q - simulate(model, theta, controller, q_ref, DT).q)[inner, 1].max()
    assert 0.0 < np.abs(rare.q - dense.q)[inner].max() < 0.02 * felt
    assert np.linalg.norm((rare.tau - dense.tau)[inner]) < 0.01 * np.linalg.norm(dense.tau[inner])


def test_a_term_that_is_more_inertia_than_the_joint_has_itself_is_felt_at_every_instant(
    robot: RobotConfig, theta: Any
) -> None:
    """An explicit scheme would diverge with a rotor heavier than its link."""
    model = arm_model(robot)
    q_ref = reference(robot)
    rotor = 2.0 * float(model.mass_matrix(theta, q_ref[:1])[0, 3, 3])
    controller = nominal_controller(model, theta, q_ref[::50], DT, 10.0)
    extended = arm_model(with_effects(robot, Effect(effect="rotor_inertia", joint="joint_4")))
    added = np.zeros(robot.n)
    added[3] = rotor
    expected = simulate(model, theta, controller, q_ref, DT, inertia=added)
    found = simulate_with_terms(extended, np.append(theta, rotor), controller, q_ref, DT, band_hz=30.0)
    felt = np.abs(expected.q - simulate(model, theta, controller, q_ref, DT).q)[:, 3].max()
    assert np.abs(found.q - expected.q)[:, 3].max() < 0.01 * felt
    assert np.linalg.norm(found.tau - expected.tau) < 0.01 * np.linalg.norm(expected.tau)


def test_a_drive_that_gives_half_its_torque_moves_an_axis_of_twice_the_parameters_alike() -> None:
    """The drive reports half the torque, and its controller has twice the gain."""
    plain = load_robot("emps")
    model = arm_model(plain)
    values = np.array([95.0, 200.0, 20.0, -3.0])[: model.base.b]
    t = DT * np.arange(3000)
    q_ref = (0.1 * np.sin(2 * np.pi * 0.7 * t))[:, None]
    controller = nominal_controller(model, values, q_ref[::50], DT, 10.0)
    expected = simulate(model, values, controller, q_ref, DT)
    halved = arm_model(with_effects(plain, Effect(effect="drive_gain_error", joint="joint_1")))
    found = simulate_with_terms(halved, np.append(2.0 * values, -0.5), controller, q_ref, DT)
    assert np.linalg.norm(found.tau - expected.tau) < 0.02 * np.linalg.norm(expected.tau)


def _on_joint_1(torque: Any, robot: RobotConfig) -> Any:
    joints = np.zeros((torque.size, robot.n))
    joints[:, 0] = torque
    return joints @ np.linalg.inv(robot.transmission_matrix)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [*(pytest.param(m, marks=pytest.mark.nightly) for m in ("idim-ls", "idim-iv")), "idim-piv", "didim"]
)
def test_every_method_estimates_a_term_with_the_rest(robot: RobotConfig, method: Method) -> None:
    worn = HiddenEffect(effect="asymmetric_viscous_friction", joint="joint_2", parameters={"fva": 0.2 * 5.5})
    data = recording("tx40", "tx40_excitation", 63, worn, period=FAST)
    known = with_effects(robot, Effect(effect="asymmetric_viscous_friction", joint="joint_2"))
    document = identify_recording(data, known, Options(method=method), check=None).document
    (added,) = [p for p in document.parameters if p.name == "fva2"]
    # 0.2 of the 5.5 N m s/rad of table B.4.
    assert added.value == pytest.approx(0.2 * 5.5, abs=3.5 * added.std)
    assert added.essential
    assert added.unit == "N m s/rad"


@pytest.mark.slow
def test_a_wrong_drive_gain_is_identified_beside_the_dynamics(robot: RobotConfig) -> None:
    data = recording("tx40", "tx40_excitation", 3, period=FAST)
    joints = list(robot.joints)
    drive = joints[1].drive
    joints[1] = joints[1].model_copy(update={"drive": drive.model_copy(update={"gain": 1.2 * drive.gain})})
    mistaken = robot.model_copy(update={"joints": tuple(joints)})
    known = with_effects(mistaken, Effect(effect="drive_gain_error", joint="joint_2"))
    document = identify_recording(data, known, Options(method="idim-iv"), check=None).document
    (gain,) = [p for p in document.parameters if p.name == "gain_error2"]
    # Torques reported 1.2 times too large are 0.2 more than those the model predicts.
    assert gain.value == pytest.approx(0.2, abs=3.5 * gain.std)
    (inertia,) = [p for p in document.parameters if p.name == "mx2r"]
    assert inertia.value == pytest.approx(2.21, abs=4 * inertia.std)


def test_two_harmonics_of_one_ripple_have_names_of_their_own(robot: RobotConfig) -> None:
    ripples = [Effect(effect="cogging_torque", joint="joint_3", parameters={"harmonic": h}) for h in (1.0, 2.0)]
    names = arm_model(with_effects(robot, *ripples)).base.names
    assert names[-4:] == ("cgc3", "cgs3", "cgc3_2", "cgs3_2")


def test_a_pair_needs_its_second_joint_and_others_must_have_none(robot: RobotConfig) -> None:
    with pytest.raises(ConfigError, match=r"coupling_friction of joint_1: other: expected the second joint"):
        arm_model(with_effects(robot, Effect(effect="coupling_friction", joint="joint_1")))
    alone = Effect(effect="joint_spring", joint="joint_1", other="joint_2")
    with pytest.raises(ConfigError, match=r"joint_spring of joint_1: other: only an effect between two joints"):
        arm_model(with_effects(robot, alone))


def test_a_missing_nonlinear_parameter_is_asked_for(robot: RobotConfig) -> None:
    with pytest.raises(ConfigError, match=r"stribeck_friction of joint_1 needs velocity"):
        arm_model(with_effects(robot, Effect(effect="stribeck_friction", joint="joint_1")))


def test_a_parameter_that_goes_with_another_is_there_only_with_it(robot: RobotConfig) -> None:
    rigid = Effect(effect="stribeck_friction", joint="joint_3", parameters={"velocity": 0.1})
    bristle = Effect(effect="stribeck_friction", joint="joint_3", parameters={"velocity": 0.1, "displacement": 1e-4})
    assert arm_model(with_effects(robot, rigid)).base.names[-1:] == ("fst3",)
    assert arm_model(with_effects(robot, bristle)).base.names[-2:] == ("fst3", "fsb3")


def test_terms_of_the_wrist_coupling_are_those_of_the_configured_coupling(robot: RobotConfig) -> None:
    rng = np.random.default_rng(5)
    q, qd, qdd = rng.normal(size=(3, 40, 6))
    coupled = arm_model(robot)
    bare = robot.model_copy(update={"couplings": ()})
    as_term = arm_model(with_effects(bare, Effect(effect="coupling_friction", joint="joint_5", other="joint_6")))
    np.testing.assert_allclose(
        as_term.base_regressor(q, qd, qdd, dt=DT)[:, :, -3:], coupled.base_regressor(q, qd, qdd)[:, :, -3:], atol=1e-14
    )


def test_exchanged_drives_are_corrected_before_anything_else(robot: RobotConfig) -> None:
    rng = np.random.default_rng(6)
    right = Experiment(rng.normal(size=(20, 6)), rng.normal(size=(20, 6)), rng.normal(size=(20, 6)), DT)
    swapped = with_effects(
        robot,
        Effect(effect="joint_order", joint="joint_5", other="joint_6", parameters={"position": 1.0, "torque": 1.0}),
        Effect(effect="sign_error", joint="joint_2", parameters={"torque": 1.0}),
    )
    (wrong,) = rewired([right], swapped)
    ratios = robot.transmission_matrix
    motors, torques = wrong.q @ ratios.T, wrong.tau @ np.linalg.inv(ratios)
    np.testing.assert_allclose(motors[:, [4, 5]], (right.q @ ratios.T)[:, [5, 4]])
    np.testing.assert_allclose(torques[:, 1], -(right.tau @ np.linalg.inv(ratios))[:, 1])
    (again,) = rewired([wrong], swapped)
    np.testing.assert_allclose(again.q, right.q)
    np.testing.assert_allclose(again.tau, right.tau)


def test_every_entry_of_the_catalogue_is_described(robot: RobotConfig) -> None:
    for effect in catalogue().values():
        assert effect.title, effect.name
        assert effect.description, effect.name
        assert effect.reference, effect.name
        assert effect.required_motion, effect.name
        names = [p.name for p in effect.linear] + [shape.name for shape in effect.shapes]
        assert len(set(names)) == len(names)
