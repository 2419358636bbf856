"""Single mistakes of a set-up, each as the correction that it needs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.effects.wiring import raw_scales
from armident.identify.setup.fit import Hypothesis

DEGREES = np.pi / 180.0
THOUSANDTH = 1e-3

LEAST_SPREAD = 0.01
"""Least spread of the logarithms of rated torques: equal ones make per mille a common factor."""


@dataclass(frozen=True)
class Move:
    """One mistake; all members of a ``family`` share its prior probability.

    ``position``, ``torque`` (n, n) multiply the corrections. ``drives``: raw numbers and scales of drives exchanged.
    """

    family: str
    words: str
    position: Array | None = None
    torque: Array | None = None
    drives: bool = False

    def __call__(self, h: Hypothesis) -> Hypothesis:
        """Return the hypothesis with this mistake corrected, too."""
        position = h.position if self.position is None else self.position @ h.position
        torque = h.torque if self.torque is None else self.torque @ h.torque
        return replace(h, position=position, torque=torque)


def sign_moves(robot: RobotConfig, joints: Sequence[int]) -> Iterator[Move]:
    """Signals with the wrong sign: of one joint, and of all. ``joints``: indices of the joints that move."""
    for j in joints:
        yield from signs_of(robot, (j,))
    if len(joints) > 1:
        yield from signs_of(robot, range(robot.n), "all joints")


def signs_of(robot: RobotConfig, joints: Sequence[int], where: str = "") -> Iterator[Move]:
    """Wrong signs of some joints: of their positions, of their torques, and of both."""
    turned = np.eye(robot.n)
    turned[list(joints), list(joints)] = -1.0
    where = where or _names(robot, joints)
    yield Move("position_sign", f"position of {where} with the wrong sign", turned, None)
    yield Move("torque_sign", f"torque of {where} with the wrong sign", None, turned)
    yield Move("position_sign", f"position and torque of {where} with the wrong sign", turned, turned)


def set_moves(robot: RobotConfig, joints: Sequence[int]) -> Iterator[Move]:
    """The same mistake of sign, unit or side at every set of two and more joints.

    Joints are coupled: one of such mistakes, corrected alone, may improve nothing.
    """
    for size in range(2, len(joints) + 1):
        for chosen in combinations(joints, size):
            yield from signs_of(robot, chosen)
            yield from _units(robot, chosen)


def exchange_moves(robot: RobotConfig, joints: Sequence[int]) -> Iterator[Move]:
    """Two joints exchanged: as columns in SI units, and as raw numbers of the drives where that differs."""
    names = [joint.name for joint in robot.joints]
    ratios = robot.transmission_matrix
    counts, rated = raw_scales(robot)
    for i, k in combinations(joints, 2):
        swap = np.eye(robot.n)
        swap[[i, k]] = swap[[k, i]]
        pairs: list[tuple[str, Array, Array]] = [("columns", swap, swap)]
        at_drives = np.asarray(np.linalg.solve(ratios, (swap * counts[:, None] / counts) @ ratios), np.float64)
        of_drives: Array = ratios.T @ (swap * rated[:, None] / rated) @ np.linalg.inv(ratios.T)
        if not (np.allclose(at_drives, swap, rtol=1e-3) and np.allclose(of_drives, swap, rtol=1e-3)):
            pairs.append(("drives", at_drives, of_drives))
        for what, position, torque in pairs:
            where = f"{names[i]} and {names[k]}" + (" (raw numbers of the drives)" if what == "drives" else "")
            raw = what == "drives"
            yield Move("exchange", f"torques of {where} exchanged", None, torque, raw)
            yield Move("exchange", f"positions of {where} exchanged", position, None, raw)
            yield Move("exchange", f"positions and torques of {where} exchanged", position, torque, raw)


def unit_moves(robot: RobotConfig) -> Iterator[Move]:
    """Units and sides of a whole signal."""
    n, ratios = robot.n, robot.transmission_matrix
    inverse = np.asarray(np.linalg.inv(ratios), np.float64)
    yield from _position_unit_moves(robot)
    yield Move("torque_unit", "the torques are 1000 times too small (kN m for N m, or A for mA)", None, 1e3 * np.eye(n))
    yield Move("torque_unit", "the torques are 1000 times too large (mN m for N m, mA for A)", None, 1e-3 * np.eye(n))
    if np.abs(ratios - np.eye(n)).max() > 1e-9:
        for what, places in (("torques", (False, True)), ("positions", (True, False)), ("signals", (True, True))):
            yield Move(
                "side", f"the {what} are those of the motors, not of the joints", *_where(places, inverse, ratios.T)
            )
            words = f"the {what} are those of the joints, and were converted as those of the motors"
            yield Move("side", words, *_where(places, ratios, inverse.T))
    _, rated = raw_scales(robot)
    if np.ptp(np.log(rated)) > LEAST_SPREAD:
        share = ratios.T @ np.diag(rated / 1000.0)
        yield Move("torque_unit", "the torques are in per mille of the rated torque", None, share @ inverse.T)
        yield Move("torque_unit", "the torques are the motors', in per mille of the rated torque", None, share)


def _position_unit_moves(robot: RobotConfig) -> Iterator[Move]:
    """Positions of all joints of a type, and of all joints, in a smaller unit."""
    types = [joint.type for joint in robot.joints]
    present = sorted(set(types))
    groups = [present, *([one] for one in present if len(present) > 1 and types.count(one) > 1)]
    for chosen in groups:
        factors = [_unit(one)[0] if one in chosen else 1.0 for one in types]
        units = " and ".join(_unit(one)[1] for one in chosen)
        words = "the positions" if chosen == present else f"the positions of the {chosen[0]} joints"
        yield Move("position_unit", f"{words} are in {units}", np.diag(factors), None)


def _where(places: tuple[bool, bool], position: Array, torque: Array) -> tuple[Array | None, Array | None]:
    return position if places[0] else None, torque if places[1] else None


def single_unit_moves(robot: RobotConfig, joints: Sequence[int]) -> Iterator[Move]:
    """Unit or side of one joint's signal. ``joints``: indices of the joints that move."""
    for j in joints:
        yield from _units(robot, (j,))


