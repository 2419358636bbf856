"""Thresholds and widths of the recursive estimator, each with its unit and source."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class RecursiveSettings:
    """Numbers of the recursive estimator; times count motion only.

    ``velocity_band``: bandwidth of the live velocity filter, in closed-loop bandwidths. The filter attenuates a
        velocity of frequency f by ``2 (f / f0)^2``: 0.3 % at the closed-loop bandwidth.
    ``highest_band``: upper limit of that bandwidth, in sampling rates; the filter has no delay of first order up to
        there.
    ``friction_walk``, ``mass_walk``: random walk of friction and of the other parameters, relative standard deviation
        after one minute. Friction of a gear changes by a few percent a minute while it warms up (thesis section 7.3.2
        asks for such models); masses do not change, their walk covers what the model leaves out.
    ``noise_memory_s``: memory of the running residual statistics, s: five times the minute in which a change must be
        seen, so that the change itself does not count as noise in that minute.
    ``noise_correlation_s``: longest correlation of the residuals that counts, s: moves of a second have the same model
        error throughout.
    ``noise_least_s``: motion of a joint before its first noise variance, s.
    ``moving_sign``: smoothed sign of the velocity above which a joint counts as moving, 1. Below it Coulomb friction is
        not determined (thesis section B.2).
    ``moving_share``: share of the low-pass window in which a joint must move, 1.
    ``following_memory_s``: memory of the following error and of the velocity that the reference predicts, s: a few
        cycles of a motion.
    ``instrument_error``: largest relative error of the velocity that the reference predicts, 1: the limit of the
        verdict of an identification for an auxiliary model that does not move like the robot.
    ``window_s``: motion per independent estimate, s. Twelve of them are a minute.
    ``tolerated``, ``sought``: relative change of a joint's friction against its slow level that is healthy, and the one
        that must be found, 1. A change above their mean raises an alarm sooner or later, one below it does not.
    ``false_alarm_hours``: mean hours of motion between false alarms of the whole arm, h: a year of forty hours a week.
    ``least_windows``: windows that an alarm needs at least: no single disturbance is an alarm.
    ``level_memory_s``: memory of the slow level that each joint's friction is compared with, s. Warming up takes tens
        of minutes; slower changes are for the scheduled re-identification.
    ``excitation_std``: relative standard deviation of a joint's friction, by the data alone, from which on its values
        are valid, 1. At a quarter of the difference between sought and tolerated change, one window decides with eight
        nats.
    ``excitation_memory_s``: memory of this information, s.
    """

    velocity_band: float = 25.0
    highest_band: float = 0.1
    friction_walk: float = 0.01
    mass_walk: float = 0.001
    noise_memory_s: float = 300.0
    noise_correlation_s: float = 1.0
    following_memory_s: float = 30.0
    noise_least_s: float = 3.0
    moving_sign: float = 0.9
    moving_share: float = 0.9
    instrument_error: float = 0.3
    window_s: float = 5.0
    tolerated: float = 0.02
    sought: float = 0.1
    false_alarm_hours: float = 2000.0
    least_windows: int = 3
    level_memory_s: float = 3600.0
    excitation_std: float = 0.02
    excitation_memory_s: float = 120.0

    def threshold(self, joints: int) -> float:
        """Threshold of the log-likelihood ratio, nats, for both directions of all joints together (Lorden 1971)."""
        return math.log(2 * joints * 3600.0 / self.window_s * self.false_alarm_hours)

    @property
    def needed_information(self) -> float:
        """Fisher information of a joint's relative friction from which on its values are valid, 1."""
        return self.excitation_std**-2
