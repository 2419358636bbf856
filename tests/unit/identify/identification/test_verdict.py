"""Verdict of an identification: each defect has one line, impossible results are unusable, healthy ones trustworthy."""

from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from armident.configs import DataError, Trajectory, load_robot
from armident.configs.schema.robot import RobotConfig
from armident.identify.documents.files import from_json, to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.diagnostics import Diagnostics
from armident.identify.estimators.methods import METHODS, Method
from armident.identify.estimators.reason import Reason
from armident.identify.identification.checks.convergence import convergence, loop
from armident.identify.identification.checks.delay import delay
from armident.identify.identification.checks.error import error
from armident.identify.identification.checks.excitation import workspace_postures
from armident.identify.identification.checks.residual import instruments, residual
from armident.identify.identification.equations import Prepared
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.identification.motion_dependence import motion_dependence
from armident.identify.identification.moving_joints import joint_ranges, moving_joints
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.identification.torque_delay import TorqueDelay
from armident.identify.identification.verdict import judge
from armident.identify.regression.equations import Estimate, ExperimentEquations
from armident.identify.setup.result import SetupCheck, SetupFinding
from armident.identify.signals.decimate import design
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.offline import simulate_recording
from tests.fixtures.arms import FAST, identified, recording, trajectory

CRITERIA = IdentificationCriteria()
LEAST_SQUARES = Options(method="idim-ls")


@pytest.fixture(scope="module")
def arm() -> RobotConfig:
    return load_robot("tx40")


@pytest.fixture(scope="module")
def healthy(arm: RobotConfig) -> list[Experiment]:
    return list(experiments_from_recording(recording("tx40", "tx40_excitation", 1, repeats=1, period=FAST), arm)[0])


def changed(experiments: list[Experiment], change: Callable[[Experiment], Experiment]) -> list[Experiment]:
    return [change(e) for e in experiments]


def recorded(robot: RobotConfig, motion: Trajectory) -> list[Experiment]:
    return list(experiments_from_recording(simulate_recording(robot, motion, 1, period=FAST), robot)[0])


def motion(*targets: list[float]) -> Trajectory:
    moves = [{"to": target, "duration": 0.8, "dwell": 0.2} for target in targets]
    return Trajectory.model_validate({"schema": "armident/trajectory/1", "start": [0.0] * 6, "moves": moves})


def judged(method: Method = "idim-piv", **parts: Any) -> Any:
    """Parts of an identification that one check uses."""
    robot, experiments = parts.pop("robot", None), parts.pop("experiments", ())
    prepared = SimpleNamespace(model=SimpleNamespace(robot=robot), signals=(), experiments=experiments)
    return SimpleNamespace(options=Options(method), prepared=prepared, unusable=False, solution=None, **parts)


WRONG_UNIT = SetupFinding(
    "torque_unit",
    ("joint_1",),
    0.999,
    "The torques are in kN m.",
    "joints[].drive.gain: multiply by 1000",
    decisive=True,
)


def set_up(*findings: SetupFinding, not_understood: tuple[str, ...] = ()) -> SetupCheck:
    """A check of the set-up with these findings."""
    return SetupCheck(findings, (), (), not_understood, ("signs", "order"), None)


@pytest.mark.slow
def test_a_healthy_arm_is_trustworthy_by_every_line() -> None:
    for robot, seed in (("tx40", 1), ("emps", 1)):
        outcome = identified(robot, f"{robot}_excitation", seed, period=FAST)
        assert outcome.result.verdict.level == "trustworthy", outcome.result.verdict
        assert outcome.document.verdict == "trustworthy"
        assert outcome.document.reasons == []


def test_the_verdict_is_the_first_key_after_the_schema_and_holds_its_limits() -> None:
    document = identified("emps", "emps_excitation", 1).document
    keys = list(document.model_dump(by_alias=True))
    assert keys[:3] == ["schema", "verdict", "reasons"]
    assert document.criteria == {f.name: getattr(CRITERIA, f.name) for f in fields(CRITERIA)}


