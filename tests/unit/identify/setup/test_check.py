"""Mistakes of a set-up on random arms and the virtual robots: each is named and corrected, healthy data give none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig, load_robot
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.setup.bench import make_bench
from armident.identify.setup.check import check_setup
from armident.identify.setup.describe import as_configured
from armident.identify.setup.result import SetupCheck
from armident.identify.setup.search import Search, Step
from armident.identify.setup.signals import clipped_findings, one_way_findings
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups
from tests.fixtures.arms import FAST, checked, recording

AXES = 3
EVERY = ("axis_1", "axis_2", "axis_3")
Made = Callable[[list[Experiment], RobotConfig], list[Experiment]]


@pytest.fixture(scope="module")
def tx40() -> RobotConfig:
    return load_robot("tx40")


@pytest.fixture(scope="module")
def virtual(tx40: RobotConfig) -> list[Experiment]:
    return list(experiments_from_recording(recording("tx40", "tx40_excitation", 3, period=FAST), tx40)[0])


def late(experiments: list[Experiment], seconds: float) -> list[Experiment]:
    made = []
    for e in experiments:
        k = round(seconds / e.dt)
        tau = np.roll(e.tau, k, axis=0)
        made.append(replace(e, q=e.q[abs(k) : -abs(k)], tau=tau[abs(k) : -abs(k)], q_ref=None))
    return made


def motor_torques(experiments: list[Experiment], robot: RobotConfig) -> list[Experiment]:
    return setups.with_torques(experiments, np.linalg.inv(robot.transmission_matrix.T))


BOTH = setups.in_order(2, 0, 1)

SECOND = {
    "all torque signs",
    "position sign",
    "torques exchanged",
    "joints in another order",
    "degrees",
    "positions of two motors",
}
"""Mistakes of a kind of which another is found in `make test`; these are left to `make nightly`."""
MISTAKES: dict[str, tuple[Made, str, tuple[str, ...]]] = {
    "torque sign": (lambda e, r: setups.with_torques(e, setups.turned(AXES, 1)), "torque_sign", ("axis_2",)),
    "position sign": (lambda e, r: setups.with_positions(e, setups.turned(AXES, 2)), "position_sign", ("axis_3",)),
    "joint turned": (
        lambda e, r: setups.with_torques(setups.with_positions(e, setups.turned(AXES, 1)), setups.turned(AXES, 1)),
        "position_sign",
        ("axis_2",),
    ),
    "all torque signs": (
        lambda e, r: setups.with_torques(e, -np.eye(AXES)),
        "torque_sign",
        EVERY,
    ),
    "torques exchanged": (
        lambda e, r: setups.with_torques(e, setups.in_order(0, 2, 1)),
        "joint_order",
        ("axis_2", "axis_3"),
    ),
    "torques in another order": (
        lambda e, r: setups.with_torques(e, BOTH),
        "joint_order",
        EVERY,
    ),
    "joints in another order": (
        lambda e, r: setups.with_torques(setups.with_positions(e, BOTH), BOTH),
        "joint_order",
        EVERY,
    ),
    "degrees": (
        lambda e, r: setups.with_positions(e, np.eye(AXES) * 180 / np.pi),
        "position_unit",
        EVERY,
    ),
    "kgf m": (lambda e, r: setups.with_torques(e, setups.scaled(AXES, 1, 1 / 9.80665)), "torque_unit", ("axis_2",)),
    "torques of the motors": (motor_torques, "side", EVERY),
    "gear ratio": (
        lambda e, r: setups.with_torques(
            setups.with_positions(e, setups.scaled(AXES, 1, 1.5)), setups.scaled(AXES, 1, 1 / 1.5)
        ),
        "gear_ratio",
        ("axis_2",),
    ),
    "positions of two motors": (
        lambda e, r: setups.with_positions(e, np.diag([1.0, r.transmission_matrix[1, 1], r.transmission_matrix[2, 2]])),
        "side",
        ("axis_2", "axis_3"),
    ),
    "all late": (lambda e, r: late(e, 12e-3), "time_shift", EVERY),
    "time in ms": (
        lambda e, r: [replace(one, dt=1e3 * one.dt) for one in e],
        "time_unit",
        EVERY,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(m, marks=[pytest.mark.nightly] * (m in SECOND)) for m in MISTAKES])
def test_a_mistake_is_named_alone_and_corrected(name: str, healthy: list[Experiment], arm: RobotConfig) -> None:
    make, kind, joints = MISTAKES[name]
    wrong = make(healthy, arm)
    found = check_setup(wrong, arm)
    assert [(f.kind, f.joints) for f in found.findings] == [(kind, joints)]
    assert found.findings[0].probability > 0.9
    assert found.findings[0].decisive
    if name == "torques of the motors":
        assert "--motor-side" in found.findings[0].remedy
    assert max(found.corrected_error_pct) < 8.0
    assert found.joints_not_understood == ()
    if name == "time in ms":
        return
    assert found.corrected_robot is not None
    again = check_setup(wrong, found.corrected_robot)
    assert again.findings == ()
    assert max(again.relative_error_pct) < 8.0


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-3, pytest.param(1e3, marks=pytest.mark.nightly)])
def test_a_common_unit_of_the_torques_is_named_and_not_certain(
    factor: float, healthy: list[Experiment], arm: RobotConfig
) -> None:
    """Currents in mA look the same: only the limits tell that the torques are far too small or too large."""
    found = check_setup(setups.with_torques(healthy, factor * np.eye(AXES)), arm)
    (finding,) = found.findings
    assert (finding.kind, finding.joints, finding.decisive) == ("torque_unit", EVERY, True)
    assert 0.6 < finding.probability < 0.99


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "n", "limited"),
    [(1, 3, True), (3, 5, False), *(pytest.param(5, 6, k, marks=pytest.mark.nightly) for k in (True, False))],
)
def test_torques_each_in_a_unit_of_its_own_are_told_with_and_without_limits(seed: int, n: int, limited: bool) -> None:
    robot = setups.random_arm(seed, n)
    factors = np.exp(np.random.default_rng(seed).uniform(-4.0, 4.0, n))
    wrong = setups.with_torques(setups.record(robot, seed), np.diag(1.0 / factors))
    if not limited:
        joints = [
            joint.model_copy(update={"limits": joint.limits.model_copy(update={"torque": 1e6})})
            for joint in robot.joints
        ]
        robot = robot.model_copy(update={"joints": tuple(joints)})
    found = check_setup(wrong, robot)
    assert [(f.kind, f.correction) for f in found.findings] == [("torque_unit", True)]
    assert found.corrected_robot is not None
    told = {e.joint: e.parameters["torque"] for e in found.corrected_robot.effects}
    off = np.log([told.get(joint.name, 1.0) for joint in robot.joints]) - np.log(factors)
    assert np.abs(off - np.median(off)).max() < np.log(1.1)


@pytest.mark.slow
def test_a_common_unit_stands_beside_a_small_common_delay(healthy: list[Experiment], arm: RobotConfig) -> None:
    """Half a sample gains more likelihood than the limits, and is too small for a mistake: it hides no unit."""

    def late(e: Experiment) -> Experiment:
        at = np.arange(len(e.tau)) - 0.5
        return replace(e, tau=np.stack([np.interp(at, at + 0.5, x) for x in e.tau.T], axis=1))

    found = check_setup(setups.with_torques([late(e) for e in healthy], 1e3 * np.eye(AXES)), arm)
    (finding,) = found.findings
    assert (finding.kind, finding.joints, finding.decisive) == ("torque_unit", EVERY, True)


@pytest.mark.slow
@pytest.mark.nightly
def test_two_joints_turned_are_named_together() -> None:
    robot, both = setups.random_arm(3, 4), setups.turned(4, 0, 3)
    wrong = setups.with_torques(setups.with_positions(setups.record(robot, 0), both), both)
    (finding,) = check_setup(wrong, robot).findings
    assert (finding.kind, finding.joints) == ("position_sign", ("axis_1", "axis_4"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "gravity",
    [
        *(pytest.param(g, marks=pytest.mark.nightly) for g in ((-9.81, 0.0, 0.0), (0.0, 0.0, 9.81))),
        (0.9, 0.0, -9.77),
        (5.0, -6.0, 5.9),
    ],
)
def test_gravity_is_found_in_any_direction(gravity: tuple[float, float, float], arm: RobotConfig) -> None:
    found = check_setup(setups.record(arm, 0, gravity=gravity), arm)
    (finding,) = found.findings
    assert finding.kind == "gravity_direction"
    assert finding.probability > 0.8
    assert finding.correction == (found.corrected_robot is not None)
    assert found.likely_robot is not None
    np.testing.assert_allclose(found.likely_robot.gravity, gravity, atol=0.15)


@pytest.mark.slow
def test_torques_without_gravity_are_named(arm: RobotConfig) -> None:
    found = check_setup(setups.record(arm, 0, gravity=(0.0, 0.0, 0.0)), arm)
    (finding,) = found.findings
    assert finding.kind == "gravity_missing"
    # On development arms a wrong geometry looked as much like it.
    assert finding.probability > 0.7
    assert finding.correction == (found.corrected_robot is not None)
    assert found.likely_robot is not None
    assert found.likely_robot.gravity == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_degrees_of_the_revolute_joints_alone_are_named_once() -> None:
    robot = setups.random_arm(4, AXES, lift=1)
    experiments = setups.record(robot, 4)
    assert check_setup(experiments, robot).findings == ()
    degrees = np.diag([180 / np.pi, 1.0, 180 / np.pi])
    (finding,) = check_setup(setups.with_positions(experiments, degrees), robot).findings
    assert (finding.kind, finding.joints) == ("position_unit", ("axis_1", "axis_3"))
    assert "of the revolute joints are in degrees" in finding.message


@pytest.mark.slow
def test_torques_that_hold_the_arm_in_pauses_are_no_error_of_the_model(arm: RobotConfig) -> None:
    healthy = check_setup(setups.record(arm, 0, pauses=True), arm)
    assert healthy.findings == ()
    assert max(healthy.relative_error_pct) < 8.0
    found = check_setup(setups.record(arm, 0, gravity=(0.0, 0.0, 0.0), pauses=True), arm)
    assert [f.kind for f in found.findings] == ["gravity_missing"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.nightly) for k in (0, *range(2, 6)))])
@pytest.mark.parametrize("added", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.2)])
def test_healthy_arms_and_structural_effects_give_no_finding(seed: int, added: tuple[float, float, float]) -> None:
    robot = setups.random_arm(seed, 2 + seed % 4)
    experiments = setups.record(robot, seed, added=np.array(added))
    found = check_setup(experiments, robot)
    assert found.findings == ()
    assert found.joints_not_understood == ()
    assert found.corrected_robot is None


@pytest.mark.slow
def test_the_healthy_virtual_tx40_has_no_finding() -> None:
    assert checked("tx40", 3).findings == ()


@pytest.mark.slow
@pytest.mark.nightly
def test_motor_side_torques_of_a_coupled_wrist_are_found_and_a_diagnosis_goes_on_corrected(
    virtual: list[Experiment], tx40: RobotConfig
) -> None:
    wrong = motor_torques(virtual, tx40)
    found = check_setup(wrong, tx40)
    assert [f.kind for f in found.findings] == ["side"]
    assert found.findings[0].probability > 0.9  # 0.94 to 0.95 with five seeds, at the limit of a correction to copy
    assert found.likely_robot is not None
    assert check_setup(wrong, found.likely_robot).findings == ()


@pytest.mark.slow
@pytest.mark.nightly
def test_an_order_of_six_joints_is_found_as_a_whole(virtual: list[Experiment], tx40: RobotConfig) -> None:
    order = setups.in_order(5, 0, 1, 2, 3, 4)
    found = check_setup(setups.with_torques(setups.with_positions(virtual, order), order), tx40)
    (finding,) = found.findings
    assert finding.kind == "joint_order"
    assert "in the order joint_6, joint_1, joint_2, joint_3, joint_4, joint_5" in finding.message


@pytest.mark.slow
def test_a_single_axis_is_checked_by_friction_and_inertia() -> None:
    robot = load_robot("emps")
    experiments = experiments_from_recording(recording("emps", "emps_excitation", 1), robot)[0]
    assert check_setup(experiments, robot).findings == ()
    found = check_setup(setups.with_torques(experiments, -np.eye(1)), robot)
    assert [f.kind for f in found.findings] == ["torque_sign"]
    assert "equally well explained by: position" in found.findings[0].message


def test_nothing_moves(healthy: list[Experiment], arm: RobotConfig) -> None:
    still = [replace(e, q=np.tile(e.q[:1], (e.q.shape[0], 1))) for e in healthy]
    found = check_setup(still, arm)
    assert [(f.kind, f.decisive) for f in found.findings] == [("standstill", True)]


@pytest.mark.slow
def test_a_joint_at_rest_is_named_and_not_judged(arm: RobotConfig, healthy: list[Experiment]) -> None:
    parts = []
    for e in healthy:
        q = e.q.copy()
        q[:, 2] = q[0, 2]
        parts.append(replace(e, q=q))
    found = check_setup(parts, arm)
    assert ("joint_at_rest", ("axis_3",), False) in [(f.kind, f.joints, f.decisive) for f in found.findings]
    assert "axis_3" not in found.joints_not_understood


def test_a_recording_in_which_joints_rest_does_not_judge_the_others(
    arm: RobotConfig, healthy: list[Experiment]
) -> None:
    q = np.tile(healthy[0].q[:1], (healthy[0].q.shape[0], 1))
    q[:, 1] = healthy[0].q[:, 1]
    # Its torques are of another motion: alone or together they would contradict the configuration.
    single = replace(healthy[0], q=q, q_ref=None, tau=-healthy[0].tau)
    alone, together = check_setup(healthy, arm), check_setup([single, *healthy], arm)
    assert together.relative_error_pct == alone.relative_error_pct
    assert together.findings == alone.findings


def test_a_joint_that_turns_one_way_only_is_named(arm: RobotConfig, healthy: list[Experiment]) -> None:
    moving, rng = np.ones(3, dtype=np.bool_), np.random.default_rng(0)
    assert one_way_findings(healthy, arm, moving) == []
    forward = []
    for e in healthy:
        q = e.q.copy()
        q[:, 1] = np.cumsum(np.abs(np.gradient(e.q[:, 1]))) + 1e-4 * rng.standard_normal(len(q))
        forward.append(replace(e, q=q))
    (finding,) = one_way_findings(forward, arm, moving)
    assert (finding.joints, finding.decisive) == (("axis_2",), False)
    # There and back: the direction of the second recording counts, too.
    assert one_way_findings([forward[0], replace(forward[0], q=-forward[0].q)], arm, moving) == []


@pytest.mark.slow
def test_clipped_torques_are_named(healthy: list[Experiment], arm: RobotConfig) -> None:
    level = 0.6 * np.abs(healthy[0].tau[:, 1]).max()
    clipped = [replace(e, tau=np.clip(e.tau, [-1e9, -level, -1e9], [1e9, level, 1e9])) for e in healthy]
    found = check_setup(clipped, arm)
    assert [(f.kind, f.joints) for f in found.findings] == [("torque_clipped", ("axis_2",))]


@pytest.mark.parametrize("steps", [1, 3, 10])
def test_dry_friction_of_a_few_steps_is_not_clipped(steps: int, healthy: list[Experiment], arm: RobotConfig) -> None:
    coarse = []
    for e in healthy:
        speed = np.gradient(e.q[:, 1])
        tau = e.tau.copy()
        tau[:, 1] = np.rint(steps * np.tanh(8 * speed / np.abs(speed).max()))
        coarse.append(replace(e, tau=tau))
    assert clipped_findings(coarse, arm, np.ones(arm.n, dtype=np.bool_)) == []


def test_a_torque_below_the_steps_of_its_signal_is_not_called_clipped(
    healthy: list[Experiment], arm: RobotConfig
) -> None:
    step = 0.9 * np.abs(healthy[0].tau[:, 1]).max()
    coarse = [replace(e, tau=np.where([False, True, False], step * (e.tau > step), e.tau)) for e in healthy]
    (finding,) = clipped_findings(coarse, arm, np.ones(3, dtype=np.bool_))
    assert (finding.joints, finding.decisive) == (("axis_2",), True)
    assert "of axis_2 is 0 in" in finding.message
    assert "finer steps" in finding.remedy


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.4, pytest.param(0.6, marks=pytest.mark.nightly)])
def test_a_torque_that_saturates_softly_is_not_clipped(
    share: float, healthy: list[Experiment], arm: RobotConfig
) -> None:
    level = share * np.abs(healthy[0].tau[:, 1]).max()
    hard = [replace(e, tau=e.tau.copy()) for e in healthy]
    soft = [replace(e, tau=e.tau.copy()) for e in healthy]
    noise = np.random.default_rng(1)
    for e, f in zip(hard, soft, strict=True):
        e.tau[:, 1] = np.clip(e.tau[:, 1], -level, level) + 0.005 * level * noise.normal(size=e.tau.shape[0])
        f.tau[:, 1] = level * np.tanh(f.tau[:, 1] / level)
    assert [(f.kind, f.joints) for f in check_setup(hard, arm).findings] == [("torque_clipped", ("axis_2",))]
    assert "torque_clipped" not in [f.kind for f in check_setup(soft, arm).findings]


@pytest.mark.slow
def test_a_torque_that_resembles_no_motion_is_not_understood(healthy: list[Experiment], arm: RobotConfig) -> None:
    made = []
    for number, e in enumerate(healthy):
        walk = np.cumsum(np.random.default_rng(number).normal(size=e.tau.shape[0]))
        tau = e.tau.copy()
        tau[:, 1] = walk / np.std(walk) * np.std(tau[:, 1])
        made.append(replace(e, tau=tau))
    found = check_setup(made, arm)
    assert "axis_2" in found.joints_not_understood
    assert len(found.tried) > 10


@pytest.mark.slow
def test_a_rate_too_slow_for_the_motion_is_named(arm: RobotConfig) -> None:
    t = 0.05 * np.arange(400)
    q = 0.5 * np.sin(2 * np.pi * np.outer(t, [3.0, 3.1, 2.9]))
    experiments = [Experiment(q, q.copy(), None, 0.05)]
    assert "rate_too_slow" in [f.kind for f in check_setup(experiments, arm).findings]


def test_different_rates_and_short_recordings_are_refused_in_one_line(
    healthy: list[Experiment], arm: RobotConfig
) -> None:
    with pytest.raises(DataError, match=r"different sampling rates \(experiment 1 500 Hz, experiment 2 250 Hz\)"):
        check_setup([healthy[0], replace(healthy[1], dt=4e-3)], arm)
    short = replace(healthy[0], q=healthy[0].q[:40], tau=healthy[0].tau[:40])
    with pytest.raises(DataError, match="too short"):
        check_setup([short], arm)


@pytest.mark.slow
@pytest.mark.parametrize("joint", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_a_rotor_that_the_configuration_lacks_is_no_mistake_of_the_set_up(
    joint: int, healthy: list[Experiment], arm: RobotConfig
) -> None:
    joints = list(arm.joints)
    joints[joint] = joints[joint].model_copy(update={"rotor_inertia": False})
    assert check_setup(healthy, arm.model_copy(update={"joints": tuple(joints)})).findings == ()


@pytest.mark.parametrize("exchanged", [True, False])
def test_both_torques_of_an_exchange_have_to_be_predicted_no_worse(exchanged: bool, arm: RobotConfig) -> None:
    swap = setups.in_order(0, 2, 1)
    recorded = setups.record(arm, 0)
    search = Search(
        make_bench(setups.with_torques(recorded, swap) if exchanged else recorded, arm, np.ones(3, np.bool_))
    )
    first = Step(as_configured(arm))
    other = Step(replace(first.start, torque=swap))
    assert search._uncontradicted(first, other) is exchanged


@pytest.mark.slow
def test_an_exchange_that_torques_hardly_tell_is_told_by_a_position_past_its_limit() -> None:
    arm, swap = setups.random_arm(0, AXES), setups.in_order(0, 2, 1)
    noisy = setups.record(arm, 0, noise=4.0)
    reached = np.max([np.abs(e.q).max(axis=0) for e in noisy], axis=0)

    def checked_with(positions: list[Experiment], limits: NDArray[np.float64]) -> SetupCheck:
        joints = [
            joint.model_copy(update={"limits": joint.limits.model_copy(update={"position": (-most, most)})})
            for joint, most in zip(arm.joints, 1.05 * limits, strict=True)
        ]
        return check_setup(positions, arm.model_copy(update={"joints": tuple(joints)}))

    exchanged = setups.with_torques(setups.with_positions(noisy, swap), swap)
    (finding,) = checked_with(exchanged, reached).findings
    assert (finding.kind, finding.joints, finding.correction) == ("joint_order", ("axis_2", "axis_3"), True)
    assert "passes its limit" in finding.message
    for recorded, limits in ((exchanged, np.full(AXES, 9.0)), (noisy, reached), (noisy, swap @ reached)):
        assert "joint_order" not in [f.kind for f in checked_with(recorded, limits).findings]
