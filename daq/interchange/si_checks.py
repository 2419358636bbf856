"""Checks of imported values: SI units, side of the gears, and a demand that the joints followed."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.daq.recording import Field

OMITTED = "-"
"""Name with which a quantity of a file is left out."""

_POSITION_FACTOR, _TORQUE_FACTOR = 3.0, 10.0
"""Positions and torques beyond these multiples of the joint's limits are taken as a wrong unit."""

_PLAUSIBLE = 1.5
"""Positions and torques up to this multiple of the joint's limits make a unit plausible."""

_FASTEST = 3.0
"""Velocities beyond this multiple of the joint's limit are taken as a wrong unit."""
PASSED = 1.05
"""Share of a limit that passes it: a limit that is rounded to two digits errs by 5 % at most."""
_WINDOWS = 200
"""Velocities are differences over this part of the recording."""

_MOVED_SHARE = 1e-3
"""Share of its position range that a joint must move for its demand to be checked."""
_UNEXPLAINED_SHARE = 0.5
"""Largest share of the power of a joint's motion that its demand may leave unexplained, where they differ in size."""
_SAME_SIZE = 2.0
"""Ratio of the spans of two motions in one unit: a joint that lags behind fast moves swings less, by half at most."""


_UNSIGNED = "; it is never negative: counts with another zero or sign have to be converted where they are recorded"
"""Hint for a torque whose sign is not known, which no option can convert."""


def si_unit_of(quantity: str, robot: RobotConfig) -> str:
    """Return the SI unit of a quantity (``position``, ``torque``, ...) of a robot's joints, by their types."""
    kinds = {joint.type for joint in robot.joints}
    if quantity in ("position", "demand"):
        return "rad" if kinds == {"revolute"} else "m" if kinds == {"prismatic"} else "rad|m"
    if quantity == "torque":
        return "N m" if kinds == {"revolute"} else "N" if kinds == {"prismatic"} else "N m|N"
    return "A" if quantity == "current" else "V"


def check_units(
    path: Path,
    robot: RobotConfig,
    fields: Mapping[str, Field],
    raw: Mapping[str, NDArray[np.float64]],
    known: slice,
    position_hint: str = "",
) -> None:
    """Refuse positions and torques (N, n) far beyond SI limits, or a demand (``known`` rows) that none followed.

    ``position_hint``: units of positions of the tool, in place of the usual ones.
    """
    transmission = robot.transmission_matrix
    for name, values in raw.items():
        values = values[known] if name == "demand" else values
        motor = fields[name].side == "motor"
        if name in ("position", "demand"):
            joint = values @ np.linalg.inv(transmission).T if motor else values
            limits = [max(abs(end) for end in j.limits.position) for j in robot.joints]
            factor, hint = _POSITION_FACTOR, "rad (or m), joint side unless --motor-side"
        elif name == "torque":
            joint = values @ transmission if motor else values
            limits = [j.limits.torque for j in robot.joints]
            factor, hint = _TORQUE_FACTOR, "N m (or N), joint side unless --motor-side"
        else:
            joint, factor, hint = values, _TORQUE_FACTOR, f"{si_unit_of(name, robot)} of the motor"
            limits = [(j.drive.signal == name and j.drive.saturation) or np.inf for j in robot.joints]
        peaks = np.abs(joint).max(axis=0)
        for axis, column, peak, limit in zip(robot.joints, joint.T, peaks, limits, strict=True):
            if not peak <= factor * limit:
                other = position_hint if name in ("position", "demand") else _UNSIGNED if column.min() >= 0 else ""
                raise DataError(
                    f"{path}: {name} of {axis.name} reaches {peak:.4g}, its limit is {limit:.4g}: expected {hint}"
                    f"{other or _other_unit(name, axis.type, peaks / np.array(limits))}"
                )
    if "demand" in raw:
        _check_demand(path, robot, raw["demand"][known], raw["position"][known])


