"""``armident trajectory``: design an exciting trajectory, or look at one; its picture, and what it will tell."""

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
from armident.identify.excitation.previous_estimate import PreviousEstimate, prior_from

SHAPES: tuple[Shape, ...] = ("moves", "fourier")


def trajectory_command(
    config: Path,
    out: Path | None,
    duration: float = 7.5,
    seed: int = 0,
    known: Path | None = None,
    evaluations: int = 2000,
    wanted: str | None = None,
    joint: str | None = None,
    against: str | None = None,
    shape: str = "moves",
    harmonics: int | None = None,
    picture: Path | None = None,
    look_at: Path | None = None,
) -> None:
    """Carry out ``armident trajectory``; parameters are its options.

    Raises
    ------
    ConfigError
        If an option is wrong, or a trajectory that is to be looked at leaves the limits; torques too, if known.
    DataError
        If ``known`` is of another robot or model.
    """
    robot = load_robot(config)
    chosen = next((each for each in SHAPES if each == shape), None)
    if chosen is None:
        raise ConfigError(f"--shape {shape}: expected {' or '.join(SHAPES)}")
    if out is not None and out.suffix not in {".yaml", ".yml"}:
        raise ConfigError(f"--out {out}: expected a file name that ends in .yaml")
    if (out is None) == (look_at is None):
        raise ConfigError("give --out FILE for a new trajectory, or --look-at FILE for one that there is")
    if picture is None:
        picture = out.with_suffix(".png") if out is not None else Path(f"{Path(look_at or '').stem}.png")
    check_name(picture)
    prior = None if known is None else prior_from(load_document(known, IdentificationDocument), robot, str(known))
    theta = None if prior is None else prior.theta
    aim = with_objective(robot, wanted, joint, against, theta)
    if look_at is not None:
        design = _looked_at(robot, look_at, prior, aim)
    else:
        with progress("trajectory") as report:
            design = design_trajectory(
                robot,
                duration,
                seed,
                noise=None if prior is None else prior.noise,
                evaluations=evaluations,
                theta=theta,
                aim=aim,
                shape=chosen,
                harmonics=harmonics,
                progress=lambda share: report("searching", share),
            )
    assert design is not None
    if out is not None:
        content = design.trajectory.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        write_atomically(out, yaml.safe_dump(content, sort_keys=False))
    _tell(robot, design, prior)
    name = str(out or look_at)
    words = f"{name}: {design.trajectory.duration:.2f} s, condition number {design.condition:.0f}"
    draw(robot, design, picture, f"{robot.name}, {words}")
    print(words)
    print(f"picture: {picture}")
    if look_at is not None:
        _refuse_torque(robot, design, name)


def _looked_at(robot: RobotConfig, path: Path, prior: PreviousEstimate | None, aim: EffectObjective | None) -> Design:
    trajectory = load_trajectory(path)
    trajectory.check(robot, str(path))
    noise = _assumed(robot) if prior is None else prior.noise
    theta = None if prior is None else prior.theta
    return predict_precision(arm_model(robot), trajectory, noise, theta=theta, aim=aim)


def _tell(robot: RobotConfig, design: Design, prior: PreviousEstimate | None) -> None:
    """Print the standard deviations to expect."""
    std = design.std
    if prior is None or std is None:
        model = arm_model(robot)
        std = predict_precision(model, design.trajectory, _assumed(robot)).std
        assert std is not None
        print(f"noise unknown (no --known): supposed to be {100 * ASSUMED_NOISE:g} % of each joint's torque limit")
        design_table(robot, None, std)
    else:
        design_table(robot, prior.theta, std)
    if design.wanted is not None:
        wanted_table(design.wanted)


def _assumed(robot: RobotConfig) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return ASSUMED_NOISE * np.array([joint.limits.torque for joint in robot.joints])


def _refuse_torque(robot: RobotConfig, design: Design, name: str) -> None:
    """Raise ConfigError where a trajectory needs more torque than there is; it has been drawn before."""
    if design.torque is None:
        return
    for joint, peak in zip(robot.joints, np.abs(design.torque).max(axis=0), strict=True):
        if peak > joint.limits.torque:
            raise ConfigError(
                f"{name}: {joint.name} needs a torque of {peak:.1f}, allowed is {joint.limits.torque:.1f}"
            )