def _units(robot: RobotConfig, joints: Sequence[int]) -> Iterator[Move]:
    """The same mistake of unit or side at some joints."""
    chosen, diagonal = list(joints), np.diag(robot.transmission_matrix)
    one, where = len(chosen) == 1, _names(robot, joints)
    position, torque = (f"the {s} of {where} is" if one else f"the {s}s of {where} are" for s in ("position", "torque"))
    units = [_unit(robot.joints[j].type) for j in chosen]

    def at(factors: Sequence[float] | Array) -> Array:
        matrix = np.eye(robot.n)
        matrix[chosen, chosen] = factors
        return matrix

    words = " and ".join(sorted({word for _, word in units}))
    yield Move("position_unit", f"{position} in {words}", at([factor for factor, _ in units]), None)
    yield Move("torque_unit", f"{torque} 1000 times too large", None, at([1e-3] * len(chosen)))
    yield Move("torque_unit", f"{torque} 1000 times too small", None, at([1e3] * len(chosen)))
    ratios = np.asarray(diagonal[chosen], np.float64)
    if np.any(ratios == 0.0) or np.any(np.abs(np.abs(ratios) - 1.0) < 1e-9):
        return
    of_motor = "that of its motor" if one else "those of their motors"
    of_joint = f"{'that of the joint' if one else 'those of the joints'}, and {'was' if one else 'were'} converted as "
    of_joint += "that of the motor" if one else "those of the motors"
    yield Move("side", f"{torque} {of_motor}", None, at(ratios))
    yield Move("side", f"{position} {of_motor}", at(1.0 / ratios), None)
    yield Move("side", f"{position} {of_joint}", at(ratios), None)
    yield Move("side", f"{torque} {of_joint}", None, at(1.0 / ratios))


def _names(robot: RobotConfig, joints: Sequence[int]) -> str:
    *others, last = (robot.joints[j].name for j in joints)
    return f"{', '.join(others)} and {last}" if others else last


def scaled(n: int, joint: int, factor: float) -> Array:
    """Identity (n, n) with a factor at one joint. ``joint``: index of the joint."""
    matrix = np.eye(n)
    matrix[joint, joint] = factor
    return matrix


def _unit(joint_type: str) -> tuple[float, str]:
    """Factor and name of the smaller unit in which positions of a joint type are recorded."""
    return (DEGREES, "degrees") if joint_type == "revolute" else (THOUSANDTH, "mm")
