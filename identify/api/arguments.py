"""Arguments that several public functions take: recordings and robots, as objects or by path or name."""

from collections.abc import Callable, Sequence
from pathlib import Path

from armident.configs import ConfigError, RobotConfig, load_robot
from armident.daq.recording import Recording, read_recording

Progress = Callable[[str, float], None]
Robot = RobotConfig | str | Path
Recorded = Recording | str | Path


def recordings_of(recordings: Recorded | Sequence[Recorded]) -> tuple[Recording, ...]:
    """Return the recordings; those given by their path are read. ConfigError if none is given or a file is missing."""
    given = [recordings] if isinstance(recordings, Recording | str | Path) else list(recordings)
    if not given:
        raise ConfigError("no recording was given")
    return tuple(one if isinstance(one, Recording) else read_recording(Path(one)) for one in given)


def robot_of(robot: Robot | None, recordings: Sequence[Recording], command: str = "identify") -> RobotConfig:
    """Return the configuration to use, with all values that a command needs."""
    if isinstance(robot, str | Path):
        return load_robot(robot, command)
    config = recordings[0].robot if robot is None else robot
    config.check_filled(command)
    return config
