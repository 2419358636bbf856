"""Trajectories designed for one effect estimate it more precisely than those for the base parameters."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from armident.configs import ConfigError, config_path, load_robot, load_trajectory
from armident.identify.cli import trajectory as trajectory_command
from armident.identify.effects.effect import Place
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.design import design_trajectory, predict_precision, with_objective
from armident.identify.excitation.point_to_point import SEARCH_RATE, sample_trajectory

pytestmark = pytest.mark.slow

NOISE = np.sqrt([1.537, 1.793, 0.9120, 0.2199, 0.6207, 0.2523])
"""Standard deviation of the torque noise of the TX40, N m (thesis table 6.3)."""
EVALUATIONS, SEARCHES = 800, 4
"""Trajectories that a search tries, and searches: the ratio of one short search varies from 0.7 to 1.1."""


@pytest.mark.parametrize(
    ("effect", "against", "parameter", "better"),
    [
        ("cogging_torque", None, "cgc1", 0.8),
        ("joint_spring", None, "ks1", 0.6),
        ("joint_spring", "position_dependent_friction", "ks1", 0.8),
    ],
)
def test_a_design_for_an_effect_estimates_it_more_precisely(
    effect: str, against: str | None, parameter: str, better: float
) -> None:
    robot = load_robot("emps")
    aim = with_objective(robot, effect, None, against)
    usual = design_trajectory(robot, 6.0, seed=0, noise=[1.0], evaluations=200)
    assert usual.wanted is None
    before = predict_precision(arm_model(robot), usual.trajectory, [1.0], aim=aim).wanted
    design = design_trajectory(robot, 6.0, seed=0, noise=[1.0], evaluations=200, aim=aim)
    design.trajectory.check(robot)
    assert before is not None
    assert design.wanted is not None
    assert design.wanted[parameter] < better * before[parameter]


@pytest.mark.nightly
@pytest.mark.parametrize("against", [None, "presliding_friction"])
def test_designs_for_stribeck_friction_estimate_its_parameters_more_precisely(against: str | None) -> None:
    """Geometric mean over all linear parameters, which a design minimises, and over several random searches."""
    robot = load_robot("emps")
    aim = with_objective(robot, "stribeck_friction", None, against)
    ratios = []
    for seed in range(SEARCHES):
        usual = design_trajectory(robot, 6.0, seed=seed, noise=[1.0], evaluations=EVALUATIONS)
        before = predict_precision(arm_model(robot), usual.trajectory, [1.0], aim=aim).wanted
        design = design_trajectory(robot, 6.0, seed=seed, noise=[1.0], evaluations=EVALUATIONS, aim=aim)
        design.trajectory.check(robot)
        assert before is not None
        assert design.wanted is not None
        ratios.append([design.wanted[name] / value for name, value in before.items()])
    assert np.exp(np.mean(np.log(ratios))) < 0.8


def test_a_six_axis_design_shows_the_ripple_of_one_motor() -> None:
    robot = load_robot("tx40")
    aim = with_objective(robot, "cogging_torque", "joint_2", None)
    design = design_trajectory(robot, 7.5, seed=0, noise=NOISE, evaluations=25, aim=aim)
    design.trajectory.check(robot)
    shipped = load_trajectory("trajectories/tx40_excitation.yaml")
    before = predict_precision(arm_model(robot), shipped, NOISE, aim=aim).wanted
    assert before is not None
    assert design.wanted is not None
    assert set(design.wanted) == {"cgc2", "cgs2"}
    assert max(design.wanted[name] / before[name] for name in before) < 0.8


def test_the_predicted_deviation_is_the_one_that_estimates_have() -> None:
    """Monte Carlo on the predicted columns: least squares with white noise of the given standard deviation."""
    robot = load_robot("emps")
    model = arm_model(robot)
    aim = with_objective(robot, "joint_spring", None, None)
    design = design_trajectory(robot, 6.0, seed=0, noise=[2.0], evaluations=20, aim=aim)
    assert design.wanted is not None
    q = design.trajectory.sample(1e-3)
    qd = np.gradient(q, 1e-3, axis=0)
    x = np.concatenate([model.rigid_regressor(q, qd, np.gradient(qd, 1e-3, axis=0)), q[:, :, None]], axis=2)[::25, 0]
    rng = np.random.default_rng(0)
    estimates = [np.linalg.lstsq(x, 2.0 * rng.standard_normal(len(x)), rcond=None)[0][-1] for _ in range(800)]
    assert np.std(estimates) == pytest.approx(design.wanted["ks1"], rel=0.15)


@pytest.mark.parametrize(
    ("robot", "wanted", "joint", "against", "message"),
    [
        ("tx40", "wear", None, None, "'wear' is not in the catalogue"),
        ("tx40", "joint_spring", "elbow", None, "--joint elbow: tx40 has joint_1, joint_2"),
        ("tx40", "load_dependent_friction", None, None, "depends on the torques of the arm: add --known"),
        ("tx40", "joint_spring", None, "load_dependent_friction", "load_dependent_friction depends on the torques"),
        ("tx40", "joint_spring", None, "joint_spring", "--against joint_spring: expected another effect"),
        ("tx40", "sign_error", None, None, "--for sign_error: visible in any motion"),
        ("emps", "coupling_friction", None, None, "--for coupling_friction: emps has no location for it"),
        ("tx40", None, "joint_1", None, "--joint joint_1: needs --for"),
        ("tx40", None, None, "joint_spring", "--against joint_spring: needs --for"),
    ],
)
def test_an_impossible_objective_is_refused_with_the_reason(
    robot: str, wanted: str | None, joint: str | None, against: str | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        with_objective(load_robot(robot), wanted, joint, against)


def test_effects_that_depend_on_torques_need_known_parameters() -> None:
    robot = load_robot("emps")
    aim = with_objective(robot, "time_delay", None, None, [95.0, 200.0, 20.0, -3.0])
    assert aim is not None
    design = design_trajectory(
        robot, 6.0, seed=0, noise=[1.0], evaluations=20, aim=aim, theta=[95.0, 200.0, 20.0, -3.0]
    )
    assert design.wanted is not None
    assert np.isfinite(design.wanted["delay1"])


def test_typical_values_are_positions_in_the_grid_of_each_nonlinear_parameter() -> None:
    robot = load_robot("emps")
    aim = with_objective(robot, "stribeck_friction", None, None)
    assert aim is not None
    ((location, _),) = aim.pairs
    usual = design_trajectory(robot, seed=0, evaluations=0).trajectory
    period = 1.0 / SEARCH_RATE
    motion = arm_model(robot).motion(*sample_trajectory(usual, period), period)
    velocities, displacements = location.effect.trial_values(motion, Place(0))
    assert len(displacements) == 5
    assert len(velocities) == 7
    positions = ((2, 1), (3, 2), (4, 3))
    assert [dict(one) for one in location.shapes] == [
        {"velocity": velocities[k], "displacement": displacements[d]} for k, d in positions
    ]


def test_the_command_designs_for_an_effect(tmp_path: Path) -> None:
    out = tmp_path / "spring.yaml"
    trajectory_command(config_path("emps.yaml"), out, duration=6.0, evaluations=20, wanted="joint_spring")
    assert len(yaml.safe_load(out.read_text())["moves"]) > 1
