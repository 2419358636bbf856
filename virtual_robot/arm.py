"""Virtual arm: servo drives on the plant, simulated by control periods."""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.units import counts_per_si
from armident.virtual_robot import servo
from armident.virtual_robot.arm_parameters import ArmParameters, arm_parameters, with_scenario
from armident.virtual_robot.effects import hidden_effects
from armident.virtual_robot.effects.signals import Signals
from armident.virtual_robot.noise import Noise
from armident.virtual_robot.plant import BRAKE, Plant

Raw32 = NDArray[np.int32]
Raw16 = NDArray[np.int16]


class DriveBackend(Protocol):
    """Plant or recording behind the drives: raw numbers (n,) for the coming SYNC, which `advance` changes in place.

    Motor positions and demands in counts, int32; reported signals in per mille of rated, int16.
    """

    position: Raw32
    current: Raw16
    demand: Raw32

    def enable(self, joint: int, enabled: bool) -> None:
        """Handle that a drive enters or leaves operation enabled. ``enabled``: new state."""

    def set_targets(self, targets: Raw32, fresh: NDArray[np.bool_]) -> None:
        """Set target positions (n,), counts, int32, where ``fresh`` (n,), reached after the interpolation time."""

    def advance(self) -> None:
        """Advance by one SYNC period."""