def test_documents_without_a_verdict_are_still_read() -> None:
    document = identified("emps", "emps_excitation", 1).document
    former = document.model_dump(by_alias=True, mode="json", exclude={"verdict", "reasons", "criteria"})
    read = IdentificationDocument.model_validate(former)
    assert read.verdict is None
    assert read.parameters == document.parameters
    assert from_json(to_json(document), IdentificationDocument, "x") == document


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["idim-ls", *(pytest.param(m, marks=pytest.mark.nightly) for m in ("idim-iv", "idim-piv"))]
)
def test_all_signs_turned_are_physically_impossible(
    healthy: list[Experiment], arm: RobotConfig, method: Method
) -> None:
    turned = changed(healthy, lambda e: replace(e, tau=-e.tau))
    found = identify_experiment(turned, arm, Options(method=method))
    assert found.verdict.level == "unusable"
    (reason,) = found.verdict.of_kind("physics")
    assert "negative fv1" in reason.message
    assert "mass matrix is not positive definite" in reason.message
    assert "No possible arm explains the torques" in reason.message
    assert "armident check" in reason.next_step


def test_exchanged_torques_leave_more_than_a_third_of_their_joints(healthy: list[Experiment], arm: RobotConfig) -> None:
    exchanged = changed(healthy, lambda e: replace(e, tau=e.tau[:, [0, 1, 2, 4, 3, 5]]))
    found = identify_experiment(exchanged, arm, LEAST_SQUARES)
    assert found.verdict.level == "unusable"
    (reason,) = found.verdict.of_kind("error")
    assert "joint_4" in reason.message
    assert "joint_5" in reason.message
    assert "joint_1" not in reason.message


def test_motor_torques_with_joint_positions_are_unusable(healthy: list[Experiment], arm: RobotConfig) -> None:
    inverse = np.linalg.inv(arm.transmission_matrix)
    found = identify_experiment(changed(healthy, lambda e: replace(e, tau=e.tau @ inverse)), arm, LEAST_SQUARES)
    assert found.verdict.level == "unusable"


def test_a_small_negative_friction_is_doubtful_because_a_possible_arm_explains_the_torques(
    healthy: list[Experiment], arm: RobotConfig
) -> None:
    """Viscous friction of joint 4 is 1.1 N m s/rad; more than that is taken from its torque."""

    def frictionless(e: Experiment) -> Experiment:
        tau = e.tau.copy()
        tau[:, 3] -= 1.25 * np.gradient(e.q[:, 3], e.dt)
        return replace(e, tau=tau)

    found = identify_experiment(changed(healthy, frictionless), arm, LEAST_SQUARES)
    (reason,) = found.verdict.of_kind("physics")
    assert reason.level == "doubtful"
    assert "negative fv4" in reason.message
    assert "--physical" in reason.next_step


def test_an_arm_at_rest_is_refused_in_one_line(arm: RobotConfig) -> None:
    still = recorded(arm, motion([0.0] * 6))
    with pytest.raises(DataError, match=r"^No joint moves \(largest range: .* Next: move every joint") as caught:
        identify_experiment(still, arm)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [pytest.param(m, marks=[pytest.mark.nightly] * (m not in ("idim-ls", "didim"))) for m in METHODS]
)
def test_one_moving_joint_gives_its_few_parameters(arm: RobotConfig, method: Method) -> None:
    single = recorded(arm, motion(*([0.0, angle, 0.0, 0.0, 0.0, 0.0] for angle in (0.8, -0.8, 0.4, 0.0))))
    assert moving_joints(single, arm, CRITERIA).tolist() == [False, True, False, False, False, False]
    try:
        found = identify_experiment(single, arm, Options(method=method))
    except DataError as error:
        text = str(error)
    else:
        assert found.verdict.level == "unusable"
        assert not found.converged or found.relative_error_pct < 100.0
        assert {found.names[k] for k in np.flatnonzero(found.essential)} <= supported_by_joint_2(arm)
        (reason,) = found.verdict.of_kind("excitation")
        text = reason.message
    if "closed loop" not in text:
        assert "of 61 base parameters" in text
        assert "fv2 = 5." in text
        assert "fc2 = " in text


