"""Conversion between the raw numbers of drives and SI units."""

import numpy as np
from numpy.typing import NDArray

from armident.configs.errors import ConfigError
from armident.configs.schema.robot import RobotConfig


def counts_per_si(robot: RobotConfig) -> NDArray[np.float64]:
    """Encoder counts of each motor (n,) per rad or m; raises ConfigError if a drive has no ``counts_per_unit``."""
    counts = []
    for joint in robot.joints:
        if joint.drive.counts_per_unit is None:
            raise ConfigError(f"robot {robot.name!r}: {joint.name}.drive.counts_per_unit: a drive on a bus needs it")
        counts.append(joint.drive.counts_per_unit / (2 * np.pi if joint.type == "revolute" else 1.0))
    return np.array(counts)
