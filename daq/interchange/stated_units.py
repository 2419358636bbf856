"""Units of a table whose column names have none: stated by the user, or suspected by the magnitude of the values."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.daq.interchange.column_units import SCALES
from armident.daq.interchange.lerobot import FULL, calibrated
from armident.daq.interchange.table_rows import TableRows
from armident.daq.recording.model import Quantity

CHOICES: Mapping[str, tuple[str, ...]] = {
    "position": ("deg", "mm", "deg|mm"),
    "torque": ("mnm",),
    "current": ("ma",),
    "voltage": ("mv",),
}
"""Units that an option can state, besides SI; a demand has the unit of the positions."""
_POSITIONS: tuple[Quantity, ...] = ("position", "demand")

MOST = {"position": 1.2, "torque": 1.5}
"""Largest values over the limit of a joint that are plausible; limits of position are often rounded, peak torques above
the rated ones. The same shares are in `armident.identify.setup.plausible`."""

LEAST = {"position": 1e-3, "torque": 0.02}
"""Smallest peaks over the limit that make a unit plausible: friction and gravity take more than 2 % of the torque."""

SUSPICIOUS = 3.0
"""Peaks beyond this multiple of the limit are in another unit: no arm moves or pushes three times beyond its limits."""

Floats = NDArray[np.float64]


def in_si(rows: TableRows, robot: RobotConfig, units: Mapping[str, str]) -> TableRows:
    """Rows in SI units, from those by quantity (`CHOICES`); ``deg`` is of revolute, ``mm`` of prismatic joints.

    The unit of positions may be a file: the calibration of LeRobot whose ranges they are shares of.
    """
    values = dict(rows.values)
    notes = list(rows.notes)
    for quantity, unit in units.items():
        if quantity == "position" and unit.lower().endswith(".json"):
            factors, offsets = calibrated(Path(unit), rows.labels["position"], robot)
            most = float(np.abs(rows.values["position"]).max())
            if most > FULL:
                raise DataError(f"--units position={unit}: positions reach {most:.4g}, but shares of a range only 100")
            values |= {name: values[name] * factors + offsets for name in _POSITIONS if name in values}
            notes.append(f"position taken as shares of the ranges in {Path(unit).name} (--units): 0 is their middle")
            continue
        if unit not in CHOICES.get(quantity, ()):
            known = "; ".join(f"{name}={' or '.join(choices)}" for name, choices in CHOICES.items())
            raise ConfigError(f"--units: no unit {quantity}={unit}; expected {known}; position=FILE.json of LeRobot")
        factors = _factors(robot, unit)
        concerned = _POSITIONS if quantity == "position" else (cast(Quantity, quantity),)
        for name in concerned:
            if name in values:
                values[name] = values[name] * factors
        notes.append(f"{quantity} taken in {unit} (--units)")
    return replace(rows, values=values, notes=tuple(notes))


def _factors(robot: RobotConfig, unit: str) -> Floats:
    """Factors (n,) from a unit to SI by joint."""
    parts = unit.split("|")
    factors = np.ones(robot.n)
    for part in parts:
        kind = {"deg": "revolute", "mm": "prismatic"}.get(part)
        concerned = np.array([kind in (None, joint.type) for joint in robot.joints])
        factors[concerned] *= SCALES[part]
    return factors


def suspected(rows: TableRows, robot: RobotConfig) -> dict[str, str]:
    """Units by magnitude: those in which values beyond the limits of the joints are within them."""
    found: dict[str, str] = {}
    limits = np.array([max(abs(end) for end in joint.limits.position) for joint in robot.joints])
    revolute = np.array([joint.type == "revolute" for joint in robot.joints])
    words = [
        unit
        for unit, joints in (("deg", revolute), ("mm", ~revolute))
        if _scaled_fits(rows.values["position"][:, joints], limits[joints], SCALES[unit], "position")
    ]
    if words:
        found["position"] = "|".join(words)
    torque = rows.values.get("torque")
    most = np.array([joint.limits.torque for joint in robot.joints])
    if torque is not None and _scaled_fits(torque, most, SCALES["mnm"], "torque"):
        found["torque"] = "mnm"
    return found


def _scaled_fits(values: Floats, limits: Floats, scale: float, quantity: str) -> bool:
    """Return True if values exceed limits by far, and are plausible after scaling."""
    known = np.isfinite(limits)
    if not known.any():
        return False
    ratios = np.abs(values).max(axis=0)[known] / limits[known]
    return bool(
        ratios.max() > SUSPICIOUS and scale * ratios.max() <= MOST[quantity] and scale * ratios.max() >= LEAST[quantity]
    )
