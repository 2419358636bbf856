"""Motion of an arm with the derived signals that effects use: times, signs, predicted torques and their slopes."""

from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import count, islice
from typing import TYPE_CHECKING

import numpy as np

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled

if TYPE_CHECKING:
    from armident.identify.robot.arm import ArmModel


STEP = 1e-6
"""Step of the forward differences, rad and rad/s or m and m/s: rounding errors are 2e-10 of a torque, and those of
curvature half the step times the second derivative."""


WORKSPACE_POSTURES = 64
"""Number P of postures for mean values over the workspace: random ones would give them to an eighth of the spread."""


@cache
def _spread(revolute: tuple[bool, ...]) -> Array:
    """Points (P, n) of the Halton sequence over a turn of each revolute joint, rad; prismatic joints are at zero."""
    primes = (p for p in count(2) if all(p % divisor for divisor in range(2, p)))
    points = np.stack([_mirrored_digits(base) for base in islice(primes, len(revolute))], axis=1)
    return np.ascontiguousarray(np.where(revolute, np.pi * (2.0 * points - 1.0), 0.0))


def _mirrored_digits(base: int) -> Array:
    """Return the row numbers (P,), their digits mirrored at the point: of base 2 the points 0, 1/2, 1/4, 3/4, 1/8."""
    rest, share, points = np.arange(WORKSPACE_POSTURES), 1.0, np.zeros(WORKSPACE_POSTURES)
    while rest.any():
        share /= base
        points += share * (rest % base)
        rest //= base
    return points


