"""A motion as the effects of the catalogue see it."""

from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from armident.identify.robot.compiled import compiled

if TYPE_CHECKING:
    from armident.identify.robot.arm import ArmModel

Array = NDArray[np.float64]

STEP = 1e-6
"""Of the finite differences, rad and rad/s, or in metres."""


POSTURES = 64
"""Over which a mean is taken."""


@cache
def _spread(limits: tuple[tuple[float, float], ...]) -> Array:
    """Points (P, n) of the Halton sequence between limits."""
    points = qmc.Halton(len(limits), scramble=False).random(POSTURES)
    low, high = np.array(limits).T
    return np.ascontiguousarray(low + points * (high - low))


@dataclass(frozen=True)
class Motion:
    """Positions, their derivatives, and what the model makes of them; SI, joint side.

    Parameters
    ----------
    model
        The arm; of it effects use geometry, transmission, limits and the smoothing of the sign.
    q, qd, qdd
        Shape (N, n) each.
    dt
        Sampling period, s.
    start
        Time of the first sample since the beginning of the first recording, s.
    theta
        Standard or base parameters by which torques are predicted, (p,) or (b,); ``None`` while there are none.
    duration
        Of all recordings together, s: what a slow change is measured in.
    lead
        Samples at the front that are there for what has a memory (a gap, a bristle, a swinging link) only: of columns
        made of the motion they are cut off.
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
        """N."""
        return int(self.q.shape[0])

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.model.n

    @cached_property
    def sign(self) -> Array:
        """Sign of the velocity, smoothed as the model smooths it (thesis appendix B.2), (N, n)."""
        if self.sharp:
            return np.sign(self.qd)
        smooth: Array = self.model.smooth_sign(self.qd)
        return smooth

    @cached_property
    def t(self) -> Array:
        """Time since the beginning of the first recording, s, (N,)."""
        t: Array = self.start + self.dt * np.arange(self.samples, dtype=np.float64)
        return t

    @cached_property
    def motor(self) -> Array:
        """Angles of the motors, rad (m where the axis is prismatic and direct), (N, n)."""
        angles: Array = self.q @ self.model.robot.transmission_matrix.T
        return angles

    @cached_property
    def top_speed(self) -> Array:
        """Speed that each joint exceeds for one sample in a hundred, (n,)."""
        top: Array = np.maximum(np.quantile(np.abs(self.qd), 0.99, axis=0), 1e-9)
        return top

    @property
    def postures(self) -> Array:
        """Postures of the arm, spread evenly over the ranges of its joints whatever the motion, (P, n)."""
        return _spread(tuple(joint.limits.position for joint in self.model.robot.joints))

    @cached_property
    def span(self) -> Array:
        """Distance between the outermost positions of each joint, (n,)."""
        span: Array = np.maximum(np.ptp(self.q, axis=0), 1e-9)
        return span

    @cached_property
    def torque(self) -> Array:
        """Joint torques that the model predicts, friction included, (N, n).

        Raises
        ------
        ValueError
            If there are no parameters to predict with.
        """
        return self._predicted(self._theta)

    @cached_property
    def transmitted(self) -> Array:
        """Torques that the gears hand on to the links: without friction, offsets and rotors, (N, n)."""
        return self._predicted(self.links)

    def handed_on(self, joint: int, rotor: float) -> Array:
        """Torque (N,) that a gear hands on if ``rotor`` (kg m^2 or kg) of the link's inertia is the motor's."""
        load: Array = self.transmitted[:, joint] - rotor * self.qdd[:, joint]
        return load

    @cached_property
    def standard(self) -> Array:
        """Standard parameters that predict the same torques as ``theta``, (p,)."""
        theta = self._theta
        return theta if theta.size == len(self.model.names) else self.model.standard_from_base(theta)

    @cached_property
    def links(self) -> Array:
        """Standard parameters of the links alone: no friction, offsets and rotors, (p,)."""
        alone: Array = np.where(self.model.of_links, self.standard, 0.0)
        return alone

    @cached_property
    def motor_torque(self) -> Array:
        """Torques at the shafts of the motors that the model predicts, (N, n)."""
        at_shafts: Array = self.torque @ np.linalg.inv(self.model.robot.transmission_matrix)
        return at_shafts

    def of_motor(self, motor: int, torque: Array) -> Array:
        """What a torque (N,) at the shaft of a motor is at the joints, (N, n, 1)."""
        joints: Array = (torque[:, None] * self.model.robot.transmission_matrix[motor])[:, :, None]
        return joints

    def response(
        self, joint: int, shift: Array, rate: Array, acceleration: Array, *, links: bool = False, rotor: float = 0.0
    ) -> Array:
        """Change (N, n) of the predicted torques when one joint moves otherwise, to first order.

        Parameters
        ----------
        shift, rate, acceleration
            Changes of the joint's position, velocity and acceleration, (N,) each.
        links
            Of the links alone, without friction and rotors.
        rotor
            What of the link's inertia is the motor's, kg m^2 or kg.
        """
        change: Array = _first_order(*self.slopes(joint, links=links), shift, rate, acceleration, joint, rotor)
        return change

    def slopes(self, joint: int, *, links: bool = False) -> tuple[Array, Array, Array]:
        """Slopes of the predicted torques over position, velocity and acceleration of a joint, (N, n) each."""
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
        """Predicted torques (N, n), and their slopes over the accelerations, (n, N, n) with those of each joint first.

        The sign is smoothed even where the motion has it sharp: a jump has no slope.
        """
        if links not in self._still:
            theta = self.links if links else self._theta
            masses = self.model.mass_matrix(theta, self.q)
            here = self.model.inverse_dynamics(theta, self.q, self.qd, self.qdd)
            self._still[links] = here, np.ascontiguousarray(masses.transpose(2, 0, 1))
        return self._still[links]

    def rate(self, values: Array) -> Array:
        """Time derivative along the first axis, central differences."""
        slope: Array = np.gradient(values, self.dt, axis=0)
        return slope

    def _predicted(self, theta: Array) -> Array:
        return self.model.inverse_dynamics(theta, self.q, self.qd, self.qdd, sharp_sign=self.sharp)

    @property
    def _theta(self) -> Array:
        if self.theta is None:
            raise ValueError("a motion without parameters predicts no torque")
        return self.theta


@compiled
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
    """See `Motion.response`; the slopes are (N, n) each."""
    change = np.empty(position.shape)
    for k in range(position.shape[0]):
        for i in range(position.shape[1]):
            change[k, i] = position[k, i] * shift[k] + velocity[k, i] * rate[k] + inertia[k, i] * acceleration[k]
        change[k, joint] -= rotor * acceleration[k]
    return change
