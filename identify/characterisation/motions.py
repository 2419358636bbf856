"""Motions of one joint that show its friction, ripple and reversals."""

from collections.abc import Sequence

import numpy as np

from armident.configs import DataError, RobotConfig, Trajectory
from armident.daq.recording import Recording
from armident.identify.characterisation.motion import alone
from armident.identify.excitation.collision import CollisionModel
from armident.identify.identification.from_recording import experiments_of
from armident.identify.investigation.choice import excluded, home_of
from armident.identify.investigation.motions import ConstantSpeeds, MotionFamily, Reversals, reach_of

MOTIONS: tuple[MotionFamily, ...] = (ConstantSpeeds(), Reversals())
"""Families of the motions, in the order in which they are played."""


def motion_of(
    family: MotionFamily, robot: RobotConfig, joint: int, recordings: Sequence[Recording], collision: CollisionModel
) -> tuple[str, Trajectory]:
    """Return the largest allowed motion of a family at a joint, in words and as a trajectory."""
    home, speeds, accelerations = home_of(robot), np.zeros(robot.n), np.zeros(robot.n)
    if recordings:
        experiments, _ = experiments_of(recordings, robot, name_files=True)
        home = np.round(experiments[0].q[0], 4)
        seen = alone(experiments, robot, joint)
        speeds[joint] = max(float(np.abs(m.speed).max()) for m in seen)
        # Noise of a position differentiated twice has peaks that the arm does not have.
        accelerations[joint] = max(float(np.quantile(np.abs(m.qdd), 0.99)) for m in seen)
    reach, reason = reach_of(robot, home, speeds, accelerations), None
    for size in sorted(family.sizes, reverse=True):
        trajectory = family.trajectory(reach, joint, size)
        reason = excluded(robot, trajectory, None, collision)
        if reason is None:
            return family.in_words([each.name for each in robot.joints], joint), trajectory
    raise DataError(f"{robot.joints[joint].name}: no motion {family.name} is allowed: {reason}")