@dataclass(frozen=True)
class Motion:
    """Positions, their derivatives, and signals that the model computes from them; SI, joint side.

    Parameters
    ----------
    model
        Arm model; effects use its geometry, transmission and smoothing of the sign.
    q, qd, qdd
        Positions, velocities, accelerations, (N, n) each; rad or m, s.
    dt
        Sampling period, s.
    start
        Time of the first sample since the beginning of the first recording, s.
    theta
        Standard (p,) or base (b,) parameters that predict the torques, SI; ``None`` if they are not known.
    duration
        Duration of all recordings together, s: the time unit of slow changes.
    sharp
        ``sign(qd)`` instead of its smoothed form.
    lead
        Samples at the front that only set the state of effects with memory (backlash, bristles, elastic links).
        Columns computed from the motion omit them.
    """

    model: "ArmModel"
    q: Array
    qd: Array
    qdd: Array
    dt: float
    start: float = 0.0
    theta: Array | None = None
    duration: float = 0.0
    sharp: bool = False
    lead: int = 0
    _slopes: dict[tuple[int, bool], tuple[Array, Array, Array]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _still: dict[bool, tuple[Array, Array]] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def samples(self) -> int:
        """Number N of samples."""
        return int(self.q.shape[0])

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.model.n

    @cached_property
    def sign(self) -> Array:
        """Sign of the velocity, smoothed with the ``g`` of the model unless ``sharp`` (thesis appendix B.2), (N, n)."""
        if self.sharp:
            return np.sign(self.qd)
        smooth: Array = self.model.smooth_sign(self.qd)
        return smooth

    @cached_property
    def t(self) -> Array:
        """Time since the beginning of the first recording, s, (N,)."""
        t: Array = self.start + self.dt * np.arange(self.samples, dtype=np.float64)
        return t

    @property
    def whole_time(self) -> float:
        """Duration of all recordings together, at least that of this motion, s."""
        return max(self.duration, self.dt * self.samples)

    @cached_property
    def motor(self) -> Array:
        """Motor positions, rad (m at prismatic joints with direct drive), (N, n)."""
        angles: Array = self.q @ self.model.robot.transmission_matrix.T
        return angles

    @cached_property
    def top_speed(self) -> Array:
        """99 % quantile of the absolute velocity of each joint, rad/s or m/s, (n,)."""
        top: Array = np.maximum(np.quantile(np.abs(self.qd), 0.99, axis=0), 1e-9)
        return top

    @property
    def postures(self) -> Array:
        """Postures spread evenly over a turn of every revolute joint, the same for every motion, rad or m, (P, n).

        They do not depend on the configured limits either; prismatic joints are at zero.
        """
        return _spread(tuple(joint.type == "revolute" for joint in self.model.robot.joints))

    @cached_property
    def span(self) -> Array:
        """Difference between the largest and the smallest position of each joint, rad or m, (n,)."""
        span: Array = np.maximum(np.ptp(self.q, axis=0), 1e-9)
        return span

    @cached_property
    def torque(self) -> Array:
        """Joint torques that the model predicts, with friction, N m or N, (N, n).

        Raises
        ------
        ValueError
            If ``theta`` is missing.
        """
        return self._predicted(self._theta)

    @cached_property
    def transmitted(self) -> Array:
        """Torques that the gears transmit to the links: without friction, offsets and rotors, N m or N, (N, n)."""
        return self._predicted(self.links)

    def handed_on(self, joint: int, rotor: float) -> Array:
        """Torque that the gear of a joint transmits if part of the link's inertia belongs to the motor.

        Parameters
        ----------
        joint
            Index of the joint, from 0.
        rotor
            Part of the link's inertia that belongs to the motor, kg m^2 or kg.

        Returns
        -------
        ndarray
            Torque, N m or N, shape (N,).
        """
        load: Array = self.transmitted[:, joint] - rotor * self.qdd[:, joint]
        return load

    @cached_property
    def standard(self) -> Array:
        """Standard parameters with the same torques as ``theta``, SI, (p,)."""
        theta = self._theta
        return theta if theta.size == len(self.model.names) else self.model.standard_from_base(theta)

    @cached_property
    def links(self) -> Array:
        """Standard parameters of the links, SI, (p,); friction, offsets and rotor inertias are zero."""
        alone: Array = np.where(self.model.of_links, self.standard, 0.0)
        return alone

    @cached_property
    def motor_torque(self) -> Array:
        """Torques that the model predicts at the motor shafts, N m or N, (N, n)."""
        at_shafts: Array = self.torque @ np.linalg.inv(self.model.robot.transmission_matrix)
        return at_shafts

    def of_motor(self, motor: int, torque: Array) -> Array:
        """Joint torques caused by a torque at the shaft of one motor.

        Parameters
        ----------
        motor
            Index of the motor, from 0.
        torque
            Torque at its shaft (N,), N m or N.

        Returns
        -------
        ndarray
            Shape (N, n, 1), N m or N.
        """
        joints: Array = (torque[:, None] * self.model.robot.transmission_matrix[motor])[:, :, None]
        return joints

    def response(
        self, joint: int, shift: Array, rate: Array, acceleration: Array, *, links: bool = False, rotor: float = 0.0
    ) -> Array:
        """First-order change (N, n) of the predicted torques when the motion of one joint changes.

        Parameters
        ----------
        joint
            Index of the joint, from 0.
        shift, rate, acceleration
            Changes of the joint's position, velocity and acceleration, (N,) each; rad or m, s.
        links
            Torques of the links alone, without friction and rotors.
        rotor
            Part of the link's inertia that belongs to the motor, kg m^2 or kg.
        """
        change: Array = _first_order(*self.slopes(joint, links=links), shift, rate, acceleration, joint, rotor)
        return change

    def slopes(self, joint: int, *, links: bool = False) -> tuple[Array, Array, Array]:
        """Derivatives of the predicted torques with respect to position, velocity and acceleration of one joint.

        Parameters
        ----------
        joint
            Index of the joint, from 0.
        links
            Torques of the links alone, without friction and rotors.

        Returns
        -------
        tuple of ndarray
            Three arrays (N, n), in N m or N per rad or m, s.
        """
        key = (joint, links)
        if key not in self._slopes:
            theta = self.links if links else self._theta
            here, inertia = self._smooth(links)
            q, qd = self.q.copy(), self.qd.copy()
            q[:, joint] += STEP
            qd[:, joint] += STEP
            position = (self.model.inverse_dynamics(theta, q, self.qd, self.qdd) - here) / STEP
            velocity = (self.model.inverse_dynamics(theta, self.q, qd, self.qdd) - here) / STEP
            self._slopes[key] = position, velocity, inertia[joint]
        return self._slopes[key]

    def _smooth(self, links: bool) -> tuple[Array, Array]:
        """Predicted torques (N, n), and derivatives (n, N, n) by the accelerations of the joints on the first axis.

        The sign of the friction is always smoothed: a jump has no derivative.
        """
        if links not in self._still:
            theta = self.links if links else self._theta
            masses = self.model.mass_matrix(theta, self.q)
            if self.sharp:
                here = self.model.inverse_dynamics(theta, self.q, self.qd, self.qdd)
            else:
                here = self.transmitted if links else self.torque
            self._still[links] = here, np.ascontiguousarray(masses.transpose(2, 0, 1))
        return self._still[links]

    def rate(self, values: Array) -> Array:
        """Return the time derivative along the first axis by central differences.

        Parameters
        ----------
        values
            Values (N, ...), in any unit; the derivative is in this unit per s.
        """
        slope: Array = np.gradient(values, self.dt, axis=0)
        return slope

    def _predicted(self, theta: Array) -> Array:
        return self.model.inverse_dynamics(theta, self.q, self.qd, self.qdd, sharp_sign=self.sharp)

    @property
    def _theta(self) -> Array:
        if self.theta is None:
            raise ValueError("theta is missing: predicted torques need parameters")
        return self.theta


@compiled("f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], i8, f8", **ARITHMETIC)
def _first_order(
    position: Array,
    velocity: Array,
    inertia: Array,
    shift: Array,
    rate: Array,
    acceleration: Array,
    joint: int,
    rotor: float,
) -> Array:
    """Compute the sum of `Motion.response`; ``position``, ``velocity`` and ``inertia`` are the slopes, (N, n) each."""
    change = np.empty(position.shape)
    for k in range(position.shape[0]):
        for i in range(position.shape[1]):
            change[k, i] = position[k, i] * shift[k] + velocity[k, i] * rate[k] + inertia[k, i] * acceleration[k]
        change[k, joint] -= rotor * acceleration[k]
    return change