def _other_unit(name: str, kind: str, shares: NDArray[np.float64]) -> str:
    """Return the units that have to be converted, with the option for one in which all values are plausible.

    ``shares`` (n,): largest values over the limits. Magnitudes alone cannot tell degrees from counts.
    """
    option, factor, others = {
        ("torque", "revolute"): ("torque=mnm", 1e-3, "shares of the rated torque"),
        ("current", kind): ("current=ma", 1e-3, "shares of the rated current"),
        ("position", "revolute"): ("position=deg", np.pi / 180.0, "shares of a range"),
        ("position", "prismatic"): ("position=mm", 1e-3, "shares of a range"),
    }.get((name, kind), ("", 1.0, ""))
    if not option or factor * shares.max() > _PLAUSIBLE:
        return ""
    unit = option.split("=")[1]
    return (
        f"; --units {option} if they are in {unit} at all joints; counts and {others} have to be converted where they "
        "are recorded"
    )


def limit_notes(
    robot: RobotConfig, position: NDArray[np.float64], torque: NDArray[np.float64] | None, rate_hz: float
) -> tuple[str, ...]:
    """Return a sentence on the limits that positions and torques (N, n) pass, if there are any."""
    # An odd number of rows, so that the values of two sources in turn show.
    apart = len(position) // _WINDOWS | 1
    if len(position) <= apart:
        return ()
    limits = np.array([joint.limits.velocity or np.inf for joint in robot.joints])
    speeds = np.quantile(np.abs(position[apart:] - position[:-apart]), 0.99, axis=0) * rate_hz / apart
    fast = [joint.name for joint, share in zip(robot.joints, speeds / limits, strict=True) if share > _FASTEST]
    if fast:
        most = float((speeds / limits).max())
        return (
            f"{', '.join(fast)}: velocities of up to {most:.3g} times the limit; check for positions in degrees "
            "(--units position=deg), times in another unit (--time-unit), or two sources of one joint",
        )
    peaks = np.zeros(robot.n) if torque is None else np.quantile(np.abs(torque), 0.99, axis=0)
    passed = []
    for joint, place, speed, peak in zip(robot.joints, robot.limit_places, speeds, peaks, strict=True):
        revolute = joint.type == "revolute"
        each = [
            f"{limit:.4g} {unit}, reached {value:.3g}"
            for value, limit, unit in (
                (speed, joint.limits.velocity or np.inf, "rad/s" if revolute else "m/s"),
                (peak, joint.limits.torque or np.inf, "N m" if revolute else "N"),
            )
            if value > PASSED * limit
        ]
        if each:
            passed.append(f"{joint.name} {' and '.join(each)}{f' ({place})' if place else ''}")
    if not passed:
        return ()
    return (
        f"the motion passes limits, which are too small if the values are in SI units: {', '.join(passed)}. Correct "
        "them then under joints: limits of the configuration, from which trajectories and exports take them",
    )


def _check_demand(path: Path, robot: RobotConfig, demand: NDArray[np.float64], position: NDArray[np.float64]) -> None:
    """Refuse a demand that does not move like the joints: another unit, or another quantity.

    Of a demand that rests, only if its joint moves like those whose demands move: it may give way to them.
    """
    motion = np.sum((position - position.mean(axis=0)) ** 2, axis=0)
    residual = np.sum((demand - demand.mean(axis=0) - position + position.mean(axis=0)) ** 2, axis=0)
    spans, wished = np.ptp(position, axis=0), np.ptp(demand, axis=0)
    others = float(spans[wished > 0.0].max(initial=0.0))
    for k in np.flatnonzero(residual > _UNEXPLAINED_SHARE * motion):
        joint, moved, wanted = robot.joints[k], spans[k], wished[k]
        checked = moved > max(_MOVED_SHARE * np.ptp(joint.limits.position), 0.0 if wanted else others / _SAME_SIZE)
        if checked and not moved / _SAME_SIZE < wanted < _SAME_SIZE * moved:
            raise DataError(
                f"{path}: {joint.name} moved by {moved:.4g}, but its demand by {wanted:.4g}: "
                f"give both in the same unit, or omit the demand with --map demand={OMITTED}"
            )
