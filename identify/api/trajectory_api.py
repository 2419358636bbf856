"""Design of exciting trajectories."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import yaml

from armident.arrays import Array
from armident.configs import RobotConfig, Trajectory
from armident.identify.api.arguments import Progress, Robot, robot_of
from armident.identify.api.identification_api import Identification, identified
from armident.identify.api.result_base import Result
from armident.identify.documents.files import write_atomically
from armident.identify.documents.identification import IdentificationDocument

if TYPE_CHECKING:
    from armident.identify.excitation.design import Design as DesignResult
    from armident.identify.excitation.safety import CheckedTrajectory, SafetyChecks


@dataclass(frozen=True, repr=False)
class Design(Result):
    """A reference trajectory and the precision to expect from a recording of it.

    Parameters
    ----------
    checked
        Trajectory with its predicted precision and its checks.
    """

    checked: "CheckedTrajectory"

    @property
    def robot(self) -> RobotConfig:
        """The robot it is for."""
        return self.checked.robot

    @property
    def result(self) -> "DesignResult":
        """Trajectory, condition number, predicted standard deviations and torques."""
        return self.checked.design

    @property
    def checks(self) -> "SafetyChecks":
        """Properties that were checked, with the results (``checked``), and those that were not (``unchecked``)."""
        return self.checked.checks

    @property
    def trajectory(self) -> Trajectory:
        """The reference trajectory, within the limits of the robot."""
        return self.result.trajectory

    @property
    def condition(self) -> float:
        """Condition number of the filtered, weighted base regressor along the trajectory."""
        return self.result.condition

    @property
    def std(self) -> Array | None:
        """Predicted standard deviations of the base parameters, (b,); ``None`` where the torque noise is unknown."""
        return self.result.std

    def save(self, path: str | Path) -> tuple[Path, ...]:
        """Write the trajectory as a YAML file that ``capture`` and ``robot`` play.

        Parameters
        ----------
        path
            The file to write.

        Returns
        -------
        tuple of Path
            The file.
        """
        content = self.trajectory.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        write_atomically(Path(path), yaml.safe_dump(content, sort_keys=False))
        return (Path(path),)

    def _html(self) -> str:
        from armident.identify.report.trajectory_report import trajectory_report

        return trajectory_report(self.checked)

    def _summary(self) -> str:
        return f"{self.robot.name}: {self.trajectory.duration:.2f} s, condition number {self.condition:.0f}"


def design_trajectory(
    robot: Robot,
    duration: float = 7.5,
    *,
    seed: int = 0,
    evaluations: int = 2000,
    shape: Literal["moves", "fourier"] = "moves",
    harmonics: int | None = None,
    known: Identification | IdentificationDocument | str | Path | None = None,
    masses: str | Path | None = None,
    effect: str | None = None,
    joint: str | None = None,
    against: str | None = None,
    progress: Progress | None = None,
) -> Design:
    """Design an exciting trajectory within the limits of a robot (thesis section 2.3.5).

    It keeps the bodies of ``collision`` in the configuration apart. Torques stay within their limits if ``known``,
    ``masses`` or the URDF of the robot has masses.

    Parameters
    ----------
    robot
        Configuration with joint limits, or the path or shipped name of one.
    duration
        Length, s.
    seed
        Seed of the random search; the same seed gives the same trajectory.
    evaluations
        Number of candidates to try.
    shape
        ``moves`` (point to point, trapezoidal velocities) or ``fourier`` (finite Fourier series).
    harmonics
        Number of harmonics of a Fourier series.
    known
        An earlier identification: torques stay within their limits, and the noise weights the joints.
    masses
        JSON file of standard parameters (SI), as ``armident robot --truth`` writes it; used without ``known``.
    effect
        Name of an effect that the trajectory is to show; by default the base parameters count.
    joint
        Joint at which the effect is to show; by default any.
    against
        Another effect from which it is to be distinguished.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    Design
        The trajectory, its condition number and the predicted standard deviations.

    Raises
    ------
    ConfigError
        If the robot cannot make a single move in that time, an option is wrong, or no trajectory keeps all limits.
    DataError
        If ``known`` is of another robot or model, or is not physical.

    Examples
    --------
    >>> import armident
    >>> design = armident.design_trajectory("emps", duration=5.0, evaluations=50)
    >>> round(design.trajectory.duration, 2)
    5.0
    """
    from armident.identify.excitation.design import design_trajectory as run
    from armident.identify.excitation.design import with_objective
    from armident.identify.excitation.previous_estimate import physical_estimate
    from armident.identify.excitation.safety import checked_trajectory, safety_model

    config = robot_of(robot, (), "trajectory")
    earlier = None if known is None else physical_estimate(identified(known)[0], config, "known")
    safety = safety_model(
        config,
        None if isinstance(robot, RobotConfig) else robot,
        earlier,
        "known",
        None if masses is None else Path(masses),
    )
    found = run(
        config,
        duration,
        seed,
        noise=None if earlier is None else earlier.noise,
        evaluations=evaluations,
        theta=safety.theta,
        aim=with_objective(config, effect, joint, against, safety.theta),
        shape=shape,
        harmonics=harmonics,
        collision=safety.collision,
        progress=None if progress is None else lambda share: progress("search", share),
    )
    return Design(checked_trajectory(config, found, safety, earlier))
