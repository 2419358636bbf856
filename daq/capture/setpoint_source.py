"""Set points of a capture (approach to the start, trajectory, rest), and detection of standstill."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import RobotConfig, SessionConfig, Trajectory
from armident.configs.schema.trajectory import RAMP_SHARE, Move
from armident.configs.units import counts_per_si
from armident.daq.matching.streams import bus_numbers, node_ids
from armident.drivers.canopen.objects import rpdo_cob
from armident.drivers.canopen.sync_producer import SetpointPlan

APPROACH_SHARE = 0.5
"""Share of the joints' velocity and acceleration limits that the approach to the start uses."""
SHORTEST_APPROACH_S = 0.5
"""Shortest duration of the approach, s."""
REST_SPAN_S = 0.05
"""Time without motion after which an arm stands still, s."""
REST_STEP_S = 0.01
"""Shortest time between two compared positions, s."""
SLOW_SHARE = 0.002
"""Share of a joint's velocity limit up to which it stands still."""
NOISE_COUNTS = 2.0
"""Encoder counts by which two positions of a motor at standstill may differ."""
_START_TOLERANCE = 1e-4
"""A joint closer to the start than this (rad or m) needs no approach."""


class StandstillDetector:
    """Detects from the newest positions that an arm has come to rest.

    No joint may exceed 0.2 % of its velocity limit, averaged over any 10 ms of the last 50 ms: the turning point of an
    oscillation is no standstill. Two encoder counts are no motion.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig) -> None:
        self._step, self._span = round(REST_STEP_S / session.sync_period), round(REST_SPAN_S / session.sync_period)
        self._per_count = np.linalg.inv(robot.transmission_matrix) / counts_per_si(robot)
        limits = np.array([joint.limits.velocity for joint in robot.joints])
        self._slow = limits * SLOW_SHARE * session.sync_period
        self._noise = np.abs(self._per_count).sum(axis=1) * NOISE_COUNTS
        self._last: tuple[int, Array] | None = None
        self._since = 0

    def update(self, sync: int, counts: NDArray[np.integer]) -> bool:
        """Take motor positions (n,), counts; return True if the arm stands still, False during the first 50 ms."""
        now = self._per_count @ counts
        if self._last is None:
            self._last, self._since = (sync, now), sync
        last, before = self._last
        if sync - last >= max(self._step, 1):
            if (np.abs(now - before) > np.maximum(self._slow * (sync - last), self._noise)).any():
                self._since = sync
            self._last = sync, now
        return self._last[0] - self._since >= self._span


@dataclass(frozen=True)
class SetpointSchedule:
    """Set points of a capture, and the rows of the start and of the end of the experiment."""

    plan: SetpointPlan
    first: int
    last: int

    def span(self, played_from: int) -> tuple[int, int]:
        """Return the SYNCs of start and end of the experiment; row 0 becomes the target at ``played_from``.

        The demand reaches a row one interpolation period (60C2h) after the row has become the target.
        """
        every = self.plan.every
        return played_from + (self.first + 1) * every, played_from + (self.last + 1) * every


def plan_setpoints(
    session: SessionConfig, robot: RobotConfig, trajectory: Trajectory, actual_counts: NDArray[np.int64]
) -> SetpointSchedule:
    """Return a trajectory's set points, with an approach from motor positions (6064h) (n,), counts, and rests."""
    assert session.setpoints is not None
    options = session.setpoints
    period = session.sync_period * options.every
    scale = counts_per_si(robot)
    actual: Array = np.linalg.solve(robot.transmission_matrix, actual_counts / scale).astype(np.float64)
    start = np.array(trajectory.start)
    rest = np.repeat(start[None, :], int(np.ceil(options.settle_s / period)) + 1, axis=0)
    parts = [rest]
    if np.abs(actual - start).max() > _START_TOLERANCE:
        parts.insert(0, approach(actual, start, robot, period))
    first = sum(len(part) for part in parts)
    parts += [trajectory.sample(period)] * options.repeat
    last = sum(len(part) for part in parts) - 1
    parts.append(np.repeat(parts[-1][-1:], len(rest), axis=0))
    counts = np.rint(np.concatenate(parts) @ robot.transmission_matrix.T * scale).astype(np.int32)
    cob_ids = tuple(rpdo_cob(options.rpdo, node) for node in node_ids(session, robot))
    return SetpointSchedule(SetpointPlan(counts, cob_ids, options.every, bus_numbers(session, robot)), first, last)


def approach(actual: Array, start: Array, robot: RobotConfig, period: float) -> Array:
    """Return positions (N, n), rad or m, of a smooth move within `APPROACH_SHARE` of the limits; ``period`` in s."""
    distance = np.abs(start - actual)
    velocity = np.array([joint.limits.velocity for joint in robot.joints]) * APPROACH_SHARE
    acceleration = np.array([joint.limits.acceleration for joint in robot.joints]) * APPROACH_SHARE
    # Peaks of a unit move in unit time with ramps of share a: speed 1 / (1 - a), acceleration pi / 2 speed / a.
    speed = 1.0 / (1.0 - RAMP_SHARE)
    peak = np.pi / 2 * speed / RAMP_SHARE
    duration = max(
        SHORTEST_APPROACH_S,
        float((speed * distance / velocity).max()),
        float(np.sqrt(peak * distance / acceleration).max()),
    )
    move = Move(to=tuple(start.tolist()), duration=duration)
    return Trajectory(schema="armident/trajectory/1", start=tuple(actual.tolist()), moves=(move,)).sample(period)
