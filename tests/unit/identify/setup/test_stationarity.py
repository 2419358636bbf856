"""Stretches of time in which another load, gravity or gain holds, on random arms; arms that stay the same give none."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.diagnosis.setup_stage import outside
from armident.identify.robot.arm import ArmModel
from armident.identify.setup.bench import Bench, make_bench
from armident.identify.setup.fit import Hypothesis
from armident.identify.setup.result import SetupFinding
from armident.identify.setup.signals import held_findings, rate_findings, small_torque_findings, step_findings
from armident.identify.setup.stationarity import change_finding, spans, stretch
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups

Array = NDArray[np.float64]
SEEDS = range(4)


def recorded(robot: RobotConfig, seed: int, gravity: Array | None = None) -> Experiment:
    given = None if gravity is None else gravity.tolist()
    return setups.record(robot, seed, duration=20.0, gravity=given)[0]


def later(e: Experiment, tau: Array, at: float) -> Experiment:
    """The experiment with other torques (N, n) from ``at`` s on."""
    after = np.arange(e.q.shape[0]) * e.dt >= at
    return replace(e, tau=np.where(after[:, None], tau, e.tau))


def found(e: Experiment, robot: RobotConfig) -> tuple[SetupFinding | None, Bench, float, float]:
    bench = make_bench([e], robot, np.ones(robot.n, dtype=np.bool_))
    h = Hypothesis(np.eye(robot.n), np.eye(robot.n), np.array(robot.gravity), np.zeros(robot.n))
    change = stretch(bench, h)
    assert change is not None
    if not change.certain:
        return None, bench, 0.0, 0.0
    (span,) = spans(change, bench)
    return change_finding(change, bench, h), bench, span.begin, span.end


@pytest.mark.parametrize("seed", SEEDS)
def test_an_arm_that_stays_the_same_gives_none(seed: int) -> None:
    robot = setups.random_arm(seed, 3)
    assert found(recorded(robot, seed), robot)[0] is None


@pytest.mark.parametrize("seed", SEEDS)
def test_a_base_that_moves_is_gravity_of_another_direction(seed: int) -> None:
    robot = setups.random_arm(seed, 3)
    g, angle = np.array(robot.gravity), np.radians(30.0)
    aside = np.cross(g, [0.3, 0.5, 0.8])
    moved = np.cos(angle) * g + np.sin(angle) * np.linalg.norm(g) * aside / np.linalg.norm(aside)
    e, at = recorded(robot, seed), 8.0 + seed
    finding, _, begin, end = found(later(e, recorded(robot, seed, moved).tau, at), robot)
    assert finding is not None
    assert finding.decisive
    assert "gravity turned" in finding.message
    assert begin == pytest.approx(at, abs=0.4)
    assert end == np.inf


@pytest.mark.parametrize("seed", SEEDS)
def test_a_part_that_is_picked_up_is_a_load_at_the_last_joint(seed: int) -> None:
    robot = setups.random_arm(seed, 3)
    model = ArmModel.from_config(robot)
    part = np.zeros(len(model.names))
    names, mass, centre = list(model.names), 4.0, np.array([0.1, 0.15, 0.05])
    part[names.index("m3")] = mass
    for axis, c in zip("xyz", centre, strict=True):
        part[names.index(f"m{axis}3")] = mass * c
    inertia = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    for i, k in zip(*np.triu_indices(3), strict=True):
        part[names.index(f"{'xyz'[i]}{'xyz'[k]}3")] = inertia[i, k]
    e, at = recorded(robot, seed), 12.0 - seed
    qd = np.gradient(e.q, e.dt, axis=0)
    smooth = np.ones(25) / 25
    qdd = np.stack([np.convolve(np.gradient(v, e.dt), smooth, "same") for v in qd.T], axis=1)
    finding, _, begin, _ = found(later(e, e.tau + model.inverse_dynamics(part, e.q, qd, qdd), at), robot)
    assert finding is not None
    assert "another load at axis_3" in finding.message
    assert begin == pytest.approx(at, abs=0.4)


def test_a_gain_that_changes_for_a_while_is_named_with_its_factor_and_left_out() -> None:
    robot = setups.random_arm(2, 3)
    e = recorded(robot, 2)
    changed = later(later(e, e.tau * [1.0, 1.5, 1.0], 6.0), e.tau, 13.0)
    finding, bench, begin, end = found(changed, robot)
    assert finding is not None
    assert re.search(r"torques of axis_2 1\.[45]\d? times", finding.message)
    assert not finding.decisive
    assert begin == pytest.approx(6.0, abs=0.3)
    assert end == pytest.approx(13.0, abs=0.3)
    h = Hypothesis(np.eye(3), np.eye(3), np.array(robot.gravity), np.zeros(3))
    change = stretch(bench, h)
    assert change is not None
    before, after = outside([changed], spans(change, bench), 0)
    assert before.q.shape[0] * e.dt == pytest.approx(begin, abs=0.01)
    assert after.start == pytest.approx(end, abs=0.01)


@pytest.mark.parametrize("seed", range(10))
def test_a_lasting_step_of_one_encoder_is_named_with_size_and_time(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = setups.random_arm(seed, 3)
    e, j, row = recorded(robot, seed), int(rng.integers(3)), int(rng.integers(1000, 9000))
    size = float(rng.choice([-1, 1]) * rng.uniform(0.03, 0.5))
    slipped = e.q.copy()
    slipped[row:, j] += size
    (finding,) = step_findings([replace(e, q=slipped)], robot)
    assert finding.joints == (robot.joints[j].name,)
    assert f"{row * e.dt:.3f} s" in finding.message
    assert finding.decisive
    assert step_findings([e], robot) == []


@pytest.mark.parametrize("rows", [2, 3, 10, 25])
def test_held_torques_are_said_with_their_rate_and_age(rows: int) -> None:
    robot = setups.random_arm(rows, 3)
    e = recorded(robot, 1)
    held = np.round(e.tau[np.arange(e.tau.shape[0]) // rows * rows], 2)
    (finding,) = held_findings([replace(e, tau=held)], robot)
    assert finding.kind == "torque_held"
    assert f"({500 / rows:.4g} Hz" in finding.message
    assert f"{1000 * (rows - 1) / 2 * e.dt:.3g} ms old" in finding.message
    assert held_findings([replace(e, tau=np.round(e.tau, 1), q=np.round(e.q, 3))], robot) == []


@pytest.mark.parametrize("seed", SEEDS)
def test_torques_far_below_their_limits_do_not_carry_an_arm(seed: int) -> None:
    robot = setups.random_arm(seed, 3)
    e = recorded(robot, seed)
    assert small_torque_findings([e], robot) == []
    noise = np.random.default_rng(seed).normal(size=e.tau.shape)
    external = 0.001 * np.array([joint.limits.torque for joint in robot.joints]) * noise
    (finding,) = small_torque_findings([replace(e, tau=external)], robot)
    assert finding.decisive


def test_positions_with_two_decimals_are_named_for_their_steps_and_not_for_their_rate() -> None:
    robot = setups.random_arm(1, 3)
    e = recorded(robot, 1)
    assert rate_findings([e], robot) == []
    coarse = rate_findings([replace(e, q=np.round(e.q, 2))], robot)
    assert {finding.kind for finding in coarse} <= {"position_resolution"}
    assert any("steps of 0.01 rad" in finding.message for finding in coarse)
