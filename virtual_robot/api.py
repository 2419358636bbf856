"""The virtual arm without a bus, as ``import armident`` offers it."""

from pathlib import Path

from armident.configs import RobotConfig, Scenario, Trajectory, load_robot, load_scenario, load_trajectory
from armident.configs.loading import load_inertials
from armident.daq.recording import Recording
from armident.extras import named_extra


def simulate_recording(
    robot: RobotConfig | str | Path,
    trajectory: Trajectory | str | Path,
    *,
    scenario: Scenario | str | Path | None = None,
    seed: int = 0,
    noise: float = 1.0,
    period: float | None = None,
    velocity_feedback: bool | None = None,
    model: str | Path | None = None,
    arm_seed: int = 0,
) -> Recording:
    """Simulate the recording that a capture of the virtual arm would make along a trajectory.

    The arm's physics come from Pinocchio, which the identification does not use.

    Parameters
    ----------
    robot
        Configuration of a robot, or the path or shipped name of one. What it leaves open is assumed: the robot of the
        recording is complete.
    trajectory
        Reference positions, or the path or shipped name of a trajectory file.
    scenario
        Effects injected into the arm, or the path or shipped name of a scenario file; by default none.
    seed
        Seed of the noise.
    noise
        Amplitude of the noise relative to that of the real robot; 0 for none.
    period
        Sampling period, s; by default the control period of the drives.
    velocity_feedback
        True if the velocity loop of the drives is fed with the velocity, False for the derivative of the position
        error; by default as the robot's configuration says.
    model
        ``identification.json`` with physically consistent parameters for the arm. By default masses are those of the
        URDF that a robot's file names, else those shipped for the TX40 and the EMPS, else drawn.
    arm_seed
        Seed of masses and friction that are drawn.

    Returns
    -------
    Recording
        As `armident.read_recording` returns it.

    Raises
    ------
    ConfigError
        If the trajectory leaves the limits of the robot, or ``model`` is of another robot.

    Examples
    --------
    >>> import armident
    >>> recording = armident.simulate_recording("tx40", "tx40_excitation")
    >>> recording.sample_rate_hz
    5000.0
    """
    with named_extra("armident.simulate_recording", __name__):
        from armident.virtual_robot.offline import simulate_recording as simulate
        from armident.virtual_robot.twin import complete

    config = robot if isinstance(robot, RobotConfig) else load_robot(robot, "robot")
    config.check_filled("robot")
    inertials = None if isinstance(robot, RobotConfig) else load_inertials(robot)
    document = None if model is None else Path(model)
    config, parameters, _ = complete(config, model=document, inertials=inertials, seed=arm_seed)
    reference = trajectory if isinstance(trajectory, Trajectory) else load_trajectory(trajectory)
    hidden = scenario if isinstance(scenario, Scenario) or scenario is None else load_scenario(scenario)
    return simulate(
        config, reference, seed, noise, hidden, period, velocity_feedback=velocity_feedback, parameters=parameters
    )
