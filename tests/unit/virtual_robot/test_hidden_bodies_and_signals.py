"""Hidden bodies, drives, wiring and encoders: statics, kinematics and signals against hand calculations."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig, Trajectory
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.trajectory import Move
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.effects import EFFECTS, hidden_effects
from armident.virtual_robot.effects.signals import Signals
from armident.virtual_robot.offline import simulate_recording
from armident.virtual_robot.plant import Plant, pin
from tests.plant_torques import acceleration, resistance
from tests.statistics.twin_effects import SIZES
from tests.unit.hidden import hide

PERIOD = 200e-6
Q = np.array([0.3, 0.4, 1.1, -0.5, 0.7, 0.2])


def weight(plant: Plant, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Static torques (n,) at ``q`` without friction, from the acceleration at rest."""
    still = np.zeros(q.size)
    held = resistance(plant, q, still)
    plant.q[:] = q
    out: NDArray[np.float64] = -plant.mass_matrix() @ acceleration(plant, q, still, held)
    return out


def tool_point(robot: RobotConfig, q: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position of a point of the last link's frame (modified Denavit-Hartenberg table, by hand)."""
    pose = np.eye(4)
    for joint, angle in zip(robot.joints, q, strict=True):
        a, t = joint.mdh.alpha, joint.mdh.theta + angle
        ca, sa, ct, st = math.cos(a), math.sin(a), math.cos(t), math.sin(t)
        pose = pose @ np.array(
            [
                [ct, -st, 0, joint.mdh.d],
                [ca * st, ca * ct, -sa, -joint.mdh.r * sa],
                [sa * st, sa * ct, ca, joint.mdh.r * ca],
                [0, 0, 0, 1],
            ]
        )
    out: NDArray[np.float64] = (pose @ np.append(point, 1.0))[:3]
    return out


def test_a_payload_weighs_and_resists_acceleration_as_its_mass_at_its_place(tx40: RobotConfig) -> None:
    mass, place, radius = 1.5, np.array([0.03, -0.02, 0.12]), 0.06
    loaded = Plant(tx40, Q, hide("payload", "joint_6", mass=mass, x=0.03, y=-0.02, z=0.12, radius=radius))
    healthy, step = Plant(tx40, Q), 1e-6
    jacobian = np.array(
        [
            (tool_point(tx40, Q + step * e, place) - tool_point(tx40, Q - step * e, place)) / (2 * step)
            for e in np.eye(6)
        ]
    ).T
    np.testing.assert_allclose(weight(loaded, Q) - weight(healthy, Q), 9.81 * mass * jacobian[2], atol=1e-6)
    added = loaded.mass_matrix() - healthy.mass_matrix()
    # A ball has the same inertia about all axes: mass radius^2 times the angular velocities' products.
    data = healthy.model.createData()
    turning = pin.computeJointJacobian(healthy.model, data, Q, 6)[3:]
    np.testing.assert_allclose(added, mass * (jacobian.T @ jacobian + radius**2 * turning.T @ turning), atol=1e-6)


def test_a_payload_on_a_sliding_carriage_is_mass_alone(emps: RobotConfig) -> None:
    loaded = Plant(emps, [0.0], hide("payload", "joint_1", mass=7.0))
    assert loaded.mass_matrix()[0, 0] == pytest.approx(95.1089 + 7.0)
    assert weight(loaded, np.zeros(1))[0] == pytest.approx(0.0, abs=1e-9)


def test_a_rotor_adds_its_inertia_where_it_turns(tx40: RobotConfig) -> None:
    healthy = Plant(tx40, Q).mass_matrix()
    own = Plant(tx40, Q, hide("rotor_inertia", "joint_4", inertia=0.02)).mass_matrix() - healthy
    assert own[3, 3] == pytest.approx(0.02)
    assert np.count_nonzero(np.abs(own) > 1e-12) == 1
    coupled = Plant(tx40, Q, hide("rotor_inertia", "joint_4", "joint_5", inertia=0.01)).mass_matrix() - healthy
    assert coupled[3, 4] == coupled[4, 3] == pytest.approx(0.01)
    assert np.count_nonzero(np.abs(coupled) > 1e-12) == 2


def test_a_tilted_base_turns_gravity_and_keeps_its_size(tx40: RobotConfig, emps: RobotConfig) -> None:
    for azimuth in (0.0, 1.0):
        plant = Plant(tx40, Q, hide("gravity_direction", "joint_1", tilt=0.2, azimuth=azimuth))
        gravity = plant.model.gravity.linear
        assert np.linalg.norm(gravity) == pytest.approx(9.81)
        assert gravity[2] == pytest.approx(-9.81 * math.cos(0.2))
        assert gravity[:2] @ [math.cos(azimuth), math.sin(azimuth)] == pytest.approx(0.0, abs=1e-12)
    rail = Plant(emps, [0.0], hide("gravity_direction", "joint_1", tilt=0.03))
    assert abs(weight(rail, np.zeros(1))[0]) == pytest.approx(95.1089 * 9.81 * math.sin(0.03))


def test_a_shaking_floor_pushes_with_mass_times_acceleration(emps: RobotConfig) -> None:
    plant, still = Plant(emps, [0.0], hide("base_vibration", "joint_1", amplitude=0.3, frequency=5.0)), np.zeros(1)
    for t in (0.0, 0.03, 0.05, 0.11):
        a = acceleration(plant, still, still, resistance(plant, still, still), t)[0]
        assert abs(a) == pytest.approx(0.3 * abs(math.sin(2 * math.pi * 5.0 * t)), abs=1e-12)


def signals(robot: RobotConfig, effect: str, joint: str, other: str | None = None, **parameters: float) -> Signals:
    return Signals(hidden_effects(hide(effect, joint, other, **parameters), robot), robot, PERIOD)


def healthy_torque(robot: RobotConfig, current: NDArray[np.float64]) -> NDArray[np.float64]:
    gain = np.array([joint.drive.gain for joint in robot.joints])
    out: NDArray[np.float64] = robot.transmission_matrix.T @ (gain * current)
    return out


CURRENT = np.array([1.0, -2.0, 3.0, 0.5, -0.7, 1.1])


def test_a_wrong_gain_scales_the_torque_of_its_motor(tx40: RobotConfig) -> None:
    wrong = signals(tx40, "drive_gain_error", "joint_6", error=-0.1)
    scaled = CURRENT * np.array([1, 1, 1, 1, 1, 0.9])
    # Motor 6 acts on joints 5 and 6.
    np.testing.assert_allclose(wrong.applied(CURRENT), healthy_torque(tx40, scaled))
    np.testing.assert_allclose(wrong.reported(CURRENT), CURRENT)


def test_a_saturating_motor_loses_its_share_at_the_torque_given_and_nothing_near_zero(tx40: RobotConfig) -> None:
    iron = signals(tx40, "drive_gain_saturation", "joint_3", drop=0.2, torque=30.0)
    per_ampere = 45.0 * 0.25
    for side in (1.0, -1.0):
        current = np.zeros(6)
        current[2] = side * 30.0 / per_ampere
        assert iron.applied(current)[2] == pytest.approx(side * 24.0)
        assert iron.applied(0.01 * current)[2] == pytest.approx(side * 0.3, rel=1e-4)


def test_a_slow_actuator_gives_the_mean_of_its_exponential_over_every_period(tx40: RobotConfig) -> None:
    lag = signals(tx40, "actuator_bandwidth", "joint_2", time_constant=3e-3)
    one = np.zeros(6)
    one[1] = 1.0
    given = np.array([lag.applied(one)[1] for _ in range(100)]) / (32 * 0.4)
    fine = (np.arange(100 * 1000) + 0.5) * PERIOD / 1000
    exact = (1 - np.exp(-fine / 3e-3)).reshape(100, 1000).mean(axis=1)
    np.testing.assert_allclose(given, exact, rtol=1e-6)
    np.testing.assert_allclose(lag.reported(one), one)


@pytest.mark.parametrize("delay", [0.0, 2 * PERIOD, 3.6 * PERIOD])
def test_a_delay_reports_what_was_whole_or_fractional_samples_ago(tx40: RobotConfig, delay: float) -> None:
    late = signals(tx40, "time_delay", "joint_4", delay=delay)
    ramp = np.array([late.reported(np.full(6, 0.1 * k)) for k in range(50)])
    np.testing.assert_allclose(ramp[10:, 3], 0.1 * (np.arange(10, 50) - delay / PERIOD), atol=1e-12)
    np.testing.assert_allclose(ramp[:, 0], 0.1 * np.arange(50))
    np.testing.assert_allclose(late.applied(CURRENT), healthy_torque(tx40, CURRENT))


def test_crosstalk_and_ripple_are_read_but_not_applied(tx40: RobotConfig) -> None:
    leak = signals(tx40, "current_crosstalk", "joint_1", "joint_3", share=0.1)
    read = leak.reported(CURRENT) - CURRENT
    # A tenth of the 45 * 0.25 * 3 N m of joint 3, read by a drive with 32 * 0.4 N m/A.
    assert read[0] == pytest.approx(0.1 * 45 * 0.25 * 3.0 / (32 * 0.4))
    assert np.abs(read[1:]).max() == 0.0
    hum = signals(tx40, "mains_ripple", "joint_2", amplitude=2.0, frequency=50.0)
    tone = np.array([hum.reported(np.zeros(6))[1] for _ in range(1000)]) * 32 * 0.4
    np.testing.assert_allclose(tone, 2.0 * np.sin(2 * np.pi * 50.0 * np.arange(1000) * PERIOD), atol=1e-9)
    for effect in (leak, hum):
        np.testing.assert_allclose(effect.applied(CURRENT), healthy_torque(tx40, CURRENT))


def test_an_eccentric_encoder_is_wrong_by_its_wave_at_its_own_motor(tx40: RobotConfig) -> None:
    ratio = tx40.transmission_matrix
    for joint, row, motor, angle in (("joint_2", 1, 0.0, Q[1]), ("joint_6", 5, 1.0, ratio[5] @ Q)):
        disc = signals(tx40, "encoder_eccentricity", joint, amplitude=2e-3, per_turn=2.0, phase=0.4, motor=motor)
        error = ratio @ disc.measured(Q) - ratio @ Q
        assert error[row] == pytest.approx(ratio[row, row] * 2e-3 * math.sin(2 * angle + 0.4))
        assert np.abs(np.delete(error, row)).max() < 1e-12


def test_a_drive_follows_its_eccentric_encoder_away_from_the_true_angle(emps: RobotConfig) -> None:
    """The stiff loop of the EMPS keeps the measured position at the demand, so the carriage is off by the error."""
    effect = hide("encoder_eccentricity", "joint_1", amplitude=1e-4, per_turn=5.0, phase=0.0)
    ends = []
    for hidden in (None, effect):
        arm = Arm(emps, [0.02], noise=0.0, scenario=hidden)
        arm.enable(0, True)
        goal = np.array([round(0.05 * 2e7)], np.int32)
        for _ in range(1500):
            arm.set_targets(goal, np.ones(1, np.bool_))
            arm.advance()
        ends.append(arm.plant.q[0])
    wave = 1e-4 * math.sin(2 * math.pi * 5.0 * ends[1])
    assert abs(wave) > 5e-5
    # Friction lets the two stop 1e-5 m apart.
    assert ends[1] - ends[0] == pytest.approx(-wave, abs=2e-5)


def record(robot: RobotConfig, scenario: Scenario | None, noise: float = 1.0) -> dict[str, NDArray[np.float64]]:
    """Positions, efforts and demands of a short move, raw numbers."""
    if robot.n == 6:
        start: tuple[float, ...] = (0.0, 0.0, 1.57, 0.0, 0.0, 0.0)
        to: tuple[float, ...] = (0.3, 0.2, 1.3, 0.4, 0.4, -0.4)
    else:
        start, to = (0.0,), (0.05,)
    trajectory = Trajectory(schema="armident/trajectory/1", start=start, moves=(Move(to=to, duration=0.5),))
    recording = simulate_recording(robot, trajectory, 3, noise, scenario, settle=0.1)
    effort = "current" if robot.n == 6 else "voltage"
    raw = recording.samples.raw
    return {
        "position": raw["position"].astype(float),
        "effort": raw[effort].astype(float),
        "demand": recording.streams["demand"].raw["demand"].astype(float),
    }


@pytest.mark.slow
def test_wrong_signs_and_names_change_the_recording_and_nothing_else(tx40: RobotConfig) -> None:
    healthy = record(tx40, None)
    sign = record(tx40, hide("sign_error", "joint_2"))
    flipped = np.array([1, -1, 1, 1, 1, 1])
    np.testing.assert_array_equal(sign["effort"], healthy["effort"] * flipped)
    np.testing.assert_array_equal(sign["position"], healthy["position"])
    turned = record(tx40, hide("sign_error", "joint_2", torque=0.0, position=1.0))
    np.testing.assert_array_equal(turned["effort"], healthy["effort"])
    np.testing.assert_array_equal(turned["position"], healthy["position"] * flipped)
    np.testing.assert_array_equal(turned["demand"], healthy["demand"] * flipped)
    order = [0, 4, 2, 3, 1, 5]
    names = record(tx40, hide("joint_order", "joint_2", "joint_5"))
    wires = record(tx40, hide("joint_order", "joint_2", "joint_5", position=0.0))
    for key in healthy:
        np.testing.assert_array_equal(names[key], healthy[key][:, order])
        np.testing.assert_array_equal(wires[key], healthy[key][:, order] if key == "effort" else healthy[key])


ON_EMPS = {
    "asymmetric_viscous_friction": {"fva": 0.3 * 203.5}, "payload": {"mass": 2.0}, "slosh_payload": {"mass": 1.0},
}  # fmt: skip
"""Sizes that show on an axis of 95 kg with much friction."""
NEED_SIZE = [name for name in sorted(SIZES) if None in (p.default for p in EFFECTS[name].parameters.values())]
CASES = [("tx40", effect) for effect in NEED_SIZE]
CASES += [("emps", effect) for effect in NEED_SIZE if EFFECTS[effect].other != "required"]


@pytest.fixture(scope="module")
def quiet(tx40: RobotConfig, emps: RobotConfig) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Recordings of the healthy arms without noise."""
    return {robot.name: record(robot, None, noise=0.0) for robot in (tx40, emps)}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "effect"), CASES)
def test_every_effect_shows_in_a_recording_and_leaves_the_arm_under_control(
    tx40: RobotConfig,
    emps: RobotConfig,
    quiet: dict[str, dict[str, NDArray[np.float64]]],
    name: str,
    effect: str,
) -> None:
    robot, healthy = {"tx40": tx40, "emps": emps}[name], quiet[name]
    pair = EFFECTS[effect].other == "required"
    joint = "joint_1" if EFFECTS[effect].first_joint or robot.n == 1 else "joint_2"
    options = SIZES[effect](next(each.limits for each in robot.joints if each.name == joint))
    if name == "emps":
        options = ON_EMPS.get(effect, options)
    hidden = record(robot, hide(effect, joint, "joint_3" if pair else None, **options), noise=0.0)
    inside = slice(len(healthy["effort"]) // 5, None)
    shown = np.abs(hidden["effort"] - healthy["effort"])[inside].max(axis=0)
    assert shown.max() > 5, "per mille of the rated signal"
    # Below the drives' saturation, and within 1 % of the range of the healthy arm's path.
    path = np.abs(hidden["position"] - healthy["position"]).max(axis=0)
    counts = np.array([joint.drive.counts_per_unit or 0.0 for joint in robot.joints])
    reach = np.abs(np.diag(robot.transmission_matrix)) * (counts / (2 * np.pi) if robot.n == 6 else counts)
    width = np.array([joint.limits.position[1] - joint.limits.position[0] for joint in robot.joints])
    assert (path < 0.01 * width * reach).all()


def test_a_slower_bus_sees_the_same_drives(tx40: RobotConfig) -> None:
    """At a SYNC of 1 ms the drives still control every 200 us."""
    slow, fast = (Arm(tx40, Q, sync, seed=5) for sync in (1e-3, PERIOD))
    for arm in (slow, fast):
        for joint in range(6):
            arm.enable(joint, True)
            arm.interpolation_time(joint, 1e-3)
    goal = slow.demand.copy()
    for k in range(200):
        goal += np.int32(40)
        for arm in (slow, fast):
            arm.set_targets(goal, np.ones(6, np.bool_))
        slow.advance()
        for _ in range(5):
            fast.advance()
        np.testing.assert_array_equal(slow.position, fast.position, err_msg=str(k))
        np.testing.assert_array_equal(slow.current, fast.current)
    assert np.abs(slow.demand - goal).max() == 0


def test_a_recording_can_be_sampled_at_one_kilohertz(tx40: RobotConfig) -> None:
    trajectory = Trajectory(
        schema="armident/trajectory/1",
        start=(0.0, 0.0, 1.57, 0.0, 0.0, 0.0),
        moves=(Move(to=(0.3, 0.2, 1.3, 0.4, 0.4, -0.4), duration=0.5),),
    )
    recording = simulate_recording(tx40, trajectory, 3, period=1e-3, setpoint_every=1, settle=0.1)
    assert recording.sample_rate_hz == pytest.approx(1000.0)
    assert np.unique(np.diff(recording.samples.t_ns)).tolist() == [1_000_000]
    first, last = recording.experiments()[0]
    assert last - first == 500
