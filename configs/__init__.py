"""What a site edits, and the one schema that loads and checks it."""

from armident.configs.errors import ArmidentError, ConfigError, DataError
from armident.configs.loading import config_path, load_robot, load_session, load_suite, load_trajectory
from armident.configs.robot import Coupling, Drive, Joint, Limits, Mdh, RobotConfig
from armident.configs.session import SessionConfig
from armident.configs.suite import SuiteConfig
from armident.configs.trajectory import Trajectory

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