def supported_by_joint_2(robot: RobotConfig) -> set[str]:
    """Parameters with an effect on the torque of joint 2 while it moves alone."""
    model = arm_model(robot)
    q, rest = np.zeros((50, 6)), np.zeros((50, 6))
    q[:, 1] = np.linspace(-0.8, 0.8, 50)
    rate = rest.copy()
    rate[:, 1] = np.linspace(-1.0, 1.0, 50)
    acts = np.abs(model.rigid_regressor(q, rate, rate)[:, 1]).max(axis=0) > 1e-3
    return {name for name, seen in zip(model.base.names, acts, strict=True) if seen}


@pytest.mark.slow
def test_a_motion_of_two_degrees_is_unusable_and_names_what_it_supports(arm: RobotConfig) -> None:
    wide = trajectory("tx40_excitation")
    share = np.deg2rad(2.0) / max(abs(angle) for move in wide.moves for angle in move.to)
    moves = tuple(m.model_copy(update={"to": tuple(share * angle for angle in m.to)}) for m in wide.moves)
    small = wide.model_copy(update={"start": tuple(share * angle for angle in wide.start), "moves": moves})
    found = identify_experiment(recorded(arm, small), arm, LEAST_SQUARES)
    assert found.verdict.level != "trustworthy"
    (reason,) = found.verdict.of_kind("excitation")
    assert "undetermined at joint_1" in reason.message
    assert "base parameters within 33 %" in reason.message


def test_too_few_equations_are_doubtful(healthy: list[Experiment], arm: RobotConfig) -> None:
    found = identify_experiment(healthy, arm, replace(LEAST_SQUARES, decimation=100))
    assert any("equations per joint, fewer than" in reason.message for reason in found.verdict.of_kind("uncertainty"))
    assert not any("equations per joint" in warning for warning in found.warnings)


def test_late_torques_are_doubtful_in_one_line(arm: RobotConfig) -> None:
    late = TorqueDelay(np.array([-5.5, -5.4, 0.4, 0.6, 0.5, 9.0]), np.array([0.2] * 5 + [8.0]), True)
    (reason,) = delay(judged(robot=arm, statistics=SimpleNamespace(delay=late)), CRITERIA)
    assert reason.level == "doubtful"
    assert "(joint_1 -5.50 ± 0.20 and joint_2 -5.40 ± 0.20; expected is 0.5)" in reason.message
    assert delay(judged(robot=arm, statistics=SimpleNamespace(delay=None)), CRITERIA) == []


@pytest.mark.slow
def test_the_parameters_do_not_depend_on_the_verdict(healthy: list[Experiment], arm: RobotConfig) -> None:
    one = identify_experiment(healthy, arm, LEAST_SQUARES)
    other = identify_experiment(healthy, arm, LEAST_SQUARES, setup=set_up(WRONG_UNIT))
    assert other.verdict.level == "unusable"
    np.testing.assert_array_equal(one.theta, other.theta)
    np.testing.assert_array_equal(one.std, other.std)
    np.testing.assert_array_equal(one.essential, other.essential)


def test_a_decisive_finding_of_the_set_up_is_unusable_and_comes_first() -> None:
    verdict = judge([Reason("unusable", "The model leaves 80 %", "check")], set_up(WRONG_UNIT))
    assert verdict.level == "unusable"
    assert verdict.reasons[0].kind == "setup"
    assert verdict.reasons[0].message == "The torques are in kN m (probability 1.00)"
    assert verdict.reasons[0].next_step == "joints[].drive.gain: multiply by 1000"
    assert verdict.reasons[0].joint == "joint_1"


