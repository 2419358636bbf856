"""Fourier trajectories: at rest at both ends, within the limits, as precise as moves; the plot of the command."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armident.configs import ConfigError, RobotConfig, Trajectory, load_robot, load_trajectory
from armident.configs.schema.trajectory import Fourier
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.design import design_trajectory, predict_precision
from armident.identify.excitation.trajectory_command import trajectory_command
from armident.identify.excitation.trajectory_options import TrajectoryOptions

pytestmark = pytest.mark.slow

NOISE = np.sqrt([1.537, 1.793, 0.9120, 0.2199, 0.6207, 0.2523])
"""Standard deviation of the torque noise of the TX40 after the decimate filter, N m (thesis table 6.3)."""

EVALUATIONS = 120


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return load_robot("tx40")


@pytest.fixture(scope="module")
def designed(robot: RobotConfig) -> Trajectory:
    return design_trajectory(robot, 7.5, seed=1, noise=NOISE, evaluations=EVALUATIONS, shape="fourier").trajectory


def test_a_sum_of_sines_is_what_the_file_says() -> None:
    fourier = Fourier(frequency=0.5, sine=((2.0,), (-1.0,)), cosine=((4.0,), (-1.0,)), periods=2)
    trajectory = Trajectory(schema="armident/trajectory/1", start=(0.3,), fourier=fourier)
    t = np.arange(401) * 0.01
    w = np.pi
    expected = 0.3 + 2 * np.sin(w * t) - np.sin(2 * w * t) + 4 * (np.cos(w * t) - 1) - (np.cos(2 * w * t) - 1)
    assert trajectory.duration == 4.0
    assert np.allclose(trajectory.sample(0.01)[:, 0], expected, atol=1e-12)


def test_a_sum_that_begins_in_motion_is_refused() -> None:
    with pytest.raises(ValueError, match="sum of l sine_l is not zero"):
        Fourier(frequency=0.5, sine=((1.0,), (1.0,)), cosine=((0.0,), (0.0,)))
    with pytest.raises(ValueError, match=r"sum of l\^2 cosine_l is not zero"):
        Fourier(frequency=0.5, sine=((2.0,), (-1.0,)), cosine=((1.0,), (0.0,)))


def test_a_file_has_moves_or_sums_and_not_both(tmp_path: Path, designed: Trajectory) -> None:
    path = tmp_path / "none.yaml"
    path.write_text("schema: armident/trajectory/1\nstart: [0.0]\n")
    with pytest.raises(ConfigError, match="expected either moves or fourier"):
        load_trajectory(path)


def test_a_designed_sum_is_at_rest_at_both_ends_and_keeps_the_limits(robot: RobotConfig, designed: Trajectory) -> None:
    designed.check(robot)
    step = 1e-4
    q = designed.sample(step)
    qd = np.gradient(q, step, axis=0, edge_order=2)
    assert np.allclose(q[0], q[-1], atol=1e-5)
    # An encoder of the TX40 does not see such speeds: 1e-3 rad/s at 5 kHz are 0.2 counts of the joint.
    assert np.abs(qd[[0, -1]]).max() < 1e-3
    peak = np.abs(qd).max(axis=0) / [joint.limits.velocity for joint in robot.joints]
    assert (peak < 0.91).all(), "the tenth that is kept free for the control loop"


def test_fourier_series_are_as_precise_as_moves(robot: RobotConfig, designed: Trajectory) -> None:
    """Geometric mean of the standard deviations for as many candidates; condition number as in the thesis."""
    model = arm_model(robot)
    moves = design_trajectory(robot, 7.5, seed=1, noise=NOISE, evaluations=EVALUATIONS)
    sums = predict_precision(model, designed, NOISE)
    assert moves.std is not None
    assert sums.std is not None
    assert np.exp(np.log(sums.std / moves.std).mean()) < 1.15
    assert sums.condition < 220.0


def test_the_command_writes_a_plot_and_prints_the_precision(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sums.yaml"
    trajectory_command(TrajectoryOptions(Path("emps.yaml"), out, duration=6.0, evaluations=30, shape="fourier"))
    printed = capsys.readouterr().out
    picture = tmp_path / "sums.png"
    assert f"picture: {picture}" in printed
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert "assumed to be 2 % of each joint's torque limit" in printed
    for name in arm_model(load_robot("emps.yaml")).base.names:
        assert name in printed
    loaded = load_trajectory(out)
    assert loaded.fourier is not None
    assert loaded.moves == ()
    trajectory_command(TrajectoryOptions(Path("emps.yaml"), look_at=out, picture=tmp_path / "again.svg"))
    assert "<svg" in (tmp_path / "again.svg").read_text()[:500]


def test_a_trajectory_outside_the_limits_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "far.yaml"
    path.write_text("schema: armident/trajectory/1\nstart: [0.0]\nmoves:\n- {to: [9.0], duration: 1.0}\n")
    with pytest.raises(ConfigError, match=r"far\.yaml: .* moves over \[0\.000, 9\.000\]"):
        trajectory_command(TrajectoryOptions(Path("emps.yaml"), look_at=path, picture=tmp_path / "far.png"))
    assert not (tmp_path / "far.png").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"harmonics": 5}, "only for Fourier series"),
        ({"picture": Path("a.gif")}, r"--picture a\.gif: expected a name that ends in"),
        ({"look_at": Path("b.yaml")}, "give --out FILE for a new trajectory, or --look-at FILE"),
    ],
)
def test_options_that_contradict_each_other_are_refused(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        trajectory_command(TrajectoryOptions(Path("emps.yaml"), tmp_path / "x.yaml", evaluations=1, **options))
