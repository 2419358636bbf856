"""Command ``armident trajectory``: design or check an exciting trajectory, plot it, predict its precision."""

from pathlib import Path

import yaml

from armident.configs import ConfigError, RobotConfig, load_robot, load_trajectory
from armident.identify.cli.progress import progress
from armident.identify.cli.terminal import design_table, wanted_table
from armident.identify.documents.files import load_document, write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.design import (
    ASSUMED_NOISE,
    Design,
    design_trajectory,
    predict_precision,
    with_objective,
)
from armident.identify.excitation.objective import EffectObjective
from armident.identify.excitation.plot import check_name, draw
from armident.identify.excitation.previous_estimate import PreviousEstimate, physical_estimate
from armident.identify.excitation.safety import (
    CheckedTrajectory,
    SafetyModel,
    assumed_noise,
    checked_trajectory,
    safety_model,
)
from armident.identify.excitation.trajectory_options import TrajectoryOptions


def trajectory_command(options: TrajectoryOptions) -> CheckedTrajectory:
    """Carry out ``armident trajectory`` but for its report; a trajectory to check may exceed torques and distances."""
    robot, out, look_at = load_robot(options.config, "trajectory"), options.out, options.look_at
    _check_files(options)
    picture = options.picture
    if picture is None:
        picture = out.with_suffix(".png") if out is not None else Path(f"{Path(look_at or '').stem}.png")
    check_name(picture)
    prior = None
    if options.known is not None and options.masses is not None:
        raise ConfigError("--known has identified masses: leave --masses out")
    if options.known is not None:
        document = load_document(options.known, IdentificationDocument)
        prior = physical_estimate(document, robot, str(options.known))
    safety = safety_model(robot, options.config, prior, str(options.known), options.masses)
    aim = with_objective(robot, options.wanted, options.joint, options.against, safety.theta)
    if look_at is not None:
        design = _looked_at(robot, look_at, prior, aim, safety)
    else:
        design = _designed(robot, options, prior, aim, safety)
    if out is not None:
        content = design.trajectory.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        write_atomically(out, yaml.safe_dump(content, sort_keys=False))
    path = out or look_at
    found = checked_trajectory(robot, design, safety, prior, path)
    _print_precision(found)
    summary = f"{path}: {design.trajectory.duration:.2f} s, condition number {design.condition:.0f}"
    draw(robot, design, picture, f"{robot.name}, {summary}")
    print(summary)
    print(f"picture: {picture}")
    for line in found.checks.checked:
        print(f"checked: {line}")
    for line in found.checks.unchecked:
        print(f"not checked: {line}")
    return found


def _designed(
    robot: RobotConfig,
    options: TrajectoryOptions,
    prior: PreviousEstimate | None,
    aim: EffectObjective | None,
    safety: SafetyModel,
) -> Design:
    """Search a trajectory and show the progress."""
    with progress("trajectory") as report:
        return design_trajectory(
            robot,
            options.duration,
            options.seed,
            noise=None if prior is None else prior.noise,
            evaluations=options.evaluations,
            theta=safety.theta,
            aim=aim,
            shape=options.shape,
            harmonics=options.harmonics,
            collision=safety.collision,
            progress=lambda share: report("searching", share),
        )


def _check_files(options: TrajectoryOptions) -> None:
    if options.out is not None and options.out.suffix not in {".yaml", ".yml"}:
        raise ConfigError(f"--out {options.out}: expected a file name that ends in .yaml")
    if (options.out is None) == (options.look_at is None):
        raise ConfigError("give --out FILE for a new trajectory, or --look-at FILE for an existing one")


def _looked_at(
    robot: RobotConfig, path: Path, prior: PreviousEstimate | None, aim: EffectObjective | None, safety: SafetyModel
) -> Design:
    trajectory = load_trajectory(path)
    trajectory.check(robot, str(path))
    noise = assumed_noise(robot) if prior is None else prior.noise
    model, bodies = arm_model(robot), safety.collision
    return predict_precision(model, trajectory, noise, theta=safety.theta, aim=aim, collision=bodies)


def _print_precision(found: CheckedTrajectory) -> None:
    """Print the predicted standard deviations."""
    if found.prior is None:
        print(f"noise unknown (no --known): assumed to be {100 * ASSUMED_NOISE:g} % of each joint's torque limit")
    design_table(found.robot, None if found.prior is None else found.prior.theta, found.std)
    if found.design.wanted is not None:
        wanted_table(found.design.wanted)