def test_a_refusal_states_the_finding_of_the_set_up_too(healthy: list[Experiment], arm: RobotConfig) -> None:
    turned = changed(healthy, lambda e: replace(e, tau=-e.tau))
    sign = replace(WRONG_UNIT, kind="torque_sign", message="the torque of joint_1 has the wrong sign", remedy="turn it")
    with pytest.raises(DataError, match=r"Set-up: The torque of joint_1 has the wrong sign .* Next: turn it"):
        identify_experiment(turned, arm, Options(method="didim"), setup=set_up(sign))


def test_other_findings_are_doubtful_and_joints_not_understood_unusable() -> None:
    assert judge([], set_up(replace(WRONG_UNIT, decisive=False))).level == "doubtful"
    verdict = judge([], set_up(not_understood=("joint_4", "joint_5")))
    assert verdict.level == "unusable"
    assert "joint_4 and joint_5 (tried: signs, order)" in verdict.reasons[0].message
    assert judge([], set_up()).level == "trustworthy"


def test_set_up_and_result_state_each_defect_once() -> None:
    error = Reason("unusable", "The model leaves more than 33 % of the torque of joint_4 (69 %)", "check", "joint_4")
    (reason,) = judge([error], set_up(not_understood=("joint_4",))).reasons
    assert reason.message == f"{error.message}; no hypothesis of the set-up explains it (tried: signs, order)"
    rest = Reason("doubtful", "joint_4 does not move", "move it", kind="excitation")
    still = replace(WRONG_UNIT, kind="joint_at_rest", decisive=False)
    assert judge([rest], set_up(still)).reasons == (rest,)
    late = Reason("doubtful", "The torque belongs to the position some samples later", "clocks", kind="delay")
    (reason,) = judge([late], set_up(replace(WRONG_UNIT, kind="time_shift"))).reasons
    assert reason.kind == "setup"


def test_each_line_stands_once_and_the_worst_comes_first() -> None:
    doubt, bad = Reason("doubtful", "a", "x"), Reason("unusable", "b", "y")
    verdict = judge([doubt, bad, doubt])
    assert verdict.reasons == (bad, doubt)


def test_iterations_without_end_are_doubtful() -> None:
    estimate = Estimate(np.ones(2), np.eye(2), (), (), 20, False, "stopped after 20 iterations")
    (reason,) = convergence(judged("idim-iv", found=SimpleNamespace(estimate=estimate)), CRITERIA)
    assert reason.level == "doubtful"
    assert "stopped after 20 iterations" in reason.message
    settled = SimpleNamespace(estimate=replace(estimate, converged=True))
    assert convergence(judged("idim-iv", found=settled), CRITERIA) == []


@pytest.mark.parametrize(("method", "level"), [("didim", "unusable"), ("idim-piv", "doubtful")])
def test_a_diverging_loop_is_unusable_where_the_estimate_comes_from_it(method: Method, level: str) -> None:

    def reasons(speed: float | None) -> list[Reason]:
        """Reasons of a loop that moves at a share of the measured velocity, or diverges."""
        measured = Derivatives(np.ones((9, 1)), np.ones((9, 1)), np.zeros((9, 1)), None)
        runs = None if speed is None else [replace(measured, qd=speed * measured.qd)]
        parts = judged(method, found=SimpleNamespace(controller={"kind": "crc"}))
        parts.solution, parts.prepared.signals = SimpleNamespace(runs=runs), [measured]
        return loop(parts, CRITERIA)

    (reason,) = reasons(None)
    assert reason.level == level
    assert "diverges" in reason.message
    (reason,) = reasons(2.07)
    assert "misses the measured velocities by 107 %" in reason.message
    assert reasons(1.04) == []


def diagnostics() -> Diagnostics:
    return identified("tx40", "tx40_excitation", 1, period=FAST).result.diagnostics


