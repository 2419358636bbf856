"""Motions that an investigation may ask for, one class for each family."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig, Trajectory
from armident.configs.schema.trajectory import Move

MARGIN = 0.9
"""Usable share of each limit."""
SLOWEST = 0.01
"""Slowest of the constant speeds over the fastest: dry friction has its Stribeck part below a tenth."""
FIRST_CONTACT = 0.1
"""Share of its limits that a joint may use before it was seen to move."""
FASTER = 1.5
"""Speed and acceleration that a motion may reach over those of the recordings so far."""
RAMPS = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Shares of a move spent on each ramp: the first one within the limit of acceleration is used."""
SHORTEST = 0.05
"""Shortest move, s."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Limits of designed motions and the posture where they begin and end, (n,) each; SI, joint side."""

    low: Array
    high: Array
    velocity: Array
    acceleration: Array
    home: Array

    @property
    def range(self) -> Array:
        """Usable range of each joint, rad or m, (n,)."""
        return np.asarray(self.high - self.low)


def reach_of(robot: RobotConfig, home: Array, speeds: Array, accelerations: Array) -> Reach:
    """Return the limits of motions of an arm whose recordings reach ``speeds`` and ``accelerations`` (n,) so far."""
    limits = [joint.limits for joint in robot.joints]
    bounds = np.array([limit.position for limit in limits])
    middle, half = bounds.mean(axis=1), 0.5 * (bounds[:, 1] - bounds[:, 0])
    low, high = middle - MARGIN * half, middle + MARGIN * half

    def allowed(most: Array, seen: Array) -> Array:
        return np.minimum(MARGIN * most, np.maximum(FIRST_CONTACT * most, FASTER * seen))

    velocity = allowed(np.array([limit.velocity for limit in limits]), speeds)
    acceleration = allowed(np.array([limit.acceleration for limit in limits]), accelerations)
    return Reach(low, high, velocity, acceleration, np.clip(home, low, high))


@dataclass
class Path:
    """Moves from the home posture, one after the other, each as fast as the limits and a wanted speed allow."""

    reach: Reach
    moves: list[Move] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.at = self.reach.home.copy()

    def to(self, point: Array, speed: float = 1.0, dwell: float = 0.0) -> None:
        """Move to a posture (n,) at a share of the allowed speed, and rest."""
        point = np.clip(point, self.reach.low, self.reach.high)
        length = np.abs(point - self.at)
        if length.max() < 1e-6:
            if dwell and self.moves:
                last = self.moves[-1]
                self.moves[-1] = last.model_copy(update={"dwell": last.dwell + dwell})
            return
        for ramp in RAMPS:
            by_speed = float((length / (speed * self.reach.velocity)).max()) / (1.0 - ramp)
            peak = 0.5 * np.pi / (ramp * (1.0 - ramp))
            by_acceleration = float(np.sqrt(peak * length / self.reach.acceleration).max())
            if by_acceleration <= by_speed:
                break
        duration = max(by_speed, by_acceleration, SHORTEST)
        target = tuple(float(f"{value:.5f}") for value in point)
        # Rounded up: a shorter move would be faster than allowed.
        self.moves.append(Move(to=target, duration=float(np.ceil(1e3 * duration) / 1e3), dwell=dwell, ramp=ramp))
        self.at = np.array(target)

    def joint_to(self, joint: int, position: float, speed: float = 1.0, dwell: float = 0.0) -> None:
        """Move one joint to a position, rad or m, at a share of the allowed speed; the others rest."""
        point = self.at.copy()
        point[joint] = position
        self.to(point, speed, dwell)

    def trajectory(self) -> Trajectory:
        """Return the moves and the way home as a trajectory."""
        self.to(self.reach.home, 0.5)
        home = tuple(float(value) for value in self.reach.home)
        return Trajectory(schema="armident/trajectory/1", start=home, moves=tuple(self.moves))


class MotionFamily(ABC):
    """A family of motions: what moves, and which explanations it tells apart.

    Its content is similar in its first two thirds, from which a diagnosis learns, and in the rest, by which it judges.
    """

    name: ClassVar[str]
    words: ClassVar[str]
    """The motion in words, with the names of its ``{joint}`` and of its ``{other}``."""
    sizes: ClassVar[tuple[float, ...]] = (0.15, 0.4)
    """Amplitudes to consider over the usable range."""
    pairs: ClassVar[bool] = False
    """True if it moves a joint together with a second one."""

    def trajectory(self, reach: Reach, joint: int, size: float, other: int | None = None) -> Trajectory:
        """Return the motion of a joint, from 0; ``size``: amplitude over the usable range of the joint."""
        path = Path(reach)
        self.draw(path, joint, size, joint if other is None else other)
        return path.trajectory()

    @abstractmethod
    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append the moves to a path that begins at home."""

    def in_words(self, joints: Sequence[str], joint: int, other: int | None = None) -> str:
        """Return the motion in words. ``joints``: names of the joints."""
        return self.words.format(joint=joints[joint], other=joints[joint if other is None else other])


def ends(path: Path, joint: int, size: float) -> tuple[float, float]:
    """Return the ends of a motion of a joint about its home, shifted into the usable range, rad or m."""
    reach = path.reach
    span = size * reach.range[joint]
    low = float(np.clip(reach.home[joint] - span, reach.low[joint], reach.high[joint] - 2.0 * span))
    return low, low + 2.0 * span


class ConstantSpeeds(MotionFamily):
    """Constant speeds of one joint at many levels in both directions."""

    name = "constant_speeds"
    words = "{joint} at constant speeds from slow to fast, both ways; the other joints rest"
    levels, passes_s = 9, 0.8

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append two passes at every speed; each third of the levels reaches from slow to fast."""
        low, high = ends(path, joint, size)
        middle, shares = 0.5 * (low + high), np.geomspace(SLOWEST, 1.0, self.levels)
        path.joint_to(joint, middle, 0.3)
        for share in np.concatenate([shares[k::3] for k in range(3)]):
            reached = min(float(share * path.reach.velocity[joint]) * self.passes_s, high - low)
            start = path.at[joint]
            way = reached if start + reached <= high else -reached
            path.joint_to(joint, start + way, float(share))
            path.joint_to(joint, start, float(share))
            path.joint_to(joint, low if start > middle else high, 0.7)


