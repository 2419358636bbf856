"""Correction of exchanged signals: raw values are exchanged, scaling belongs to the drive."""

import numpy as np
import pytest

from armident.configs import ConfigError, Trajectory, load_robot, load_trajectory
from armident.configs.schema.robot import Effect
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.identify.effects.wiring import exchanges, rewired
from armident.identify.identification.from_recording import experiments_from_recording
from armident.virtual_robot.offline import simulate_recording


def short() -> Trajectory:
    once = load_trajectory("trajectories/tx40_excitation.yaml")
    return once.model_copy(update={"moves": once.moves[:2]})


@pytest.mark.slow
@pytest.mark.parametrize(
    "signals", [{"position": 1.0, "torque": 1.0}, {"position": 1.0}, {"torque": 1.0}], ids=" ".join
)
def test_two_unlike_drives_exchanged_are_put_back_as_they_were(signals: dict[str, float]) -> None:
    robot = load_robot("tx40")
    # Joint 2 has another gear, gain, rating and resolution than joint 3.
    hidden = HiddenEffect(
        effect="joint_order", joint="joint_2", other="joint_3", parameters={"position": 0.0, "torque": 0.0} | signals
    )
    scenario = Scenario(schema="armident/scenario/1", effects=(hidden,))
    [right], [wrong] = (
        experiments_from_recording(simulate_recording(robot, short(), 1, scenario=s, period=1e-3), robot)[0]
        for s in (None, scenario)
    )
    assert right.q_ref is not None
    named = Effect(effect="joint_order", joint="joint_2", other="joint_3", parameters=signals)
    [undone] = rewired([wrong], robot.model_copy(update={"effects": (named,)}))
    assert undone.q_ref is not None
    for name, exchanged in (("q", "position"), ("tau", "torque"), ("q_ref", "position")):
        good, bad, back = (getattr(e, name)[:, 1:3] for e in (right, wrong, undone))
        np.testing.assert_allclose(back, good, atol=1e-9 * np.abs(good).max())
        assert (np.abs(bad - good).max() > 0.1 * np.abs(good).max()) == (exchanged in signals)


def test_every_exchange_undoes_itself() -> None:
    robot = load_robot("tx40")
    both = {"position": 1.0, "torque": 1.0}
    entry = Effect(effect="joint_order", joint="joint_3", other="joint_6", parameters=both)
    for matrix in exchanges(robot.model_copy(update={"effects": (entry,)})):
        np.testing.assert_allclose(matrix @ matrix, np.eye(6), atol=1e-12)
        assert (np.count_nonzero(matrix, axis=0) == 1).all()


def test_an_exchange_with_nobody_is_refused() -> None:
    robot = load_robot("tx40")
    alone = Effect(effect="joint_order", joint="joint_3", parameters={"torque": 1.0})
    with pytest.raises(ConfigError, match=r"effects\[0\]: joint_order of joint_3 needs the other joint"):
        exchanges(robot.model_copy(update={"effects": (alone,)}))
