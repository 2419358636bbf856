"""Simulated recordings of the virtual arm without a bus, with the same drives and plant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig, Trajectory
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.trajectory import check_motion
from armident.configs.units import counts_per_si
from armident.daq.recording import Field, Mark, Recording, Stream
from armident.virtual_robot import servo
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.arm_parameters import ArmParameters

Effort = Literal["current", "voltage", "torque"]

OPERATION_ENABLED = 0x1237
"""Statusword: operation enabled, remote, drive follows the command value (CiA 402)."""
COUNTER = 240
"""Overflow of the SYNC counter: SYNC k carries ``k % COUNTER + 1``."""


@dataclass(frozen=True, eq=False)
class ReferenceTable:
    """Reference positions as a table: times (N,), s, and positions (N, n), rad or m; cubic between the rows."""

    t: Array
    q: Array

    @classmethod
    def read(cls, path: Path) -> "ReferenceTable":
        """Read columns ``t`` and one reference per joint; raises ConfigError if the file is no such table."""
        try:
            table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: expected columns t and one reference per joint: {error}") from error
        if table.shape[0] < 4 or table.shape[1] < 2 or not (np.diff(table[:, 0]) > 0.0).all():
            raise ConfigError(f"{path}: expected at least four rows with increasing times and one joint or more")
        return cls(table[:, 0] - table[0, 0], table[:, 1:])

    @property
    def period(self) -> float:
        """Step of the table, s, to a nanosecond."""
        return round(float(self.t[-1]) / (self.t.size - 1), 9)

    @property
    def start(self) -> tuple[float, ...]:
        """Positions of the first row, rad or m, (n,)."""
        return tuple(self.q[0].tolist())

    def sample(self, period: float) -> Array:
        """Return the positions (M, n), rad or m, at multiples of a period, s."""
        times = np.arange(round(float(self.t[-1]) / period) + 1) * period
        return np.asarray(CubicSpline(self.t, self.q)(np.minimum(times, self.t[-1])))

    def check(self, robot: RobotConfig) -> None:
        """Refuse a motion beyond the limits of a robot, as a trajectory does."""
        period = 1e-3
        check_motion(self.sample(period), period, robot, "reference")


def simulate_recording(
    robot: RobotConfig,
    trajectory: "Trajectory | ReferenceTable",
    seed: int,
    noise: float = 1.0,
    scenario: Scenario | None = None,
    period: float | None = None,
    setpoint_every: int = 5,
    settle: float = 0.3,
    velocity_feedback: bool | None = None,
    parameters: ArmParameters | None = None,
) -> Recording:
    """Simulate a recording of the virtual arm on a trajectory, as ``armident capture`` would write it.

    Streams are ``samples`` (position, effort, status) and ``demand``, with marks of the experiment. ``settle``: rest
    before and after it, s; ``setpoint_every``: SYNCs. Raises ConfigError if the trajectory exceeds limits.
    """
    trajectory.check(robot)
    every, period = setpoint_every, servo.control_period(robot) if period is None else period
    scale = counts_per_si(robot)
    rows = np.rint(trajectory.sample(period * every) @ robot.transmission_matrix.T * scale).astype(np.int32)
    first = round(settle / period / every) * every + every - 1
    last = first + (len(rows) - 1) * every
    total = last + round(settle / period) + 1

    arm = Arm(robot, trajectory.start, period, seed, noise, scenario, velocity_feedback, parameters)
    for joint in range(robot.n):
        arm.enable(joint, True)
        arm.interpolation_time(joint, period * every)
    n = robot.n
    position, current = np.empty((total, n), np.int32), np.empty((total, n), np.int16)
    demand = np.empty((total // every, n), np.int32)
    fresh = np.ones(n, np.bool_)
    for k in range(total):
        position[k], current[k] = arm.position, arm.current
        if (k % COUNTER + 1) % every == 0:
            demand[k // every] = arm.demand
            # Row m is the demand at SYNC first + m every, so it must be the target one interpolation earlier.
            m = (k + every - first) // every
            arm.set_targets(rows[min(max(m, 0), len(rows) - 1)], fresh)
        arm.advance()

    step_ns = round(period * 1e9)
    sync = np.arange(total, dtype=np.int64)
    knots = np.arange(every - 1, total, every, dtype=np.int64)
    samples = Stream(
        "samples", 1, sync, sync * step_ns, sample_fields(robot),
        {"position": position, effort_of(robot): current, "status": np.full((total, n), OPERATION_ENABLED, np.uint16)},
    )  # fmt: skip
    fields = {"demand": Field("demand", "demand", _position_unit(robot), "motor", _per_count(robot))}
    demands = Stream("demand", every, knots, knots * step_ns, fields, {"demand": demand})
    marks = (
        Mark("experiment_start", first, first * step_ns),
        Mark("experiment_end", last, last * step_ns),
    )
    return Recording(None, robot, None, 1.0 / period, {"samples": samples, "demand": demands}, marks=marks)


def with_encoder_counts(robot: RobotConfig, counts: float) -> RobotConfig:
    """Robot with another encoder resolution on every motor. ``counts``: counts per motor turn, or per metre."""
    joints = tuple(
        joint.model_copy(update={"drive": joint.drive.model_copy(update={"counts_per_unit": float(counts)})})
        for joint in robot.joints
    )
    return robot.model_copy(update={"joints": joints})


def effort_of(robot: RobotConfig) -> Effort:
    """Quantity that the robot's drives report as effort; raises ConfigError if they report different ones."""
    efforts: list[Effort] = sorted({joint.drive.signal for joint in robot.joints})
    if len(efforts) > 1:
        raise ConfigError(f"robot {robot.name!r}: its drives report {' and '.join(efforts)}; a stream holds only one")
    return efforts[0]


def sample_fields(robot: RobotConfig) -> dict[str, Field]:
    """Fields of the ``samples`` stream: motor positions, efforts, statuswords."""
    rated = tuple(joint.drive.rated / 1000.0 for joint in robot.joints)
    effort, metres = effort_of(robot), _position_unit(robot) == "m"
    unit = {"current": "A", "voltage": "V", "torque": "N" if metres else "N m"}[effort]
    return {
        "position": Field("position", "position", _position_unit(robot), "motor", _per_count(robot)),
        effort: Field(effort, effort, unit, "motor", rated),
        "status": Field("status", "status", "", "motor", (1.0,) * robot.n),
    }


def _position_unit(robot: RobotConfig) -> str:
    return "rad" if all(joint.type == "revolute" for joint in robot.joints) else "m"


def _per_count(robot: RobotConfig) -> tuple[float, ...]:
    return tuple(float(1.0 / x) for x in counts_per_si(robot))