class Arm:
    """Virtual arm: plant, drives and noise, with the raw numbers of the bus.

    Drives without a control period of their own (``servo.OWN_PERIODS``) report position and demand of the last SYNC,
    and the mean signal since. ``q``: initial posture (n,), rad or m. ``sync_period``: s, default one control period;
    that of the EMPS is a multiple. Raises ConfigError if it is no multiple, or an encoder resolution is missing.
    """

    def __init__(
        self,
        robot: RobotConfig,
        q: ArrayLike,
        sync_period: float | None = None,
        seed: int = 0,
        noise: float = 1.0,
        scenario: Scenario | None = None,
        velocity_feedback: bool | None = None,
        parameters: ArmParameters | None = None,
    ) -> None:
        n, period = robot.n, servo.control_period(robot, sync_period)
        sync_period = period if sync_period is None else sync_period
        self._periods = round(sync_period / period)
        if self._periods < 1 or abs(self._periods * period - sync_period) > 1e-9:
            raise ConfigError(
                f"SYNC period {sync_period * 1e6:.0f} us: the virtual drives need a multiple of {period * 1e6:.0f} us"
            )
        parameters = arm_parameters(robot) if parameters is None else parameters
        chosen = with_scenario(parameters, robot, scenario)
        # A signal sampled at every SYNC would miss the pulses in between that move the arm.
        self._averages = self._periods > 1 and robot.name not in servo.OWN_PERIODS
        self._sum = np.zeros(n)
        self.plant = Plant(robot, q, scenario, parameters)
        self._signals = Signals(hidden_effects(scenario, robot), robot, period)
        averaged = self._periods if self._averages else 1
        self._noise = Noise(robot, period, seed, noise, chosen.noise, averaged)
        self._ratio = robot.transmission_matrix
        drives = [joint.drive for joint in robot.joints]
        self._per_rad = counts_per_si(robot)
        self._torque = np.ascontiguousarray(self._ratio.T * [drive.gain for drive in drives])
        self._limit = np.array([drive.saturation or np.inf for drive in drives])
        self._permille = np.array([1000.0 / drive.rated for drive in drives])
        # Drives are tuned for the arm without hidden effects.
        known = self.plant if scenario is None else Plant(robot, q, None, parameters)
        self._servo = design_drives(robot, known.mass_matrix(), velocity_feedback, period, scenario, chosen)
        self._origin, self._target = np.zeros(n), np.zeros(n)
        self._age, self._steps = np.zeros(n, np.int64), np.ones(n, np.int64)
        self._held = np.ones(n, np.bool_)
        self._past, self._rate, self._current = np.zeros((n, self._servo.velocity_samples)), np.zeros(n), np.zeros(n)
        self._tau = np.zeros(n)
        self.position, self.current, self.demand = np.zeros(n, np.int32), np.zeros(n, np.int16), np.zeros(n, np.int32)
        # Numbers at present, and as they are without hidden errors of names and signs.
        self._now = (self.position, self.current, self.demand)
        if self._averages:
            self._now = (self.position.copy(), self.current.copy(), self.demand.copy())
        self._own = self._now
        if self._signals.swapped:
            self._own = (self.position.copy(), self.current.copy(), self.demand.copy())
        self.plant.brake[:] = BRAKE
        self._control()
        self.position[:], self.current[:], self.demand[:] = self._now

    def interpolation_time(self, joint: int, seconds: float) -> None:
        """Set the interpolation time of a drive (60C2h). ``seconds``: time from one target to the next, s."""
        self._steps[joint] = max(round(seconds / self._servo.period), 1)

    def enable(self, joint: int, enabled: bool) -> None:
        """Open or close the brake of a joint; its demand starts at the measured position."""
        self._held[joint] = not enabled
        self.plant.brake[joint] = 0.0 if enabled else BRAKE

    def set_targets(self, targets: Raw32, fresh: NDArray[np.bool_]) -> None:
        """Set target positions (n,), counts, int32, where ``fresh`` (n,); interpolation starts at the last target."""
        take = fresh & ~self._held
        np.copyto(self._origin, self._target, where=take)
        np.copyto(self._target, targets, where=take)
        # The control period that follows is one after this SYNC.
        np.copyto(self._age, 1, where=take)

    def advance(self) -> None:
        """Advance by one SYNC period."""
        position, current, demand = self._now
        if self._averages:
            self.position[:], self.demand[:] = position, demand
            self._sum[:] = 0.0
        for _ in range(self._periods):
            self._sum += current
            self.plant.advance(self._tau, self._servo.period)
            self._control()
        if self._averages:
            self.current[:] = np.rint(self._sum / self._periods)

    def _control(self) -> None:
        measured, disturbance = self._noise.next()
        drives, (position, current, demand) = self._servo, self._own
        servo.control(
            drives.period, drives.velocity_feedback, self._signals.measured(self.plant.q), self._ratio, self._per_rad,
            self._origin, self._target, self._age, self._steps, self._held,
            drives.kp, drives.kv, drives.smooth, self._limit, measured, self._permille,
            self._past, self._rate, self._current, position, current, demand,
            self._torque, disturbance, self._tau,
        )  # fmt: skip
        if self._signals.acts:
            self._distort(measured, disturbance)

    def _distort(self, noise: Array, disturbance: Array) -> None:
        """Apply hidden errors of amplifiers, wiring and names between drives, plant and bus."""
        signals, (position, current, demand) = self._signals, self._own
        self._tau[:] = signals.applied(self._current)
        self._tau += disturbance
        signals.on_the_bus(self._current, noise, self._permille, current)
        if signals.swapped:
            signals.rewired_torque(current, self._now[1])
            signals.rewired_position(position, self._now[0])
            signals.rewired_position(demand, self._now[2])


def design_drives(
    robot: RobotConfig,
    mass: Array,
    velocity_feedback: bool | None,
    period: float,
    scenario: Scenario | None,
    parameters: ArmParameters,
) -> servo.Servo:
    """Design the drives of a virtual arm: gains of the scenario, else of its configuration, else tuned ones."""
    given = None if scenario is None or scenario.controller is None else scenario.controller
    known = None if given is None else given.gains
    if known is not None and not len(known.kp) == len(known.kv) == robot.n:
        raise ConfigError(f"scenario: controller.gains: expected {robot.n} numbers in kp and in kv")
    if given is not None and known is None:
        # A bandwidth is given: the known controller of the configuration does not count.
        robot = robot.model_copy(update={"controller": None})
    return servo.tuned_drives(
        robot, mass, velocity_feedback, period=period, bandwidth_hz=parameters.bandwidth_hz, known=known
    )
