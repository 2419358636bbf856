"""Configuration files of robots, sessions, trajectories and scenarios, and the schema that checks them."""

from armident.configs.errors import ArmidentError, ConfigError, DataError, MotionStopped
from armident.configs.loading import config_path, load_robot, load_scenario, load_session, load_trajectory
from armident.configs.schema.robot import Coupling, Drive, Joint, Limits, Mdh, RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.session import SessionConfig
from armident.configs.schema.trajectory import Trajectory

__all__ = [
    "ArmidentError",
    "ConfigError",
    "Coupling",
    "DataError",
    "Drive",
    "Joint",
    "Limits",
    "Mdh",
    "MotionStopped",
    "RobotConfig",
    "Scenario",
    "SessionConfig",
    "Trajectory",
    "config_path",
    "load_robot",
    "load_scenario",
    "load_session",
    "load_trajectory",
]
