"""Common shift of all torques: it is estimated and aligned, and the delay of one joint is none."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from armident.configs import RobotConfig, load_robot
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.setup_stage import set_up
from armident.identify.identification.equations import aligned_torque
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.setup.bench import make_bench
from armident.identify.setup.check import check_setup
from armident.identify.setup.fit import Hypothesis
from armident.identify.setup.result import SetupCheck, TorqueShift, with_torque_shift
from armident.identify.setup.torque_shift import long_torque_shift
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups
from tests.fixtures.arms import FAST, recording
from tests.fixtures.arms import checked as healthy_check
from tests.statistics.late_torques import moved

LATE = 0.5


def late(experiments: list[Experiment], samples: NDArray[np.float64]) -> list[Experiment]:
    """Experiments whose torques are late by numbers of samples, (n,)."""
    made = []
    for e in experiments:
        k = np.arange(e.tau.shape[0], dtype=np.float64)
        moved = [CubicSpline(k, x)(k - s) for x, s in zip(e.tau.T, samples, strict=True)]
        made.append(replace(e, tau=np.stack(moved, axis=1)[5:-5], q=e.q[5:-5]))
    return made


@pytest.fixture(scope="module")
def arm() -> RobotConfig:
    return setups.random_arm(3, 4)


@pytest.fixture(scope="module")
def healthy(arm: RobotConfig) -> list[Experiment]:
    return setups.record(arm, 0, noise=0.003, dt=4e-3)


@pytest.fixture(scope="module")
def checked(healthy: list[Experiment], arm: RobotConfig) -> Callable[[float], SetupCheck]:
    """Checks of torques that are all late by a number of samples, each made once."""
    return cache(lambda samples: check_setup(late(healthy, np.full(arm.n, samples)), arm))


def estimate(experiments: Sequence[Experiment], robot: RobotConfig) -> TorqueShift:
    found = check_setup(experiments, robot).torque_shift
    assert found is not None
    return found


@pytest.mark.slow
def test_torques_held_until_the_next_sample_are_not_shifted(checked: Callable[[float], SetupCheck]) -> None:
    found = checked(0.0).torque_shift
    assert found is not None
    assert abs(found.samples) < 3 * found.std
    assert not found.applied
    assert found.remark == ""


@pytest.mark.slow
@pytest.mark.parametrize("samples", [LATE, -LATE])
def test_a_common_shift_of_half_a_sample_is_a_remark_and_no_mistake(
    checked: Callable[[float], SetupCheck], samples: float
) -> None:
    check = checked(samples)
    found = check.torque_shift
    assert check.findings == ()
    assert found is not None
    assert found.applied
    assert found.correction == pytest.approx(samples, abs=4 * found.std)
    assert ("late" if samples > 0 else "early") in found.remark


@pytest.mark.slow
@pytest.mark.parametrize("common", [0.0, LATE])
def test_the_delay_of_one_joint_is_left_to_the_diagnosis(
    healthy: list[Experiment], arm: RobotConfig, common: float
) -> None:
    found = estimate(late(healthy, np.array([0.0, 3.0, 0.0, 0.0]) + common), arm)
    assert found.correction == common


def test_a_shift_that_is_less_certain_than_the_convention_is_that_of_the_convention() -> None:
    joints = {"axis_1": (0.30, 0.26), "axis_2": (0.57, 0.65), "axis_3": (0.51, 0.4)}
    unclear = TorqueShift(0.4, 0.21, 4e-3, joints, 1.0, instrumented=True)
    assert not unclear.applied
    assert replace(unclear, odds=9.0).correction == LATE
    neither = replace(unclear, samples=0.25, std=0.02, odds=9.0)
    assert neither.correction == 0.25


def test_a_shift_is_known_where_it_tells_the_conventions_apart() -> None:
    joints = {"axis_1": (0.2, 0.26), "axis_2": (0.3, 0.12)}
    either = TorqueShift(0.23, 0.18, 4e-3, joints, 0.9, instrumented=True)
    assert either.determined
    assert not either.known
    assert replace(either, odds=25.0).known
    assert replace(either, odds=0.04).known
    assert replace(either, std=0.02).known
    assert not replace(either, odds=25.0, std=0.3).known


@pytest.mark.slow
def test_a_shift_that_was_applied_is_not_found_again(
    healthy: list[Experiment], arm: RobotConfig, checked: Callable[[float], SetupCheck]
) -> None:
    moved, found = late(healthy, np.full(arm.n, LATE)), checked(LATE).torque_shift
    assert found is not None
    again = estimate(with_torque_shift(moved, found), arm)
    assert abs(again.samples) < 0.05
    assert not again.applied


@pytest.mark.slow
def test_the_diagnosis_begins_with_aligned_experiments(healthy: list[Experiment], arm: RobotConfig) -> None:
    stage = set_up(late(healthy, np.full(arm.n, LATE)), (), arm, Criteria())
    assert [e.torque_shift for e in stage.training] == pytest.approx([LATE, LATE], abs=0.1)
    assert stage.findings == ()
    assert any("samples" in line for line in stage.warnings)


@pytest.mark.slow
def test_identify_aligns_its_equations_and_says_so(
    healthy: list[Experiment], arm: RobotConfig, checked: Callable[[float], SetupCheck]
) -> None:
    moved = late(healthy, np.full(arm.n, LATE))
    options = Options(method="idim-ls")
    before, with_shift = (identify_experiment(moved, arm, options, setup=s) for s in (None, checked(LATE)))
    original = identify_experiment(healthy, arm, options)
    assert with_shift.relative_error_pct < before.relative_error_pct
    assert with_shift.relative_error_pct == pytest.approx(original.relative_error_pct, rel=0.1)
    assert any("all torques are" in line for line in with_shift.warnings)
    assert not any("all torques are" in line for line in before.warnings)


@pytest.mark.slow
def test_parameters_do_not_move_where_no_shift_is_significant(
    healthy: list[Experiment], arm: RobotConfig, checked: Callable[[float], SetupCheck]
) -> None:
    options = Options(method="idim-ls")
    one, other = (identify_experiment(healthy, arm, options, setup=s) for s in (None, checked(0.0)))
    np.testing.assert_array_equal(one.theta, other.theta)


@pytest.mark.slow
def test_the_virtual_arm_with_references_is_not_shifted() -> None:
    found = healthy_check("tx40", 3).torque_shift
    assert found is not None
    assert found.instrumented
    assert abs(found.samples) < 3 * found.std
    assert not found.applied


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "decisive"), [(4, True), pytest.param(-4, False, marks=pytest.mark.nightly)])
def test_torques_late_by_milliseconds_are_found_by_the_references(samples: int, decisive: bool) -> None:
    """Prediction gains too little by early torques: noise in the closed loop looks like them."""
    robot = load_robot("tx40")
    experiments = experiments_from_recording(recording("tx40", "tx40_excitation", 3, period=FAST), robot)[0]
    check = check_setup([moved(e, samples) for e in experiments], robot)
    (finding,) = check.findings
    assert (finding.kind, len(finding.joints), finding.decisive) == ("time_shift", robot.n, decisive)
    assert f"{'late' if samples > 0 else 'early'} against the positions (standard deviation" in finding.message
    assert check.corrected_robot is not None
    delays = [effect.parameters["delay"] for effect in check.corrected_robot.effects]
    assert delays == pytest.approx([samples * FAST] * robot.n, abs=1.5e-3)


def test_a_long_shift_is_estimated_from_any_start(healthy: list[Experiment], arm: RobotConfig) -> None:
    shifted = [moved(e, 6) for e in healthy]
    bench = make_bench(shifted, arm, np.ones(arm.n, dtype=np.bool_))
    h = Hypothesis(np.eye(arm.n), np.eye(arm.n), np.array(arm.gravity), np.zeros(arm.n))
    for first in (0.0, 0.01, 0.05):
        found = long_torque_shift(shifted, bench, h, first, 0.06)
        assert found is not None
        assert found.samples == pytest.approx(6.0, abs=max(0.1, 4 * found.std))
    assert long_torque_shift(shifted, bench, h, 0.0, 0.01) is None


def test_a_long_shift_needs_two_joints_that_agree_and_an_early_one_references() -> None:
    joints = {"axis_1": (4.0, 0.5), "axis_2": (4.5, 0.6), "axis_3": (-2.0, 3.0)}
    shift = TorqueShift(4.2, 0.4, 1e-3, joints, 1.0, instrumented=True)
    assert shift.confirmed
    early = replace(shift, samples=-4.2, by_joint={name: (-own, std) for name, (own, std) in joints.items()})
    assert early.confirmed
    assert not replace(early, instrumented=False).confirmed
    assert not replace(shift, by_joint=joints | {"axis_3": (0.0, 0.5)}).confirmed
    assert not replace(shift, by_joint=joints | {"axis_2": (4.5, 3.0)}).confirmed
    assert not replace(shift, std=1.5).confirmed
    assert not replace(shift, samples=0.8, std=0.1).confirmed


def test_a_late_shift_without_references_is_denied_by_no_joint_that_disturbances_make_early() -> None:
    joints = {"axis_1": (6.3, 0.5), "axis_2": (5.6, 0.7), "axis_3": (-0.8, 1.6)}
    late = TorqueShift(6.1, 0.4, 2e-3, joints, 1.0, instrumented=False)
    assert late.confirmed
    assert not replace(late, instrumented=True).confirmed
    assert not replace(late, by_joint=joints | {"axis_3": (-0.8, 0.5)}).confirmed
    assert not replace(late, by_joint=joints | {"axis_3": (12.0, 1.6)}).confirmed
    assert not replace(late, by_joint=joints | {"axis_2": (5.6, 2.4)}).confirmed


@pytest.mark.slow
@pytest.mark.parametrize("samples", [6, pytest.param(0, marks=pytest.mark.nightly)])
def test_torques_late_by_milliseconds_are_found_without_references(samples: int) -> None:
    robot = load_robot("tx40")
    experiments = experiments_from_recording(recording("tx40", "tx40_excitation", 4, period=FAST), robot)[0]
    check = check_setup([replace(moved(e, samples), q_ref=None) for e in experiments], robot)
    assert [finding.kind for finding in check.findings] == ["time_shift"] * (samples > 0)
    if check.corrected_robot is not None:
        delays = [effect.parameters["delay"] for effect in check.corrected_robot.effects]
        # Disturbances in the closed loop make it look shorter.
        assert delays == pytest.approx([samples * FAST] * robot.n, abs=2.5e-3)


def test_aligned_torques_are_interpolated_at_the_instants_of_the_positions() -> None:
    tau = np.arange(20.0)[:, None]
    np.testing.assert_allclose(aligned_torque(tau, 1e-12)[1:], aligned_torque(tau)[1:])
    np.testing.assert_allclose(aligned_torque(tau, 0.5), tau)
    np.testing.assert_allclose(aligned_torque(tau, -0.5)[2:], tau[1:-1])


def test_without_references_one_joint_alone_confirms_no_shift() -> None:
    of_joints = {"axis_1": (0.5, 0.05), "axis_2": (0.4, 3.0)}
    alone = TorqueShift(0.5, 0.05, 4e-3, of_joints, 1e9, instrumented=False)
    assert not alone.applied
    assert replace(alone, instrumented=True).applied
    assert replace(alone, by_joint={"axis_1": (0.5, 0.05), "axis_2": (0.4, 0.2)}).applied


def test_a_shift_longer_than_a_sample_is_left_to_the_findings() -> None:
    shift = TorqueShift(1.2, 0.05, 4e-3, {"axis_1": (1.2, 0.07), "axis_2": (1.2, 0.07)}, 1e9, instrumented=True)
    assert not shift.applied