def residuals_of(tests: Diagnostics, monkeypatch: pytest.MonkeyPatch, method: Method, *moving: str) -> list[Reason]:
    """Reasons of residuals that do not depend on the motion, with some joints that move."""
    monkeypatch.setattr("armident.identify.identification.checks.residual.motion_dependence", lambda *_: [])
    support = SimpleNamespace(moving=[joint.joint in moving for joint in tests.joints])
    statistics, parts = (
        SimpleNamespace(diagnostics=tests),
        SimpleNamespace(blocks=(), estimate=SimpleNamespace(theta=())),
    )
    return residual(judged(method, support=support, statistics=statistics, found=parts, ls=parts), CRITERIA)


def instruments_of(tests: Diagnostics, parameters: int) -> list[Reason]:
    """Reasons of the instruments of an estimate."""
    found = SimpleNamespace(estimate=SimpleNamespace(theta=np.zeros(parameters)))
    return instruments(judged(statistics=SimpleNamespace(diagnostics=tests), found=found), CRITERIA)


def test_coloured_residuals_have_one_line_for_all_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    tests = diagnostics()
    coloured = replace(tests, joints=tuple(replace(joint, white=False) for joint in tests.joints[:2]))
    (reason,) = residuals_of(coloured, monkeypatch, "idim-piv", "joint_1", "joint_2")
    assert reason.message.startswith("The residuals are not noise: serially correlated at joint_1 and joint_2")
    (reason,) = residuals_of(coloured, monkeypatch, "idim-piv", "joint_2")
    assert reason.joint == "joint_2"


def test_a_ripple_that_a_noise_model_could_absorb_is_named(arm: RobotConfig) -> None:
    """Seven periods per turn of joint 1; the parameters stay possible."""
    (clean,) = experiments_from_recording(recording("tx40", "tx40_excitation", 1, repeats=1, period=FAST), arm)[0]
    tau = clean.tau.copy()
    tau[:, 0] += 3.0 * np.sin(7 * clean.q[:, 0])
    found = identify_experiment(replace(clean, tau=tau), arm, LEAST_SQUARES)
    (reason,) = found.verdict.of_kind("residual")
    assert "position of joint_1" in reason.message
    assert reason.joint == "joint_1"


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["white", "coloured"])
def test_noise_does_not_depend_on_the_motion(healthy: list[Experiment], arm: RobotConfig, noise: str) -> None:
    """Residuals of 20 seeds, replaced by noise: at most one of 240 tests is positive at the limits of the verdict."""
    model = arm_model(arm)
    signals = [differentiate(e.q, e.dt) for e in healthy]
    prepared = Prepared(model, healthy, signals)
    blocks = prepared.equations(design(healthy[0].dt, 20.0))
    theta, positive = np.zeros(model.base.b), 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        drawn = [rng.normal(size=b.y.shape) for b in blocks]
        if noise == "coloured":
            drawn = [lfilter([1.0], [1.0, -0.9], y, axis=0) for y in drawn]
        found = motion_dependence(prepared, [replace(b, y=y) for b, y in zip(blocks, drawn, strict=True)], theta)
        positive += sum(
            d.share > CRITERIA.max_motion_share and d.deviation >= CRITERIA.min_motion_deviation for d in found
        )
    assert positive <= 1


def test_standard_deviations_that_neglect_correlation_are_doubtful(monkeypatch: pytest.MonkeyPatch) -> None:
    tests = replace(diagnostics(), serial_std_ratio=2.0)
    (reason,) = residuals_of(tests, monkeypatch, "idim-ls")
    assert "2.0 times too small" in reason.message
    assert residuals_of(tests, monkeypatch, "idim-piv") == []


def test_weak_instruments_are_named() -> None:
    (reason,) = instruments_of(replace(diagnostics(), weak_instruments=("ia6", "zz6")), 61)
    assert "of ia6 and zz6 are weak" in reason.message
    every = replace(diagnostics(), weak_instruments=("a", "b"))
    assert "of all 2 parameters" in instruments_of(every, 2)[0].message


