"""Characterisation of the virtual EMPS: what is there has its true size, and what is not there is not seen."""

import numpy as np
import pytest

import armident
from armident.configs import ConfigError, Trajectory, load_robot, load_trajectory
from armident.identify.characterisation.motions import MOTIONS, motion_of
from armident.identify.excitation.collision import CollisionModel
from tests.statistics.characterisation import DISPLACEMENT, EFFECTS, FC, FV, ORDER, RIPPLE, recordings, seen


@pytest.fixture(scope="module")
def found() -> armident.Characterisation:
    return armident.characterise(recordings(1, EFFECTS), "joint_1")


def test_friction_has_the_true_curve_in_both_directions(found: armident.Characterisation) -> None:
    table = found.friction.to_pandas()
    assert len(table) >= 15
    assert table["friction_std"].max() < 0.02 * FC
    true = FC + FV * table.index.to_numpy() + 8.0 * np.exp(-((table.index.to_numpy() / 0.01) ** 2))
    away = (table["friction"] - true) / table["friction_std"]
    assert away.abs().dropna().quantile(0.8) < 2.0
    assert found.document.friction is not None
    curve = found.document.friction.curve
    assert set(curve) == {"fc", "fv", "fva", "offset", "fst", "velocity"}
    assert curve["fc"].value == pytest.approx(FC, rel=0.03)
    assert curve["fv"].value == pytest.approx(FV, rel=0.02)
    assert curve["velocity"].value == pytest.approx(0.01, rel=0.25)


def test_ripple_has_its_order_and_amplitude(found: armident.Characterisation) -> None:
    strongest = found.ripple[0]
    assert strongest["order"] == pytest.approx(ORDER, rel=0.005)
    assert strongest["low"] < RIPPLE < strongest["high"]
    assert strongest["high"] - strongest["low"] < 0.1 * RIPPLE


def test_presliding_has_its_stiffness(found: armident.Characterisation) -> None:
    assert found.document.presliding is not None
    stiffness = found.document.presliding.stiffness
    assert stiffness is not None
    assert stiffness.value == pytest.approx(FC / DISPLACEMENT, rel=0.05)
    assert stiffness.high / stiffness.low < 1.1


def test_a_joint_without_effects_shows_none() -> None:
    assert seen(armident.characterise(recordings(2, ()), "joint_1")) == dict.fromkeys(
        ("stribeck", "ripple", "presliding"), False
    )


def test_what_a_recording_does_not_show_is_said_with_the_next_step() -> None:
    still = armident.characterise(
        armident.simulate_recording("tx40", "tx40_excitation", seed=1, period=0.005), "joint_2"
    )
    assert still.document.friction is None
    assert still.document.presliding is None
    for name in ("friction", "ripple", "stiffness"):
        assert "record its motion" in still.document.statements[name]
    with pytest.raises(ConfigError, match="has no such joint"):
        armident.characterise(recordings(2, ())[:1], "joint_2")


def test_the_first_motion_of_an_arm_is_slow_and_the_next_one_half_as_fast_again() -> None:
    robot = load_robot("emps")
    limit = robot.joints[0].limits.velocity
    first = _speed(motion_of(MOTIONS[0], robot, 0, (), CollisionModel(robot, []))[1])
    assert first <= 0.1 * limit * 1.001
    slow = armident.simulate_recording("emps", "emps_1", seed=1)
    second = _speed(motion_of(MOTIONS[1], robot, 0, (slow,), CollisionModel(robot, []))[1])
    assert second <= 1.5 * _speed(load_trajectory("trajectories/emps_1.yaml")) * 1.01


def _speed(trajectory: Trajectory) -> float:
    return float(np.abs(np.diff(trajectory.sample(0.001), axis=0)).max() / 0.001)
