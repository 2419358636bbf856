"""Virtual arms of any configuration: parameters from URDF, identification or seed, and what is assumed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import armident
from armident.configs import ConfigError, RobotConfig, Scenario, load_robot, load_session, load_trajectory
from armident.configs.loading import HERE, parse
from armident.configs.units import counts_per_si
from armident.daq.recording import read_recording
from armident.virtual_robot import servo
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.arm_parameters import arm_parameters, with_scenario
from armident.virtual_robot.drawn_parameters import TORQUE_SHARE, draw_bodies, torque_scale
from armident.virtual_robot.offline import effort_of, simulate_recording
from armident.virtual_robot.plant import Plant
from armident.virtual_robot.plausible_motion import plausible_trajectory
from armident.virtual_robot.run import record_robot
from armident.virtual_robot.twin import (
    BUS_RANGE,
    ParameterChoice,
    at_period,
    complete,
    load_twin,
    on_virtual_bus,
    write_twin,
)
from tests.fixtures.other_arms import write_scara
from tests.plant_torques import acceleration, resistance
from tests.tools.tx40_inertias import pseudo_inertia


@pytest.fixture(scope="module")
def panda() -> RobotConfig:
    return load_robot("panda")


def document(arm: RobotConfig, **changes: Any) -> dict[str, Any]:
    """The part of an identification that a virtual arm reads, with the drawn parameters of seed 7."""
    standard = arm_parameters(arm, seed=7).standard
    measured = {name: value for name, value in standard.items() if not name.startswith("ia")}
    physical = {"parameters": [{"name": k, "value": v} for k, v in measured.items()], "compatible": True}
    return {"schema": "armident/identification/1", "robot": arm.name, "physical": physical} | changes


def test_drawn_links_are_bodies_and_load_the_joints_as_their_limits_allow(panda: RobotConfig) -> None:
    for seed in range(5):
        standard = draw_bodies(panda, seed)
        assert all(np.linalg.eigvalsh(pseudo_inertia(standard, link))[0] > 0.0 for link in range(1, 8))
        masses = [standard[f"m{link}"] for link in range(1, 8)]
        assert masses == sorted(masses, reverse=True)
        load = torque_scale(panda, standard)
        share = load.gravity / np.array([joint.limits.torque for joint in panda.joints])
        assert share.max() < TORQUE_SHARE


def test_the_same_seed_draws_the_same_arm_and_another_seed_another(panda: RobotConfig) -> None:
    one, same, other = (arm_parameters(panda, seed=seed).standard for seed in (1, 1, 2))
    assert one == same
    assert all(one[name] != other[name] for name in ("m3", "xx2", "fv1", "fc7", "off4"))


def test_an_arm_without_torque_limits_gets_some(panda: RobotConfig) -> None:
    joints = tuple(j.model_copy(update={"limits": type(j.limits)(position=j.limits.position)}) for j in panda.joints)
    bare = panda.model_copy(update={"joints": joints, "transmission": None})
    robot, parameters, assumed = complete(bare)
    robot.check_movable()
    text = "\n".join(assumed)
    for key in ("velocity", "acceleration", "torque"):
        assert f"limits.{key}: joint_1 " in text
    assert "transmission: the identity" in text
    again, same, _ = complete(robot)
    assert again == robot
    assert same.standard == pytest.approx(parameters.standard), "the assumed limits are those of the same masses"
    gravity = torque_scale(robot, parameters.standard).gravity
    assert (gravity < [joint.limits.torque for joint in robot.joints]).all()


def test_the_torque_limit_fits_the_signal_on_the_bus(panda: RobotConfig) -> None:
    robot, _, assumed = complete(panda)
    for joint in robot.joints:
        assert joint.limits.torque < BUS_RANGE * joint.drive.rated
    assert any(entry.startswith("drive.rated: joint_1 ") for entry in assumed)
    small = panda.joints[0].drive.model_copy(update={"rated": 1.0})
    given = panda.model_copy(
        update={"joints": (panda.joints[0].model_copy(update={"drive": small}), *panda.joints[1:])}
    )
    _, _, assumed = complete(given)
    assert any("drive.rated of joint_1: the bus holds 32.8 of the 87" in entry for entry in assumed)


def test_the_masses_of_a_urdf_move_the_arm(tmp_path: Path) -> None:
    twin = load_twin(write_scara(tmp_path))
    assert "masses and inertias: of the URDF" in twin.parameters.sources
    plant = Plant(twin.robot, twin.parameters.rest, None, twin.parameters)
    standard = twin.parameters.standard
    mass = plant.mass_matrix()
    # quill and flange move with the lift; upper arm, forearm and they weigh nothing at vertical axes
    assert mass[2, 2] - standard["ia3"] == pytest.approx(1.2 + 0.4)
    hold = acceleration(plant, plant.q, np.zeros(4), np.array([0.0, 0.0, 9.81 * 1.6, 0.0]))
    offset = np.linalg.solve(mass, [standard[f"off{j}"] for j in range(1, 5)])
    np.testing.assert_allclose(hold + offset, 0.0, atol=1e-9)
    drawn = load_twin(tmp_path / "scara.yaml", ParameterChoice(draw_masses=True))
    assert drawn.parameters.standard["m3"] != pytest.approx(1.2)


def test_a_link_without_mass_gets_a_drawn_one_and_it_is_said(tmp_path: Path) -> None:
    config = write_scara(tmp_path)
    file = tmp_path / "scara.urdf"
    file.write_text(file.read_text().replace('<mass value="0.4"/>', ""))
    twin = load_twin(config)
    assert "masses behind spin: drawn from seed 0, the URDF has none there" in twin.parameters.sources
    assert twin.parameters.standard["m4"] > 0.0


def test_an_identification_gives_the_parameters(panda: RobotConfig, tmp_path: Path) -> None:
    file = tmp_path / "identification.json"
    file.write_text(json.dumps(document(panda)))
    parameters = arm_parameters(panda, model=file, seed=1)
    drawn = arm_parameters(panda, seed=7).standard
    assert parameters.standard == pytest.approx(drawn)
    assert parameters.sources == (f"parameters: the physically consistent ones of {file}",)


def test_the_reversal_of_friction_is_that_of_the_identification(panda: RobotConfig, tmp_path: Path) -> None:
    file = tmp_path / "identification.json"
    smoothing = {joint.name: 100.0 + k for k, joint in enumerate(panda.joints)}
    file.write_text(json.dumps(document(panda, sign_smoothing=smoothing)))
    free = panda.model_copy(update={"friction": type(panda.friction)()})
    robot, _, assumed = complete(free, model=file)
    assert robot.friction.sign_smoothing == tuple(smoothing.values())
    assert not any("sign_smoothing" in entry for entry in assumed)
    assert complete(panda, model=file)[0].friction == panda.friction, "that of the configuration counts"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sign_smoothing": {"joint_1": 5.0}}, "sign_smoothing: expected a number for each joint"),
        ({"robot": "tx40"}, "is of robot 'tx40', the configuration is of 'panda'"),
        ({"physical": None}, r"no physically consistent parameters; identify again: .* --physical"),
        ({"physical": {"parameters": []}}, "physical.parameters: no xx1; identify again with this configuration"),
        ({"physical": {"parameters": [{"name": "m1"}]}}, "expected names and values"),
        ({"physical": {"parameters": [{"name": "m1", "value": float("nan")}]}}, "expected finite values"),
        ({"schema": "armident/diagnosis/2"}, "expected an identification.json"),
    ],
)
def test_a_document_that_has_no_arm_is_refused(
    changes: dict[str, Any], message: str, panda: RobotConfig, tmp_path: Path
) -> None:
    file = tmp_path / "identification.json"
    file.write_text(json.dumps(document(panda, **changes)))
    with pytest.raises(ConfigError, match=message):
        arm_parameters(panda, model=file)


def test_what_is_no_document_is_refused(panda: RobotConfig, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.json: cannot be read"):
        arm_parameters(panda, model=tmp_path / "none.json")
    (tmp_path / "text.json").write_text("{")
    with pytest.raises(ConfigError, match=r"text\.json: is no JSON document"):
        arm_parameters(panda, model=tmp_path / "text.json")


def test_the_effects_of_an_identified_model_are_named_as_not_played(panda: RobotConfig, tmp_path: Path) -> None:
    content = document(panda)
    content["physical"]["parameters"].append({"name": "spring3", "value": 4.0})
    file = tmp_path / "identification.json"
    file.write_text(json.dumps(content))
    assert any(source.startswith("not played: spring3") for source in arm_parameters(panda, model=file).sources)


def scenario(text: str) -> Scenario:
    return parse(f"schema: armident/scenario/1\n{text}", Scenario, "scenario")


def test_a_scenario_sets_controller_friction_and_noise(panda: RobotConfig) -> None:
    given = scenario(
        "controller: {bandwidth_hz: 12.0}\n"
        "friction: {joint_2: {viscous: 2.5, offset: 0.25}}\n"
        "noise: {joint_1: {std: 0.5}, joint_3: {std: 1.0, std_below_20_hz: 0.4}}\n"
    )
    robot, parameters, _ = complete(panda)
    arm = Arm(robot, parameters.rest, 1e-3, seed=1, scenario=given, parameters=parameters)
    chosen = with_scenario(parameters, robot, given)
    for joint in range(7):
        arm.enable(joint, True)
    brake = resistance(arm.plant, np.zeros(7), np.array([0.0, 2.0, 0, 0, 0, 0, 0]))
    assert brake[1] == pytest.approx(2.0 * 2.5 + 0.25 + parameters.standard["fc2"], rel=1e-2)
    assert chosen.noise.sampled[0] == pytest.approx(0.25)
    assert chosen.noise.decimated[2] == pytest.approx(0.16)
    assert chosen.bandwidth_hz == (12.0,) * 7
    healthy = Arm(robot, parameters.rest, 1e-3, parameters=parameters)
    assert (arm._servo.kp > healthy._servo.kp).all()


def test_given_gains_replace_those_of_the_configuration(tmp_path: Path) -> None:
    emps = load_robot("emps")
    gains = scenario("controller: {gains: {kp: [100.0], kv: [200.0], velocity_samples: 3}}\n")
    drives = Arm(emps, [0.0], scenario=gains)._servo
    assert (drives.kp[0], drives.kv[0], drives.velocity_samples) == (100.0, 200.0, 3)
    tuned = Arm(emps, [0.0], scenario=scenario("controller: {bandwidth_hz: 8.0}\n"))._servo
    assert tuned.kp[0] == pytest.approx(np.pi * 8.0 / servo.SHARE_OF_POLE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("controller: {}\n", "expected either bandwidth_hz or gains"),
        ("noise: {joint_1: {std: 0.1, std_below_20_hz: 0.2}}\n", "cannot exceed the whole"),
        ("friction: {joint_1: {viscous: -1.0}}\n", "greater than or equal to 0"),
        ("description: nothing\n", "expected at least one of effects, drives, controller, friction and noise"),
    ],
)
def test_a_contradictory_scenario_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scenario(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("friction: {joint_9: {viscous: 1.0}}\n", "friction: 'joint_9' is not a joint of panda"),
        ("noise: {elbow: {std: 1.0}}\n", "noise: 'elbow' is not a joint of panda"),
        ("controller: {bandwidth_hz: [5.0, 6.0]}\n", "bandwidth_hz: expected one number or 7"),
        ("controller: {gains: {kp: [1.0], kv: [1.0]}}\n", "gains: expected 7 numbers in kp and in kv"),
    ],
)
def test_a_scenario_of_another_arm_is_refused(text: str, message: str, panda: RobotConfig) -> None:
    robot, parameters, _ = complete(panda)
    with pytest.raises(ConfigError, match=message):
        Arm(robot, parameters.rest, 1e-3, scenario=scenario(text), parameters=parameters)


@pytest.mark.parametrize("period_us", [100, 250, 500, 1000, 4000])
def test_drives_keep_time_with_any_sync_period(period_us: int, panda: RobotConfig) -> None:
    period = servo.control_period(panda, period_us * 1e-6)
    assert period <= servo.CONTROL_PERIOD * (1 + 1e-9)
    assert period_us * 1e-6 / period == pytest.approx(round(period_us * 1e-6 / period))


def test_the_reported_signal_moves_the_arm_from_the_reported_position_to_the_next() -> None:
    """An axis without friction: second differences of the position are the signal over the mass."""
    emps = load_robot("emps").model_copy(update={"name": "axis", "controller": None})
    quiet = scenario("friction: {joint_1: {viscous: 0.0, coulomb: 0.0, offset: 0.0}}\n")
    robot, parameters, _ = complete(emps)
    arm = Arm(robot, [0.0], 1e-3, noise=0.0, scenario=quiet, parameters=parameters)
    arm.enable(0, True)
    arm.interpolation_time(0, 5e-3)
    position, signal = [], []
    for k in range(60):
        position.append(float(arm.position[0]))
        signal.append(float(arm.current[0]))
        arm.set_targets(np.array([20_000 if k == 10 else 0], np.int32), np.array([k == 10]))
        arm.advance()
    drive = robot.joints[0].drive
    force = np.array(signal) * drive.rated / 1000 * drive.gain
    mass = parameters.standard["m1"] + parameters.standard["ia1"]
    bends = np.diff(position, 2) / counts_per_si(robot)[0] / 1e-6 * mass
    # Within a period the force changes: 8 % of the largest. Forces at the instants of SYNC are 48 % and 4 % off.
    means = np.convolve(force, [0.5, 0.5])[1 : bends.size + 1]
    np.testing.assert_allclose(means, bends, atol=0.15 * np.abs(bends).max())
    assert abs(np.sum(force) - np.sum(bends)) < 0.01 * np.abs(force).sum()


@pytest.mark.parametrize("name", ["panda", "kuka_lwr4", "tx40", "emps"])
def test_the_motion_keeps_the_limits_and_uses_them(name: str) -> None:
    robot, _, _ = complete(load_robot(name))
    motion = plausible_trajectory(robot, seed=2)
    motion.check(robot)
    q = motion.sample(1e-3)
    limits = [joint.limits for joint in robot.joints]
    used = [
        np.ptp(q, axis=0) / [limit.position[1] - limit.position[0] for limit in limits],
        np.abs(np.diff(q, axis=0)).max(axis=0) / 1e-3 / [limit.velocity for limit in limits],
        np.abs(np.diff(q, 2, axis=0)).max(axis=0) / 1e-6 / [limit.acceleration for limit in limits],
    ]
    assert (np.max(used, axis=0) > 0.5).all()


def test_the_written_configuration_is_that_of_the_arm(tmp_path: Path) -> None:
    twin = load_twin(write_scara(tmp_path))
    session = load_session(write_twin(twin, tmp_path / "twin"))
    robot = load_robot(session.robot)
    assert robot == twin.robot
    np.testing.assert_array_equal(counts_per_si(robot), counts_per_si(twin.robot))
    assert [drive.joint for drive in session.drives] == ["turn", "elbow", "lift", "spin"]
    assert session.setpoints is not None
    load_trajectory(session.setpoints.trajectory).check(robot)
    text = (tmp_path / "twin" / "robot.yaml").read_text()
    assert "# friction.sign_smoothing: turn 150, elbow 150, lift 5000, spin 150" in text
    assert "# limits.acceleration: turn 20, elbow 25, lift 4, spin 60" in text
    again = load_twin(tmp_path / "twin" / "cell.yaml")
    assert again.assumed == ()
    assert again.trajectory is None
    assert again.parameters.standard == pytest.approx(twin.parameters.standard)


def test_a_virtual_bus_has_all_drives_and_nothing_of_the_cell() -> None:
    real = load_session("tx40_six_buses")
    session = on_virtual_bus(real, "vcan7", "cell_test")
    assert [bus.channel for bus in session.all_buses] == ["vcan7"]
    assert session.all_buses[0].bitrate is None
    assert len(session.drives_on(session.all_buses[0])) == 6
    assert (session.cell, session.zenoh.config, session.zenoh.connect) == ("cell_test", None, ())
    assert session.heartbeat_ms >= 1000
    twins = tuple(drive.model_copy(update={"node_id": 1}) for drive in real.drives)
    with pytest.raises(ConfigError, match="drives of several buses share node ids"):
        on_virtual_bus(real.model_copy(update={"drives": twins}), "vcan7", "cell_test")


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    twin = load_twin(write_scara(tmp_path))
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"file/twin: the configuration cannot be written: Not a directory"):
        write_twin(twin, tmp_path / "file" / "twin")


def test_a_slower_cell_sends_everything_at_every_sync() -> None:
    session = at_period(load_session("tx40_cell"), 2000)
    assert session.sync_period == pytest.approx(2e-3)
    assert {stream.every for stream in session.streams.values()} == {1}
    assert session.setpoints is not None
    assert session.setpoints.every == 1


def test_blanks_are_assumed_and_said(tmp_path: Path) -> None:
    config = write_scara(tmp_path)
    config.write_text(
        config.read_text() + "joints:\n- {name: lift, limits: {acceleration: FILL_IN}, "
        "drive: {rated: FILL_IN, counts_per_unit: FILL_IN}}\n"
    )
    twin = load_twin(config)
    text = "\n".join(twin.assumed)
    for key in ("limits.acceleration", "drive.rated", "drive.counts_per_unit"):
        assert next(line for line in twin.assumed if line.startswith(key)).count("lift ") == 1, text
    assert twin.robot.joints[2].drive.rated == pytest.approx(0.25 * 150.0)
    assert load_robot(load_session(write_twin(twin, tmp_path / "twin")).robot) == twin.robot


@pytest.mark.slow
def test_a_robot_file_is_enough_for_a_recording(tmp_path: Path) -> None:
    out, truth = tmp_path / "scara.mcap", tmp_path / "truth.json"
    record_robot(write_scara(tmp_path), out, truth=truth)
    recording = read_recording(out)
    assert recording.robot.n == 4
    assert recording.samples.sync.size == pytest.approx(10_600, abs=10)
    values = json.loads(truth.read_text())
    assert values["m3"] == pytest.approx(1.2)
    assert "zz1r" not in values, "groups of the TX40 are not those of this arm"


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.nightly] * (path.stem not in ("emps", "panda", "tx40")), id=path.stem)
        for path in sorted((HERE / "robots").glob("*.yaml"))
    ],
)
def test_every_shipped_robot_follows_a_motion_within_its_torque_limits(path: Path) -> None:
    twin = load_twin(path)
    robot, motion = twin.robot, plausible_trajectory(twin.robot)
    recording = simulate_recording(robot, motion, 0, 0.0, period=twin.session.sync_period, parameters=twin.parameters)
    inverse, stream = np.linalg.inv(robot.transmission_matrix).T, recording.streams["demand"]
    error = (recording.samples.si("position")[stream.sync] - stream.si("demand")) @ inverse
    assert np.abs(error).max() < 0.1
    gain = np.array([joint.drive.gain for joint in robot.joints])
    torque = recording.samples.si(effort_of(robot)) * gain @ robot.transmission_matrix
    assert (np.abs(torque).max(axis=0) < [joint.limits.torque for joint in robot.joints]).all()


@pytest.mark.slow
def test_the_api_simulates_any_robot(panda: RobotConfig) -> None:
    motion = plausible_trajectory(panda)
    short = motion.model_copy(
        update={"fourier": motion.fourier and motion.fourier.model_copy(update={"frequency": 1.0})}
    )
    recording = armident.simulate_recording("panda", motion, noise=0.0, period=4e-3, arm_seed=3)
    assert recording.robot.joints[0].drive.counts_per_unit is not None
    with pytest.raises(ConfigError, match="reaches velocity"):
        armident.simulate_recording(panda, short)
