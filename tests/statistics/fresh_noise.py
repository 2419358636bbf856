"""Equations of simulated motion with fresh torque noise, for long lives of the recursive estimator.

The dynamics hold for every disturbance: the torque of a drive less that of the rigid model is its measurement noise
less the disturbance torque, whatever motion the loop makes of it. A motion is therefore simulated once with noise. Its
own noise is taken out of the filtered torques. Each repetition gets noise that is drawn anew and filtered in the same
way. Repeated are the motion itself, with its deviations by the first disturbance, and the errors of the live filter.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, upfirdn

from armident.configs import RobotConfig
from armident.daq.recording import Recording
from armident.identify.monitoring.recursive.equations import EARLIER, Instant, StreamEquations
from armident.identify.monitoring.recursive.estimator import RecursiveEstimator
from armident.identify.monitoring.recursive.recorded_blocks import blocks_of
from armident.identify.monitoring.recursive.rows import RowMatcher
from armident.virtual_robot.noise import DISTURBANCE_HZ, Noise, amplitudes
from armident.virtual_robot.servo import control_period

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Decimated equations of a simulated recording, M instants of n joints.

    ``instants``: equations, with the noise of the simulation; ``own_noise``: that noise in the filtered torques,
    (M, n), N m; ``samples``: number of samples that the filters need for them; ``seconds``: duration of the recording,
    s.
    """

    instants: tuple[Instant, ...]
    own_noise: Array
    samples: int
    seconds: float


class MotionRecorder:
    """Makes motions of recordings, with the filters of an estimator.

    ``estimator``: whose filters are copied; ``period``: SYNC period of the recordings, s.
    """

    def __init__(self, estimator: RecursiveEstimator, robot: RobotConfig, period: float) -> None:
        self._robot, self._period = robot, period
        self._instants: list[Instant] = []
        self._first = -1
        self._equations = StreamEquations(
            estimator.reference.model, period, robot.bandwidth_hz or 10.0, True, estimator.settings,
            self._instants.append,
        )  # fmt: skip
        self._decimation = self._equations.decimation

    def record(self, recording: Recording, seed: int) -> Motion:
        """Return the equations of a recording. ``recording``: simulated with the noise of ``seed``."""
        self._instants.clear()
        self._first = -1
        self._equations.restart()
        matcher = RowMatcher(self._robot, True, self._take)
        for block in blocks_of(recording, 1000):
            matcher.add(block)
        decimation = self._decimation
        # The first piece settles the live filter; the equations are delayed by that of the acceleration.
        begin = self._first + self._equations.piece.shape[0] - self._equations.history.shape[0] + EARLIER
        size = (len(self._instants) - 1) * decimation.factor + decimation.taps.size
        torque = held(self._noise_of(recording.samples.sync.size, seed))[begin : begin + size]
        return Motion(
            tuple(self._instants), self.filtered(torque), size + 1, recording.samples.sync.size * self._period
        )

    def filtered(self, torque: Array) -> Array:
        """Return a torque (N, n) behind the low-pass, decimated, (M, n).

        ``torque``: torque of the joints, (N, n), N m.
        """
        taps, factor = self._decimation.taps, self._decimation.factor
        rows: Array = upfirdn(taps, torque, 1, factor, axis=0)
        skip = (taps.size - 1) % factor
        if skip:
            rows = upfirdn(taps, np.vstack([np.zeros((factor - skip, torque.shape[1])), torque]), 1, factor, axis=0)
        first = -(-(taps.size - 1) // factor)
        return rows[first : first + self._decimation.count(len(torque))]

    def _take(self, sync: NDArray[np.int64], values: Array) -> None:
        if self._first < 0:
            self._first = int(sync[0])
        self._equations.add(sync, values)

    def _noise_of(self, samples: int, seed: int) -> Array:
        """Noise in the torques of the joints as sampled, (N, n): measured less disturbance."""
        robot, short = self._robot, control_period(self._robot)
        every = round(self._period / short)
        noise, gain = Noise(robot, short, seed), np.array([joint.drive.gain for joint in robot.joints])
        current, disturbance = np.empty((2, samples * every, robot.n))
        for k in range(samples * every):
            current[k], disturbance[k] = noise.next()
        mean = disturbance.reshape(samples, every, -1).mean(axis=1)
        return np.asarray((current[::every] * gain) @ robot.transmission_matrix - mean)


@dataclass
class FreshNoise:
    """Torque noise of an arm, drawn anew at each call. ``robot``: robot with the name of a virtual arm, n joints."""

    robot: RobotConfig
    period: float
    random: np.random.Generator

    def __post_init__(self) -> None:
        self._white, self._slow = amplitudes(self.robot, control_period(self.robot))
        self._keep = float(np.exp(-2 * np.pi * DISTURBANCE_HZ * self.period))

    def draw(self, samples: int) -> Array:
        """Return measurement noise less disturbance, (N, n), N m, as the virtual arm has them."""
        shape = (samples, self.robot.n)
        white = self.random.standard_normal(shape) * self._white
        fresh = self.random.standard_normal(shape) * (self._slow * np.sqrt(1 - self._keep**2))
        start = self.random.standard_normal((1, self.robot.n)) * self._slow
        slow, _ = lfilter([1.0], [1.0, -self._keep], fresh, axis=0, zi=self._keep * start)
        return np.asarray(white @ self.robot.transmission_matrix - slow)


def held(torque: Array) -> Array:
    """Return the mean of each torque and the one before, (N, n), as the estimator takes it.

    ``torque``: torque held from each sample to the next, (N, n), N m.
    """
    return 0.5 * (torque + np.vstack([torque[:1], torque[:-1]]))


def repeat(estimator: RecursiveEstimator, motion: Motion, noise: Array, factor: Array) -> None:
    """Let an estimator take a motion with other noise and another friction.

    ``noise``: filtered noise, (M, n), N m, in place of the motion's own; ``factor``: friction of each joint relative to
    the reference, (n,).
    """
    reference = estimator.reference
    joint = np.maximum(reference.place, 0)
    change = np.where(reference.place >= 0, (factor[joint] - 1.0) * reference.theta, 0.0)
    for instant, own, other in zip(motion.instants, motion.own_noise, noise, strict=True):
        estimator.handle_instant(replace(instant, y=instant.y - own + other + instant.x @ change))
