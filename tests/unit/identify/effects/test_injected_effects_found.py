"""Every effect injected into a virtual arm is the best candidate at its joint."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from armident.configs import RobotConfig, load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.daq.recording import Recording
from armident.identify.diagnosis.candidate_comparison import SelectionStep
from armident.identify.diagnosis.selection import StepwiseSelection
from armident.identify.diagnosis.study import build_study
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import FAST, recording

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@dataclass(frozen=True)
class Case:
    """An effect at a place; ``truth`` holds linear parameters that the arm and the catalogue define alike.

    ``leave_out`` is what the configuration does not know of an arm that is as it always was.
    """

    robot: str
    effect: str
    joint: str
    parameters: dict[str, float] = field(default_factory=dict)
    truth: dict[str, float] = field(default_factory=dict)
    other: str | None = None
    leave_out: str = ""

    def __str__(self) -> str:
        return f"{self.robot}-{self.effect}-{self.joint}"


TX40 = (
    Case("tx40", "asymmetric_viscous_friction", "joint_2", {"fva": 0.55}, {"fva": 0.55}),
    Case("tx40", "asymmetric_coulomb_friction", "joint_2", {"fca": 4.944}),
    Case("tx40", "nonlinear_viscous_friction", "joint_1", {"thinning": 0.2}),
    Case("tx40", "load_dependent_friction", "joint_3", {"fcl": 0.2}, {"fcl": 0.2}),
    Case("tx40", "presliding_friction", "joint_1", {"deflection": 0.03}),
    Case("tx40", "position_dependent_friction", "joint_4", {"ratio": 0.2}, {"fpc": 0.514, "fps": 0.0}),
    Case("tx40", "friction_drift", "joint_1", {"change": 0.25}),
    Case("tx40", "coupling_friction", "joint_1", {"coulomb": 0.7, "viscous": 0.2}, {"fcc": 0.7, "fvc": 0.2}, "joint_2"),
    Case("tx40", "cogging_torque", "joint_5", {"amplitude": 0.45, "phase": 0.5}, {"cgc": 0.2157, "cgs": 0.3949}),
    Case("tx40", "joint_spring", "joint_2", {"stiffness": 4.0}, {"ks": 4.0}),
    Case("tx40", "joint_elasticity", "joint_1", {"stiffness": 3400.0}),
    Case("tx40", "backlash", "joint_1", {"gap": 0.0125}),
    Case("tx40", "rotor_inertia", "joint_4", truth={"iax": 0.03}, leave_out="rotor_inertia"),
    Case("tx40", "coupling_friction", "joint_5", other="joint_6", leave_out="couplings"),
    Case("tx40", "gravity_direction", "joint_1", {"tilt": 0.06}, {"tilt_x": 0.0, "tilt_y": 0.06}),
    Case("tx40", "drive_gain_error", "joint_3", {"error": 0.2}, {"gain_error": -0.2 / 1.2}),
    Case("tx40", "drive_gain_saturation", "joint_2", {"drop": 0.05}),
    Case("tx40", "time_delay", "joint_2", {"delay": 0.004}, {"delay": 0.004}),
    Case("tx40", "actuator_bandwidth", "joint_1", {"time_constant": 0.005}, {"lag": 0.005}),
    Case("tx40", "stribeck_friction", "joint_5", {"extra": 1.2, "velocity": 0.36}),
)
EMPS = (
    Case("emps", "asymmetric_viscous_friction", "joint_1", {"fva": 10.175}),
    Case("emps", "load_dependent_friction", "joint_1", {"fcl": 0.03}, {"fcl": 0.03}),
    Case("emps", "presliding_friction", "joint_1", {"deflection": 0.001}),
    Case("emps", "position_dependent_friction", "joint_1", {"ratio": 0.05}),
    Case("emps", "friction_drift", "joint_1", {"change": 0.1}),
    Case("emps", "cogging_torque", "joint_1", {"amplitude": 1.0}),
    Case("emps", "encoder_eccentricity", "joint_1", {"amplitude": 5e-5, "motor": 1.0}),
    Case("emps", "backlash", "joint_1", {"gap": 3e-4}),
    Case("emps", "joint_spring", "joint_1", {"stiffness": 20.0}, {"ks": 20.0}),
    Case("emps", "time_delay", "joint_1", {"delay": 0.003}, {"delay": 0.003}),
)
SAMPLE = [*EMPS, *(c for c in TX40 if c.leave_out == "couplings")]
"""All effects of the EMPS, whose diagnoses are short, and the coupling, which needs two joints."""


def recorded(robot: str, seed: int, *effects: HiddenEffect, repeats: int = 1) -> Recording:
    """The excitation at 1 kHz."""
    return recording(robot, f"{robot}_excitation", seed, *effects, repeats=repeats, period=FAST, setpoint_every=1)


def known_of(case: Case) -> RobotConfig:
    """The configuration of the arm, without what the case leaves out."""
    robot = load_robot(case.robot)
    if case.leave_out == "couplings":
        return robot.model_copy(update={"couplings": ()})
    if case.leave_out == "rotor_inertia":
        joints = [
            joint.model_copy(update={"rotor_inertia": False}) if joint.name == case.joint else joint
            for joint in robot.joints
        ]
        return robot.model_copy(update={"joints": tuple(joints), "initial_parameters": {}})
    return robot


def first_step(data: Recording, whole: RobotConfig, known: RobotConfig) -> tuple[StepwiseSelection, SelectionStep]:
    """Comparison of all candidates beside a model that lacks at most one effect."""
    experiments, _ = experiments_from_recording(data, whole)
    with threadpool_limits(1):
        selection = StepwiseSelection(build_study(experiments, [], known))
        return selection, selection.step(selection.start())


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=() if c in SAMPLE else pytest.mark.nightly, id=str(c)) for c in (*TX40, *EMPS)],
)
def test_an_injected_effect_is_admitted_first(case: Case) -> None:
    hidden = HiddenEffect(effect=case.effect, joint=case.joint, other=case.other, parameters=case.parameters)
    known = known_of(case)
    repeats = 1 if case in SAMPLE else 3
    data = recorded(case.robot, 1, *([] if case.leave_out else [hidden]), repeats=repeats)
    selection, step = first_step(data, load_robot(case.robot), known)
    first = selection.admitted(step)
    assert first is not None, [(a.family, a.gain, a.allowed) for a in step.ranked[:3]]
    names = [joint.name for joint in known.joints]
    place = first.candidate.place
    other = None if place.other is None else names[place.other]
    assert (first.candidate.effect.name, names[place.joint], other) == (case.effect, case.joint, case.other)
    if of_recording(first.entry):
        # Corrections of the recording have their values in the entry, without standard deviations. Nothing here tells
        # the common shift of all torques, so that a delay or a lag is known to the sample only.
        for name, truth in case.truth.items():
            assert first.entry.parameters[name] == pytest.approx(truth, rel=0.1, abs=FAST)
        return
    term = first.state.term_of(first.entry)
    values, deviations = first.state.values_of(term)
    found = {p.name: k for k, p in enumerate(term.linear)}
    for name, truth in case.truth.items():
        value, std = values[found[name]], deviations[found[name]]
        assert abs(value - truth) < 4 * std, (name, value, std, truth)


@pytest.mark.nightly
@pytest.mark.parametrize("robot", ["tx40", "emps"])
def test_nothing_is_admitted_beside_the_model_of_a_healthy_arm(robot: str) -> None:
    config = load_robot(robot)
    selection, step = first_step(recorded(robot, 7, repeats=3 if robot == "tx40" else 1), config, config)
    assert selection.admitted(step) is None
    assert np.isfinite([a.log_likelihood for a in step.ranked]).all()
