"""What a site edits, and the one schema that loads and checks it."""

from configs.errors import ArmidentError, ConfigError, DataError
from configs.loading import config_path, load_robot, load_session, load_suite, load_trajectory
from configs.robot import Coupling, Drive, Joint, Limits, Mdh, RobotConfig
from configs.session import SessionConfig
from configs.suite import SuiteConfig
from configs.trajectory import Trajectory

__all__ = [
    "ArmidentError",
    "ConfigError",
    "Coupling",
    "DataError",
    "Drive",
    "Joint",
    "Limits",
    "Mdh",
    "RobotConfig",
    "SessionConfig",
    "SuiteConfig",
    "Trajectory",
    "config_path",
    "load_robot",
    "load_session",
    "load_suite",
    "load_trajectory",
]
