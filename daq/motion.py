"""What a capture makes the arm do: from where it is to the start of the trajectory, the trajectory, and rest."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from configs import RobotConfig, SessionConfig, Trajectory
from configs.trajectory import RAMP_SHARE, Move
from daq.streams import bus_numbers, counts_per_si, node_ids
from drivers.objects import rpdo_cob
from drivers.sync import SetpointPlan

APPROACH_SHARE = 0.5
"""Largest share of the joints' velocity and acceleration limits used on the way to the start."""
SHORTEST_APPROACH_S = 0.5
_ALREADY_THERE = 1e-4
"""A joint closer to the start than this (rad or m) needs no approach."""


@dataclass(frozen=True)
class Motion:
    """Set points of a capture; row ``first`` is the start of the experiment, row ``last`` its end."""

    plan: SetpointPlan
    first: int
    last: int

    def span(self, played_from: int) -> tuple[int, int]:
        """SYNC numbers of start and end of the experiment, with row 0 the target at SYNC ``played_from``.

        The demand reaches a row one interpolation after it becomes the target (60C2h).
        """
        every = self.plan.every
        return played_from + (self.first + 1) * every, played_from + (self.last + 1) * every


def plan_motion(
    session: SessionConfig, robot: RobotConfig, trajectory: Trajectory, actual_counts: NDArray[np.int64]
) -> Motion:
    """Set points from the actual motor positions on.

    Parameters
    ----------
    session
        With ``setpoints``.
    robot
        The robot.
    trajectory
        Checked against the robot's limits.
    actual_counts
        Motor positions (6064h), (n,) counts.
    """
    assert session.setpoints is not None
    options = session.setpoints
    period = session.sync_period * options.every
    scale = counts_per_si(robot)
    actual: NDArray[np.float64] = np.linalg.solve(robot.transmission_matrix, actual_counts / scale).astype(np.float64)
    start = np.array(trajectory.start)
    rest = np.repeat(start[None, :], int(np.ceil(options.settle_s / period)) + 1, axis=0)
    parts = [rest]
    if np.abs(actual - start).max() > _ALREADY_THERE:
        parts.insert(0, approach(actual, start, robot, period))
    first = sum(len(part) for part in parts)
    parts += [trajectory.sample(period)] * options.repeat
    last = sum(len(part) for part in parts) - 1
    parts.append(np.repeat(parts[-1][-1:], len(rest), axis=0))
    counts = np.rint(np.concatenate(parts) @ robot.transmission_matrix.T * scale).astype(np.int32)
    cob_ids = tuple(rpdo_cob(options.rpdo, node) for node in node_ids(session, robot))
    return Motion(SetpointPlan(counts, cob_ids, options.every, bus_numbers(session, robot)), first, last)


def approach(
    actual: NDArray[np.float64], start: NDArray[np.float64], robot: RobotConfig, period: float
) -> NDArray[np.float64]:
    """Joint positions (N, n) of a smooth move from ``actual`` to ``start`` under half the limits."""
    way = np.abs(start - actual)
    velocity = np.array([joint.limits.velocity for joint in robot.joints]) * APPROACH_SHARE
    acceleration = np.array([joint.limits.acceleration for joint in robot.joints]) * APPROACH_SHARE
    # Peaks of a unit move in unit time: speed 1 / (1 - a), acceleration pi / 2 of speed per ramp.
    speed = 1.0 / (1.0 - RAMP_SHARE)
    peak = np.pi / 2 * speed / RAMP_SHARE
    duration = max(
        SHORTEST_APPROACH_S, float((speed * way / velocity).max()), float(np.sqrt(peak * way / acceleration).max())
    )
    move = Move(to=tuple(start.tolist()), duration=duration)
    return Trajectory(schema="armident/trajectory/1", start=tuple(actual.tolist()), moves=(move,)).sample(period)
