"""Columns of every effect against its defining equation, computed independently on an analytic motion."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from armident.configs import load_robot
from armident.configs.schema.robot import Effect as Entry
from armident.configs.schema.robot import Limits
from armident.identify.effects.effect import Place
from armident.identify.effects.friction import dahl
from armident.identify.effects.recording_corrections import corrected_experiments
from armident.identify.effects.registry import catalogue
from armident.identify.effects.rotor import rotors
from armident.identify.effects.terms import arm_model
from armident.identify.effects.transmission import crossing, swinging
from armident.identify.robot.motion import Motion
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.inertias import plant_parameters

DT = 1e-3
OMEGA = 2 * np.pi * 0.8
MASS, VISCOUS, COULOMB, OFFSET = 95.0, 200.0, 20.0, -3.0


@pytest.fixture(scope="module")
def axis() -> Motion:
    """The EMPS axis on a sine: its torque is ``m qdd + fv qd + fc sign(qd) + off``."""
    model = arm_model(load_robot("emps"))
    t = DT * np.arange(5000)
    q, qd, qdd = 0.02 * np.sin(OMEGA * t), 0.02 * OMEGA * np.cos(OMEGA * t), -0.02 * OMEGA**2 * np.sin(OMEGA * t)
    theta = np.array([MASS, VISCOUS, COULOMB, OFFSET])
    return Motion(model, q[:, None], qd[:, None], qdd[:, None], DT, 0.0, theta, 5.0)


@pytest.fixture(scope="module")
def arm() -> Motion:
    """The TX40 on sines of different frequencies."""
    model = arm_model(load_robot("tx40"))
    plant = plant_parameters(load_robot("tx40"))
    theta = model.base.regroup @ np.array([plant[name] for name in model.names])
    t, w = DT * np.arange(1500)[:, None], 2 * np.pi * np.linspace(0.4, 1.1, 6)
    phase = np.arange(6.0)
    return Motion(
        model,
        0.6 * np.sin(w * t + phase),
        0.6 * w * np.cos(w * t + phase),
        -0.6 * w**2 * np.sin(w * t + phase),
        DT,
        0.0,
        theta,
        1.5,
    )


def columns(name: str, motion: Motion, joint: int = 0, other: int | None = None, **shapes: float) -> Any:
    return catalogue()[name].torque(motion, Place(joint, other), shapes)


def sign(motion: Motion, joint: int = 0) -> Any:
    return 2 / np.pi * np.arctan(motion.model.smoothing[joint] * motion.qd[:, joint])


def test_viscous_friction_differs_between_the_directions(axis: Motion) -> None:
    found = columns("asymmetric_viscous_friction", axis)[:, 0, 0]
    np.testing.assert_allclose(found, np.abs(axis.qd[:, 0]), atol=2 / (np.pi * axis.model.smoothing[0]))


def test_dry_friction_that_differs_between_the_directions_is_constant_but_at_standstill(axis: Motion) -> None:
    found = columns("asymmetric_coulomb_friction", axis)[:, 0, 0]
    moving = np.abs(axis.qd[:, 0]) > 0.3 * np.abs(axis.qd).max()
    np.testing.assert_allclose(found[moving], 1.0, atol=0.02)
    still = Motion(axis.model, axis.q, 0 * axis.qd, axis.qdd, DT, 0.0, axis.theta, 5.0)
    assert not columns("asymmetric_coulomb_friction", still).any()


def test_the_film_under_one_sided_dry_friction_builds_up_with_the_speed(axis: Motion) -> None:
    v = axis.qd[:, 0]
    slow, fast = (columns("asymmetric_coulomb_friction", axis, velocity=f)[:, 0, 0] for f in (0.1, 0.001))
    assert np.all(slow <= fast)
    at_film = np.argmin(np.abs(v - 0.1))
    assert slow[at_film] == pytest.approx(0.25, abs=0.05)


def test_stribeck_friction_falls_as_a_bell(axis: Motion) -> None:
    v = axis.qd[:, 0]
    expected = np.exp(-(v**2) / 0.03**2) * sign(axis)
    np.testing.assert_allclose(columns("stribeck_friction", axis, velocity=0.03)[:, 0, 0], expected)


def test_a_bristle_of_stribeck_friction_carries_the_dry_friction_of_the_model(axis: Motion) -> None:
    bump, moved = columns("stribeck_friction", axis, velocity=0.03, displacement=1e-4)[:, 0].T
    side = dahl(axis.q[:, 0], 1e-4)
    np.testing.assert_allclose(bump, np.exp(-(axis.qd[:, 0] ** 2) / 0.03**2) * side)
    np.testing.assert_allclose(moved + sign(axis), side)
    assert not columns("stribeck_friction", axis, velocity=0.03)[:, 0, 1].any()


def test_curved_viscous_friction_is_eyrings_law(axis: Motion) -> None:
    found = columns("nonlinear_viscous_friction", axis, velocity=0.02)[:, 0, 0]
    # asinh(x) = log(x + sqrt(x^2 + 1)), an odd function.
    x = np.abs(axis.qd[:, 0]) / 0.02
    np.testing.assert_allclose(found, np.sign(axis.qd[:, 0]) * np.log(x + np.sqrt(x**2 + 1)), atol=1e-12)


def test_no_nonlinear_parameter_depends_on_the_configured_limits(axis: Motion) -> None:
    robot = axis.model.robot
    limits = Limits(position=(-9.0, 5.0), velocity=7.0, acceleration=300.0, torque=4000.0)
    wider = arm_model(robot.model_copy(update={"joints": (robot.joints[0].model_copy(update={"limits": limits}),)}))
    other = replace(axis, model=wider)
    for name, effect in catalogue().items():
        if not effect.two_joints:
            assert effect.grid(axis, Place(0)) == effect.grid(other, Place(0)), name


def test_load_dependent_friction_goes_with_what_the_link_takes(axis: Motion) -> None:
    expected = MASS * np.abs(axis.qdd[:, 0]) * sign(axis)
    np.testing.assert_allclose(columns("load_dependent_friction", axis)[:, 0, 0], expected, rtol=1e-12)


def test_a_rotor_that_passes_for_the_link_s_own_inertia_is_taken_out_of_the_load(arm: Motion) -> None:
    plant = plant_parameters(arm.model.robot)
    known = replace(arm, theta=np.array([plant[name] for name in arm.model.names]))
    # The base parameters count rotor 1 to link 1; the standard ones of the plant do not.
    np.testing.assert_allclose(arm.handed_on(0, plant["ia1"]), known.transmitted[:, 0], atol=1e-9)
    assert np.abs(arm.transmitted[:, 0] - known.transmitted[:, 0]).max() > 0.5
    found = columns("load_dependent_friction", arm, 0, rotor=plant["ia1"])[:, 0, 0]
    np.testing.assert_allclose(found, np.abs(known.transmitted[:, 0]) * sign(arm, 0), atol=1e-9)


def test_a_rotor_is_looked_for_where_only_the_load_can_tell_it(axis: Motion, arm: Motion) -> None:
    assert len(rotors(arm, 0)) == 4
    assert max(rotors(arm, 0)) < arm.slopes(0, links=True)[2][:, 0].min()
    # Rotor 4 is a base parameter; a horizontal axis has no load but its acceleration.
    assert rotors(arm, 3) == rotors(axis, 0) == (0.0,)


@pytest.mark.slow
def test_presliding_is_what_dahl_lacks_of_coulomb(axis: Motion) -> None:
    width = 0.002

    def rate(t: float, z: Any) -> Any:
        v = 0.02 * OMEGA * np.cos(OMEGA * t)
        return (v - np.abs(v) * z) / width

    t = DT * np.arange(axis.samples)
    z = solve_ivp(rate, (0, t[-1]), [0.0], t_eval=t, max_step=1e-3, rtol=1e-6, atol=1e-8).y[0]
    found = columns("presliding_friction", axis, displacement=width)[:, 0, 0]
    np.testing.assert_allclose(found, sign(axis) - z, atol=2e-3)


def test_position_dependent_friction_is_a_wave_against_the_motion(axis: Motion) -> None:
    found = columns("position_dependent_friction", axis, period=0.01)[:, 0]
    amplitude, phase = 1.3, 0.4
    wave = amplitude * np.cos(2 * np.pi * axis.q[:, 0] / 0.01 - phase) * sign(axis)
    np.testing.assert_allclose(found @ [amplitude * np.cos(phase), amplitude * np.sin(phase)], wave, atol=1e-12)


@pytest.mark.parametrize("time_constant", [0.5, 50.0])
def test_drift_changes_friction_once_over_the_recording(axis: Motion, time_constant: float) -> None:
    found = columns("friction_drift", axis, time_constant=time_constant)[:, 0]
    parts = np.stack([sign(axis), axis.qd[:, 0]], axis=1)
    np.testing.assert_allclose(found[0], -0.5 * parts[0], rtol=1e-9)
    np.testing.assert_allclose(found[-1], 0.5 * parts[-1], rtol=1e-3)
    middle = (1 - np.exp(-2.5 / time_constant)) / (1 - np.exp(-5.0 / time_constant)) - 0.5
    np.testing.assert_allclose(found[2500], middle * parts[2500], rtol=1e-9)


def test_coupled_joints_feel_each_other(arm: Motion) -> None:
    found = columns("coupling_friction", arm, 1, 3)
    assert not found[:, [0, 2, 4, 5]].any()
    shaft = 2 / np.pi * np.arctan(arm.model.smoothing[[1, 3]].min() * (arm.qd[:, 1] + arm.qd[:, 3]))
    for one, two in ((1, 3), (3, 1)):
        np.testing.assert_allclose(found[:, one], np.stack([arm.qdd[:, two], arm.qd[:, two], shaft], axis=1))


def test_cogging_of_a_coupled_motor_reaches_both_its_joints(arm: Motion) -> None:
    found = columns("cogging_torque", arm, 5, harmonic=2.0)
    turn = 2.0 * 32.0 * (arm.q[:, 4] + arm.q[:, 5])
    for joint in (4, 5):
        np.testing.assert_allclose(found[:, joint], np.stack([np.cos(turn), np.sin(turn)], axis=1), atol=1e-9)
    assert not found[:, :4].any()


def test_a_spring_pulls_in_proportion(axis: Motion) -> None:
    np.testing.assert_array_equal(columns("joint_spring", axis)[:, 0, 0], axis.q[:, 0])


@pytest.mark.parametrize("damping", [0.1, 0.7])
def test_an_elastic_axis_answers_a_sine_with_the_gain_of_its_two_masses(axis: Motion, damping: float) -> None:
    frequency = 6.0
    w = 2 * np.pi * frequency
    # m l'' = k (q - l) with damping; m q'' the load of the stiff axis, compliance 1 / k = 1.
    gain = 1 / (1 - (OMEGA / w) ** 2 + 2j * damping * OMEGA / w)
    t = DT * np.arange(axis.samples)
    load = MASS * -0.02 * OMEGA**2 * np.exp(1j * OMEGA * t)
    lag = MASS * OMEGA**2 * (gain * load).imag
    found = columns("joint_elasticity", axis, frequency=frequency, damping=damping)[:, 0, 0]
    np.testing.assert_allclose(found[2500:], lag[2500:], atol=2e-3 * np.abs(lag).max())


def test_an_elastic_axis_has_half_the_compliance_of_its_resonance_at_least(axis: Motion) -> None:
    """The mass ``MASS`` on a spring of stiffness ``MASS w^2``, with the motor held."""
    shapes = {"frequency": 6.0, "damping": 0.1, "rotor": 0.0}
    least = catalogue()["joint_elasticity"].least(axis, Place(0), shapes)
    assert least == pytest.approx(0.5 / (MASS * (2 * np.pi * 6.0) ** 2))
    lighter = catalogue()["joint_elasticity"].least(axis, Place(0), {**shapes, "rotor": 0.75 * MASS})
    assert lighter == pytest.approx(4.0 * least)
    assert catalogue()["joint_elasticity"].least(axis, Place(0), {**shapes, "rotor": 1.5 * MASS}) == 0.0
    assert catalogue()["joint_spring"].least(axis, Place(0), {}) == 0.0


def test_a_link_swings_slower_where_it_has_more_inertia() -> None:
    dt, w, damping = 2e-4, 2 * np.pi * 9.0, 0.05
    t = dt * np.arange(10_000)

    def share(at: Any) -> Any:
        return 1.0 + 0.5 * np.sin(4.0 * at)

    def pull(at: Any) -> Any:
        return 1e-3 * np.sin(11.0 * at)

    def motion(at: float, state: Any) -> list[float]:
        return [state[1], (w * w * (pull(at) - state[0]) - 2 * damping * w * state[1]) / share(at)]

    exact = solve_ivp(motion, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-12).y
    way, rate, acceleration = swinging(pull(t), share(t), w, damping, dt)
    np.testing.assert_allclose(way, exact[0], atol=2e-3 * np.abs(exact[0]).max())
    np.testing.assert_allclose(rate, exact[1], atol=2e-3 * np.abs(exact[1]).max())
    force = share(t) * acceleration + 2 * damping * w * rate + w * w * way
    np.testing.assert_allclose(force[1:], (w * w * pull(t))[1:], atol=1e-9 * w * w)


def test_an_elastic_joint_sags_under_gravity(arm: Motion) -> None:
    still = np.zeros((400, 6))
    posture = Motion(
        arm.model, np.tile([0.0, 0.9, 0.4, 0.0, 0.3, 0.0], (400, 1)), still, still, DT, 0.0, arm.theta, 0.4
    )
    sag = 1e-4 * posture.transmitted[0, 1]
    lower = posture.q.copy()
    lower[:, 1] -= sag
    change = arm.model.inverse_dynamics(posture.links, lower, still, still) - posture.transmitted
    found = 1e-4 * columns("joint_elasticity", posture, 1, frequency=20.0)[:, :, 0]
    np.testing.assert_allclose(found, change, atol=2e-3 * np.abs(change).max())


def test_a_gap_is_crossed_in_the_time_of_a_free_fall() -> None:
    pull, gap = 2.0, 1e-3
    way, rate, acceleration = crossing(np.repeat([pull, -pull], 500), gap, 1e-4)
    assert way[499] == pytest.approx(gap / 2)
    assert way[-1] == pytest.approx(-gap / 2)
    landed = 500 + int(np.argmax(way[500:] <= -gap / 2 + 1e-12))
    assert (landed - 500) * 1e-4 == pytest.approx(np.sqrt(2 * gap / pull), abs=2e-4)
    assert not rate[landed + 2 :].any()
    # What the link gains in falling it gives back in the impact.
    assert acceleration[500:].sum() == pytest.approx(0.0, abs=1e-9 * pull)


def test_a_link_in_the_gap_takes_no_torque(axis: Motion) -> None:
    gap = 2e-4
    found = columns("backlash", axis, gap=gap)[:, 0, 0]
    load = MASS * axis.qdd[:, 0]
    way = crossing(-axis.qdd[:, 0], gap, DT)[0]
    free = np.abs(way) < 0.49 * gap
    inside = np.flatnonzero(free[1:-1] & free[:-2] & free[2:]) + 1
    assert inside.size > 50
    np.testing.assert_allclose(found[inside], -load[inside], rtol=1e-6, atol=1e-6)


def test_a_rotor_adds_the_inertia_of_its_own_turns(arm: Motion) -> None:
    found = columns("rotor_inertia", arm, 5)[:, :, 0]
    both = arm.qdd[:, 4] + arm.qdd[:, 5]
    np.testing.assert_allclose(found[:, [4, 5]], np.stack([both, both], axis=1), rtol=1e-9)
    np.testing.assert_allclose(columns("rotor_inertia", arm, 3)[:, 3, 0], arm.qdd[:, 3], rtol=1e-9)


def test_a_tilted_base_feels_a_turned_gravity(arm: Motion) -> None:
    still = np.zeros_like(arm.q)
    size = float(np.linalg.norm(arm.model.chain.gravity))
    tilt = 1e-5
    turned = size * np.array([tilt, 0.0, -np.cos(tilt)])
    expected = (
        arm.model.with_gravity(turned).inverse_dynamics(arm.standard, arm.q, still, still)
        - arm.model.inverse_dynamics(arm.standard, arm.q, still, still)
    ) / tilt
    found = columns("gravity_direction", arm)[:, :, 0]
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_a_tilt_acts_on_weight_beside_a_vertical_joint_that_gravity_along_it_never_shows(arm: Motion) -> None:
    """The moments of the first link are in no base parameter of an upright arm."""
    model, still, tilt = arm.model, np.zeros_like(arm.q), 1e-5
    heavy = arm.standard.copy()
    for name, value in (("mx1", 0.7), ("my1", -0.3)):
        heavy[model.names.index(name)] += value
    size = float(np.linalg.norm(model.chain.gravity))
    turned = model.with_gravity(size * np.array([tilt, 0.5 * tilt, -1.0]))
    torque = (
        turned.inverse_dynamics(heavy, arm.q, still, still) - model.inverse_dynamics(heavy, arm.q, still, still)
    ) / tilt
    found = columns("gravity_direction/vertical_joint", arm)
    values = np.linalg.lstsq(found.reshape(-1, 4), torque.ravel(), rcond=None)[0]
    np.testing.assert_allclose(found @ values, torque, atol=1e-4 * np.abs(torque).max())
    np.testing.assert_allclose(values[:2], [1.0, 0.5], rtol=1e-3)
    assert np.abs(found[:, :, :2] @ [1.0, 0.5] - torque).max() > 0.1 * np.abs(torque).max()


def test_a_spring_of_a_vertical_joint_is_no_tilt(arm: Motion) -> None:
    effect = catalogue()["gravity_direction/vertical_joint"]
    std = np.full(4, 0.01)
    assert not effect.allows(np.array([0.02, -0.02, 3.0, 1.0]), std, {})
    assert effect.allows(np.array([0.02, -0.05, 3.0, 1.0]), std, {})
    assert effect.invisible(arm, Place(0)) is None
    wall = replace(arm, model=arm.model.with_gravity(np.array([9.81, 0.0, 0.0])))
    assert effect.invisible(wall, Place(0)) == "the first joint does not turn about a vertical axis"


def test_a_wrong_gain_scales_the_motor_torque(arm: Motion) -> None:
    tau = arm.model.inverse_dynamics(arm.standard, arm.q, arm.qd, arm.qdd)
    # tau_joint = ratios' tau_motor: motor 6 turns with joints 5 and 6, motor 5 with joint 5 alone.
    found = columns("drive_gain_error", arm, 5)[:, :, 0]
    np.testing.assert_allclose(found[:, 5], tau[:, 5], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[:, 4], tau[:, 5], rtol=1e-9, atol=1e-12)
    found = columns("drive_gain_error", arm, 4)[:, :, 0]
    np.testing.assert_allclose(found[:, 4], tau[:, 4] - tau[:, 5], rtol=1e-9, atol=1e-9)


def test_saturation_grows_with_the_cube_of_the_torque(axis: Motion) -> None:
    tau = axis.torque[:, 0]
    knee = 40.0 * np.abs(tau).max()
    current = tau / np.sqrt(1 - (tau / knee) ** 2)
    loss = axis.model.robot.joints[0].limits.torque ** 2 / (2 * knee**2)
    found = loss * columns("drive_gain_saturation", axis)[:, 0, 0]
    np.testing.assert_allclose(found, current - tau, rtol=2e-3, atol=1e-9)


def test_a_recording_of_a_saturated_motor_is_corrected_to_its_end(axis: Motion) -> None:
    robot, tau = axis.model.robot, axis.torque[:, :1]
    knee = 1.1 * np.abs(tau).max()
    loss = robot.joints[0].limits.torque ** 2 / (2 * knee**2)
    entry = Entry(effect="drive_gain_saturation", joint=robot.joints[0].name, parameters={"gain_loss": loss})
    current = Experiment(axis.q, tau / np.sqrt(1 - (tau / knee) ** 2), None, axis.dt)
    (found,) = corrected_experiments([current], robot.model_copy(update={"effects": (entry,)}))
    np.testing.assert_allclose(found.tau, tau, rtol=1e-9, atol=1e-12)


def test_the_loss_at_the_torque_limit_is_the_same_in_every_motion(arm: Motion) -> None:
    half = replace(arm, q=arm.q[:700], qd=arm.qd[:700], qdd=arm.qdd[:700])
    for joint in range(6):
        whole, part = (columns("drive_gain_saturation", m, joint)[:700] for m in (arm, half))
        np.testing.assert_allclose(part, whole, rtol=1e-9, atol=1e-12)


def smooth(axis: Motion) -> Motion:
    """The axis without dry friction: its torque is a sine."""
    return Motion(axis.model, axis.q, axis.qd, axis.qdd, DT, 0.0, np.array([MASS, VISCOUS, 0.0, 0.0]), 5.0)


def test_a_late_torque_is_that_of_earlier(axis: Motion) -> None:
    motion, late = smooth(axis), 3
    found = late * DT * columns("time_delay", motion)[:, 0, 0]
    tau = motion.torque[:, 0]
    expected = tau[:-late] - tau[late:]
    np.testing.assert_allclose(found[late:], expected, atol=0.02 * np.abs(expected).max())


def test_a_lagging_motor_is_commanded_ahead_of_its_torque(axis: Motion) -> None:
    motion, lag = smooth(axis), 0.002
    tau = motion.torque[:, 0]
    command = tau + lag * columns("actuator_bandwidth", motion)[:, 0, 0]
    followed = np.empty_like(tau)
    followed[0] = tau[0]
    for k in range(1, tau.size):
        # Exact for a command that is held over the sample, its mean.
        mean = 0.5 * (command[k - 1] + command[k])
        followed[k] = mean + (followed[k - 1] - mean) * np.exp(-DT / lag)
    np.testing.assert_allclose(followed[50:], tau[50:], atol=2e-3 * np.abs(tau).max())


@pytest.mark.parametrize("name", ["time_delay", "actuator_bandwidth"])
def test_a_delay_is_no_fault_within_the_uncertain_instant_of_all_torques(name: str) -> None:
    effect = catalogue()[name]
    assert effect.is_convention(np.array([0.0008]), 1e-3)
    assert not effect.is_convention(np.array([0.0008]), 2e-4)
    assert not effect.is_convention(np.array([0.0008]), 0.0)


def test_an_eccentric_encoder_shows_a_motion_that_is_not_there(arm: Motion) -> None:
    joint, h, size = 2, 2.0, 1e-6
    found = columns("encoder_eccentricity", arm, joint, harmonic=h)
    t = DT * np.arange(arm.samples)
    w, phase = 2 * np.pi * np.linspace(0.4, 1.1, 6)[joint], float(joint)

    def wave(t: Any) -> Any:
        return np.sin(h * 0.6 * np.sin(w * t + phase))

    step = 1e-4
    rate = (wave(t + step) - wave(t - step)) / (2 * step)
    acceleration = (wave(t + step) - 2 * wave(t) + wave(t - step)) / step**2
    real = [arm.q.copy(), arm.qd.copy(), arm.qdd.copy()]
    for signal, error in zip(real, (wave(t), rate, acceleration), strict=True):
        signal[:, joint] -= size * error
    expected = (arm.model.inverse_dynamics(arm.standard, *real) - arm.torque) / size
    np.testing.assert_allclose(found[:, :, 1], expected, atol=1e-3 * np.abs(expected).max())