class SlowPoses(MotionFamily):
    """Slow approach of poses from both sides, with holds."""

    name = "slow_poses"
    words = "{joint} slowly to poses over its range from both sides, with holds; the other joints rest"
    sizes = (0.25, 0.45)
    poses, sweep_s, hold_s = 5, 3.5, 0.2

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append three sweeps over the range, forth, back and forth."""
        low, high = ends(path, joint, size)
        speed = min(0.3, (high - low) / self.sweep_s / float(path.reach.velocity[joint]))
        path.joint_to(joint, low, 0.5)
        for sweep in range(3):
            poses = np.linspace(low, high, self.poses)
            for pose in (poses if sweep % 2 == 0 else poses[::-1])[1:]:
                path.joint_to(joint, float(pose), speed, self.hold_s)


class Reversals(MotionFamily):
    """Reversals of small and growing amplitude."""

    name = "reversals"
    words = "{joint} to and fro with amplitudes from small to large; the other joints rest"
    sizes = (0.02, 0.1)
    amplitudes = 6

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append two cycles of every amplitude; each third of them reaches from small to large."""
        middle = 0.5 * sum(ends(path, joint, size))
        largest = size * path.reach.range[joint]
        path.joint_to(joint, middle, 0.3)
        sizes = np.geomspace(0.02, 1.0, self.amplitudes)
        for share in np.concatenate([sizes[[0, 3]], sizes[[1, 5]], sizes[[2, 4]]]):
            for side in (1.0, -1.0, 1.0, -1.0):
                path.joint_to(joint, middle + side * float(share) * largest, 0.3)


class Steps(MotionFamily):
    """Small hard steps of one joint."""

    name = "steps"
    words = "small steps of {joint} with the largest acceleration; the other joints rest"
    sizes = (0.01, 0.05)

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append three rounds of steps of different sizes, with rests of different length."""
        middle, step = 0.5 * sum(ends(path, joint, size)), size * path.reach.range[joint]
        path.joint_to(joint, middle, 0.3, 0.2)
        for part in range(3):
            for share, dwell in ((1.0, 0.3), (-0.5, 0.1), (0.6, 0.0), (-1.0, 0.2), (0.3, 0.05), (-0.2, 0.0)):
                path.joint_to(joint, middle + share * (1.0 - 0.2 * part) * step, 1.0, dwell)


class OtherLoads(MotionFamily):
    """The same motion of a joint with the other joints in other postures."""

    name = "other_loads"
    words = "{joint} through the same motion with the other joints in three postures"
    away = 0.3

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append sweeps of the joint in each posture, three rounds."""
        low, high = ends(path, joint, size)
        for part in range(3):
            for side in (0.0, self.away, -self.away):
                point = path.reach.home + side * path.reach.range
                point[joint] = low
                path.to(point, 0.7)
                path.joint_to(joint, high, 0.9 - 0.3 * part)


class TwoJoints(MotionFamily):
    """Two joints together, against each other and alone."""

    name = "two_joints"
    words = "{joint} and {other} together, against each other, and each alone"
    pairs = True

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append three rounds at different speeds."""
        first, second = ends(path, joint, size), ends(path, other, size)
        for speed in (0.4, 0.9, 0.6):
            for one, two in ((1, 1), (0, 0), (0, 1), (1, 0), (0, 0), (1, 0), (0, 0), (0, 1), (0, 0)):
                point = path.at.copy()
                point[joint], point[other] = first[one], second[two]
                path.to(point, speed)


class LongRun(MotionFamily):
    """The same motion for a minute, a pause, and the motion again."""

    name = "long_run"
    words = "{joint} through the same fast motion for most of a minute, a pause, and the motion again"
    sizes = (0.25,)
    run_s, pause_s = 40.0, 15.0

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append sweeps, a rest, and sweeps for half the time."""
        low, high = ends(path, joint, size)
        for seconds, pause in ((self.run_s, self.pause_s), (0.5 * self.run_s, 0.0)):
            begin = sum(move.duration + move.dwell for move in path.moves)
            while sum(move.duration + move.dwell for move in path.moves) - begin < seconds:
                path.joint_to(joint, high)
                path.joint_to(joint, low)
            path.joint_to(joint, low, dwell=pause)


FAMILIES: tuple[MotionFamily, ...] = (
    ConstantSpeeds(), SlowPoses(), Reversals(), Steps(), OtherLoads(), TwoJoints(), LongRun(),
)  # fmt: skip
"""Families of motions of single joints; the fast excitation of all joints is designed by `excitation.design`."""