def errors_of(
    rest: np.ndarray, error_pct: float, ls_error_pct: float, recorded: np.ndarray | None = None
) -> list[Reason]:
    """Reasons of one joint whose residual is ``rest`` (M,), with these relative errors; ``recorded``: its torque."""
    torque, size = rest / error_pct * 100, rest.size
    other = torque * ls_error_pct / 100
    x = np.stack([torque - rest, torque - other], axis=1)[:, None, :]
    block = ExperimentEquations(torque[:, None], x, np.ones((size, 1), bool), rest)
    found, ls = (SimpleNamespace(estimate=SimpleNamespace(theta=theta), blocks=[block]) for theta in np.eye(2))
    moving = SimpleNamespace(moving=np.array([True]))
    one = SimpleNamespace(tau=(torque if recorded is None else recorded)[:, None], q_ref=None)
    return error(judged(robot=load_robot("emps"), found=found, ls=ls, support=moving, experiments=[one]), CRITERIA)


def test_a_torque_that_is_white_noise_is_doubtful_and_a_model_error_unusable() -> None:
    noise = np.random.default_rng(0).normal(size=400)
    assert [r.level for r in errors_of(noise, 50.0, 50.0)] == ["doubtful"]
    assert [r.level for r in errors_of(np.sin(np.arange(400) / 20), 50.0, 50.0)] == ["unusable"]
    assert errors_of(noise, 30.0, 30.0) == []
    (reason,) = errors_of(noise, 90.0, 5.0)
    assert reason.level == "unusable"
    assert "idim-ls leaves 5 % at most" in reason.message


def test_rounding_of_a_small_torque_is_doubtful_and_an_error_of_two_steps_is_not() -> None:
    true = 1.3 * np.sin(np.arange(20_000) / 90)
    recorded = 0.01 * np.rint(true)
    (reason,) = errors_of(recorded - 0.01 * true, 40.0, 40.0, recorded)
    assert (reason.level, reason.joint) == ("doubtful", "joint_1")
    assert "rounding of the recorded torque" in reason.message
    (reason,) = errors_of(0.02 * np.sin(np.arange(20_000) / 90), 40.0, 40.0, recorded)
    assert reason.level == "unusable"


def test_a_joint_is_at_rest_by_its_reference_its_counts_or_the_other_joints(
    healthy: list[Experiment], arm: RobotConfig
) -> None:
    assert moving_joints(healthy, arm, CRITERIA).all()
    held = [replace(e, q_ref=np.zeros_like(e.q)) for e in healthy]
    assert not moving_joints(held, arm, CRITERIA).any()
    tiny = [replace(e, q=e.q * np.array([1, 1, 1, 1, 1, 1e-5]), q_ref=None) for e in healthy]
    assert moving_joints(tiny, arm, CRITERIA).tolist() == [True] * 5 + [False]
    assert (joint_ranges(healthy) > 1.0).all()


def test_an_endless_joint_has_its_recorded_range_as_workspace(arm: RobotConfig) -> None:
    first = arm.joints[0]
    endless = first.model_copy(update={"limits": first.limits.model_copy(update={"position": (-1e16, 1e16)})})
    robot = arm.model_copy(update={"joints": (endless, *arm.joints[1:])})
    seen = np.array([[-1.0] * 6, [1.0] * 6])
    q = workspace_postures(robot, seen)
    assert np.abs(q[:, 0]).max() <= 1.0
    assert np.abs(q[:, 1]).max() > 1.5


def test_no_result_with_an_error_above_its_torque_counts_as_converged(
    healthy: list[Experiment], arm: RobotConfig
) -> None:
    found: IdentificationResult = identify_experiment(healthy, arm, LEAST_SQUARES)
    assert found.converged
    assert found.relative_error_pct < 100.0
