"""Zeros of encoders that are not the model's, on random arms; arms with the right zeros give none."""

import re
from dataclasses import replace

import numpy as np
import pytest

from armident.configs import RobotConfig
from armident.identify.effects.recording_corrections import corrected_experiments
from armident.identify.setup.bench import make_bench
from armident.identify.setup.check import check_setup
from armident.identify.setup.fit import Hypothesis
from armident.identify.setup.zero_offset import ZeroOffset, zero_offset
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups

SEEDS = range(6)


def configured(robot: RobotConfig) -> Hypothesis:
    return Hypothesis(np.eye(robot.n), np.eye(robot.n), np.array(robot.gravity), np.zeros(robot.n))


def found(e: Experiment, robot: RobotConfig) -> ZeroOffset | None:
    bench = make_bench([e], robot, np.ones(robot.n, dtype=np.bool_))
    return zero_offset(bench, configured(robot))


@pytest.mark.parametrize("seed", SEEDS)
def test_right_zeros_and_a_first_joint_with_another_zero_give_none(seed: int) -> None:
    robot = setups.random_arm(seed, 4)
    e = setups.record(robot, seed, duration=10.0)[0]
    assert found(e, robot) is None
    if not np.any(robot.gravity[:2]):
        assert found(replace(e, q=e.q + np.array([0.2, 0.0, 0.0, 0.0])), robot) is None


@pytest.mark.parametrize("seed", SEEDS)
def test_another_zero_is_found_and_its_entry_corrects_it(seed: int) -> None:
    robot = setups.random_arm(seed, 4)
    e = setups.record(robot, seed, duration=10.0)[0]
    size = np.radians(-10.0 if seed % 2 else 6.0)
    wrong = replace(e, q=e.q - np.array([0.0, size, 0.0, 0.0]))
    offset = found(wrong, robot)
    assert offset is not None
    assert (offset.joint, offset.rivals) == (1, ())
    assert offset.offset == pytest.approx(size, abs=max(4 * offset.std, 0.01))
    entries = robot.model_copy(update={"effects": (offset.entry(robot),)})
    (right,) = corrected_experiments([wrong], entries)
    assert right.q == pytest.approx(e.q, abs=max(4 * offset.std, 0.01))
    assert found(right, robot) is None


@pytest.mark.slow
def test_the_check_names_it_with_the_line_that_corrects_it() -> None:
    robot = setups.random_arm(1, 4)
    e = setups.record(robot, 1, duration=10.0)[0]
    wrong = replace(e, q=e.q - np.array([0.0, 0.1, 0.0, 0.0]))
    check = check_setup([wrong], robot)
    (finding,) = check.findings
    assert (finding.kind, finding.joints, finding.decisive) == ("position_offset", ("axis_2",), False)
    assert re.fullmatch(
        r"effects: \[{effect: position_offset, joint: axis_2, parameters: {offset: 0.09\d*}}]", finding.remedy
    )
    assert check.corrected_robot is not None
    assert check_setup([wrong], check.corrected_robot).findings == ()
    assert sum(check.corrected_error_pct) < sum(check.relative_error_pct)
