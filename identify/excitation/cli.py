"""Command ``armident trajectory``: design or check an exciting trajectory, plot it, predict its precision."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from armident.configs import ConfigError, RobotConfig, load_robot, load_trajectory
from armident.identify.cli_tables import design_table, progress, wanted_table
from armident.identify.document import IdentificationDocument, load_document, write_atomically
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.design import (
    ASSUMED_NOISE,
    Design,
    Shape,
    design_trajectory,
    predict_precision,
    with_objective,
)
from armident.identify.excitation.objective import EffectObjective
from armident.identify.excitation.plot import check_name, draw
from armident.identify.excitation.previous_estimate import PreviousEstimate, previous_estimate

SHAPES: tuple[Shape, ...] = ("moves", "fourier")
"""Values of ``--shape``."""


@dataclass(frozen=True)
class TrajectoryOptions:
    """Options of ``armident trajectory``.

    Parameters
    ----------
    config
        Robot configuration.
    out
        Trajectory file to write; ``None`` with ``look_at``.
    duration
        Length, s.
    seed
        Seed of the random search.
    known
        ``identification.json`` of the robot: parameters and noise.
    evaluations
        Number of candidates to try.
    wanted, joint, against
        Effect to make visible, its joint, and an effect to separate it from.
    shape, harmonics
        ``moves`` or ``fourier``, and the number of harmonics of the latter.
    picture
        File of the plot; ``None``: named after ``out`` or ``look_at``.
    look_at
        Existing trajectory to check instead of a design.
    """

    config: Path
    out: Path | None = None
    duration: float = 7.5
    seed: int = 0
    known: Path | None = None
    evaluations: int = 2000
    wanted: str | None = None
    joint: str | None = None
    against: str | None = None
    shape: str = "moves"
    harmonics: int | None = None
    picture: Path | None = None
    look_at: Path | None = None


def trajectory_command(options: TrajectoryOptions) -> None:
    """Carry out ``armident trajectory``.

    Parameters
    ----------
    options
        As given by the user.

    Raises
    ------
    ConfigError
        If an option is wrong, or a trajectory to check exceeds the limits (of torque, too, if parameters are known).
    DataError
        If ``known`` is of another robot or model.
    """
    robot, out, look_at = load_robot(options.config, "trajectory"), options.out, options.look_at
    shape = _checked_shape(options)
    picture = options.picture
    if picture is None:
        picture = out.with_suffix(".png") if out is not None else Path(f"{Path(look_at or '').stem}.png")
    check_name(picture)
    prior = None
    if options.known is not None:
        document = load_document(options.known, IdentificationDocument)
        prior = previous_estimate(document, robot, str(options.known))
    theta = None if prior is None else prior.theta
    aim = with_objective(robot, options.wanted, options.joint, options.against, theta)
    if look_at is not None:
        design = _looked_at(robot, look_at, prior, aim)
    else:
        with progress("trajectory") as report:
            design = design_trajectory(
                robot,
                options.duration,
                options.seed,
                noise=None if prior is None else prior.noise,
                evaluations=options.evaluations,
                theta=theta,
                aim=aim,
                shape=shape,
                harmonics=options.harmonics,
                progress=lambda share: report("searching", share),
            )
    if out is not None:
        content = design.trajectory.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        write_atomically(out, yaml.safe_dump(content, sort_keys=False))
    _print_precision(robot, design, prior)
    name = str(out or look_at)
    summary = f"{name}: {design.trajectory.duration:.2f} s, condition number {design.condition:.0f}"
    draw(robot, design, picture, f"{robot.name}, {summary}")
    print(summary)
    print(f"picture: {picture}")
    if look_at is not None:
        _refuse_torque(robot, design, name)


def _checked_shape(options: TrajectoryOptions) -> Shape:
    """Return the shape; ConfigError if an option is wrong or two contradict each other."""
    shape = next((each for each in SHAPES if each == options.shape), None)
    if shape is None:
        raise ConfigError(f"--shape {options.shape}: expected {' or '.join(SHAPES)}")
    if options.out is not None and options.out.suffix not in {".yaml", ".yml"}:
        raise ConfigError(f"--out {options.out}: expected a file name that ends in .yaml")
    if (options.out is None) == (options.look_at is None):
        raise ConfigError("give --out FILE for a new trajectory, or --look-at FILE for an existing one")
    return shape


def _looked_at(robot: RobotConfig, path: Path, prior: PreviousEstimate | None, aim: EffectObjective | None) -> Design:
    trajectory = load_trajectory(path)
    trajectory.check(robot, str(path))
    noise = _assumed(robot) if prior is None else prior.noise
    theta = None if prior is None else prior.theta
    return predict_precision(arm_model(robot), trajectory, noise, theta=theta, aim=aim)


def _print_precision(robot: RobotConfig, design: Design, prior: PreviousEstimate | None) -> None:
    """Print the predicted standard deviations."""
    std = design.std
    if prior is None or std is None:
        model = arm_model(robot)
        std = predict_precision(model, design.trajectory, _assumed(robot)).std
        assert std is not None
        print(f"noise unknown (no --known): assumed to be {100 * ASSUMED_NOISE:g} % of each joint's torque limit")
        design_table(robot, None, std)
    else:
        design_table(robot, prior.theta, std)
    if design.wanted is not None:
        wanted_table(design.wanted)


def _assumed(robot: RobotConfig) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return ASSUMED_NOISE * np.array([joint.limits.torque for joint in robot.joints])


def _refuse_torque(robot: RobotConfig, design: Design, name: str) -> None:
    """Raise ConfigError where a trajectory needs more torque than allowed; the plot is written before."""
    if design.torque is None:
        return
    for joint, peak in zip(robot.joints, np.abs(design.torque).max(axis=0), strict=True):
        if peak > joint.limits.torque:
            raise ConfigError(
                f"{name}: {joint.name} needs a torque of {peak:.1f}, allowed is {joint.limits.torque:.1f}"
            )
