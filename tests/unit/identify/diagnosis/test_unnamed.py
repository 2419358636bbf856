"""Free shapes: each unnamed law and each table is accepted by the configuration, and its values are recovered."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig, load_robot
from armident.configs.loading import parse
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.diagnose import run_diagnosis
from armident.identify.diagnosis.findings import gap_of
from armident.identify.diagnosis.model_state import with_report_part
from armident.identify.effects.effect import Effect, Place
from armident.identify.effects.free_shapes import FreeShape
from armident.identify.effects.registry import catalogue
from armident.identify.effects.terms import arm_model, entry_of
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.report.robot_file import robot_yaml
from armident.identify.robot.motion import Motion
from armident.identify.signals.experiments import Experiment
from tests.fixtures.arms import FAST, recording
from tests.fixtures.diagnoses import SPRING, selection

pytestmark = pytest.mark.slow

ROBOT = load_robot("kuka_lwr4").model_copy(update={"effects": ()})
JOINT, OTHER = 1, 2
DT, SECONDS, NOISE = 5e-3, 20.0, 0.05
LINK = {"m": 2.0, "mx": 0.05, "my": 0.1, "mz": 0.2, "xx": 0.06, "yy": 0.05, "zz": 0.03, "fv": 1.0, "fc": 0.5}
FREE = sorted(key for key, effect in catalogue().items() if isinstance(effect, FreeShape))

Floats = NDArray[np.float64]


def kinematics(t: Floats) -> tuple[Floats, Floats, Floats]:
    """Positions, velocities and accelerations of three sines per joint, (N, n)."""
    rng = np.random.default_rng(1)
    w = 2 * np.pi * rng.uniform(0.1, 0.8, (3, ROBOT.n))
    amplitude = rng.uniform(0.2, 0.6, (3, ROBOT.n))
    angle = t[:, None, None] * w + rng.uniform(0, 2 * np.pi, (3, ROBOT.n))
    return (
        np.sum(amplitude * np.sin(angle), axis=1),
        np.sum(amplitude * w * np.cos(angle), axis=1),
        np.sum(-amplitude * w**2 * np.sin(angle), axis=1),
    )


def standard() -> Floats:
    """Standard parameters of the arm."""
    return np.array([LINK.get(name.rstrip("0123456789"), 0.0) for name in arm_model(ROBOT).names])


def moved(robot: RobotConfig) -> Motion:
    """The motion between the samples, at which a held torque is the mean of its interval."""
    t = np.asarray(np.arange(round(SECONDS / DT)) * DT) + DT / 2
    model = arm_model(robot)
    padding = np.zeros(len(model.names) - standard().size)
    return model.anchored(np.concatenate([standard(), padding])).motion(*kinematics(t), DT)


def configured(effect: Effect) -> RobotConfig:
    """The arm with an effect in its configuration."""
    place = Place(JOINT, None if effect.scope == "joint" else OTHER)
    motion = moved(ROBOT)
    shapes = dict(effect.grid(motion, place)[0])
    return ROBOT.model_copy(update={"effects": (entry_of(effect, place, ROBOT, shapes),)})


@pytest.mark.parametrize("key", FREE)
def test_an_entry_of_a_free_shape_is_an_entry_of_the_configuration(key: str) -> None:
    robot = configured(catalogue()[key])
    assert parse(robot_yaml(robot), RobotConfig, "model.yaml") == robot
    (term,) = arm_model(robot).terms
    assert len(term.names) == len(catalogue()[key].linear)


@pytest.mark.parametrize("key", FREE)
def test_identify_recovers_the_torque_of_a_free_shape(key: str) -> None:
    robot = configured(catalogue()[key])
    motion = moved(robot)
    columns = motion.model.term_regressor(motion)
    values: Floats = np.asarray(np.random.default_rng(5).uniform(-2.0, 2.0, columns.shape[2]), dtype=np.float64)
    k = columns.shape[2]
    added = np.asarray(columns @ values)
    t = np.asarray(np.arange(round(SECONDS / DT)) * DT)
    noise = np.random.default_rng(6)
    tau = arm_model(ROBOT).inverse_dynamics(standard(), *kinematics(t + DT / 2)) + added
    tau += NOISE * noise.standard_normal(tau.shape)
    experiment = Experiment(kinematics(t)[0] + 1e-6 * noise.standard_normal(tau.shape), tau, None, DT)
    found = identify_experiment([experiment], robot, Options(method="idim-ls"))
    assert len(found.names) - len(arm_model(ROBOT).base.names) == k
    # The torque of the shape beside what the rigid parameters absorb of it: that is what a free shape determines.
    estimate = columns[:, JOINT] @ found.theta[-k:]
    joint = added[:, JOINT]
    rigid = np.column_stack([np.ones_like(joint), motion.qd[:, JOINT], motion.sign[:, JOINT], motion.qdd[:, JOINT]])
    difference = estimate - joint
    difference -= rigid @ np.linalg.lstsq(rigid, difference, rcond=None)[0]
    own = np.asarray(found.covariance)[-k:, -k:]
    # A spring is nearly gravity of the same joint: the covariance contains how little tells them apart.
    spread = np.sqrt(np.einsum("mi,ij,mj->m", columns[:, JOINT], own, columns[:, JOINT]))
    assert np.linalg.norm(difference) < 0.1 * np.linalg.norm(joint - joint.mean()) + 2.0 * np.linalg.norm(spread)


def test_diagnose_accepts_a_model_with_a_table_and_names_nothing_that_it_contains() -> None:
    robot = load_robot("emps")
    data = recording("emps", "emps_1", 1, SPRING, period=FAST)
    experiments, _ = experiments_from_recording(data, robot)
    key = next(k for k in FREE if k.startswith("joint_spring"))
    q = experiments[0].q[:, 0]
    names = [s.name for s in catalogue()[key].shapes]
    shapes = dict(zip(names, (float(q.min()), float(q.max())), strict=True))
    entry = Entry(effect="joint_spring", law=catalogue()[key].law, joint="joint_1", parameters=shapes)
    known = robot.model_copy(update={"effects": (*robot.effects, entry)})
    document = run_diagnosis(experiments, [], known).document
    assert "joint_spring" not in {f.effect for f in document.findings}
    _, without = selection(1, SPRING)
    assert document.gap.validation.before.all < 0.5 * gap_of(with_report_part(without), held=True).all
