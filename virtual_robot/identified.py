"""Physically consistent parameters of an identified arm, from ``identification.json``."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armident.configs import ConfigError, RobotConfig
from armident.configs.urdf_inertials import INERTIAL


@dataclass(frozen=True)
class Identified:
    """Parameters of an identified arm, remarks, and ``g`` of each joint's smoothed sign, s/rad or s/m, if known."""

    standard: dict[str, float]
    sources: tuple[str, ...]
    sign_smoothing: tuple[float, ...] | None = None


def read_identified(path: Path, robot: RobotConfig) -> Identified:
    """Read the physically consistent parameters of an identification (``--physical``), else raise ConfigError."""
    document = _read(path)
    if document.get("robot") != robot.name:
        raise ConfigError(f"{path}: is of robot {document.get('robot')!r:.80}, the configuration is of {robot.name!r}")
    physical = document.get("physical")
    if not isinstance(physical, dict):
        raise ConfigError(
            f"{path}: has no physically consistent parameters; identify again: armident identify RECORDING --physical"
        )
    values = _values(physical, path)
    joints = range(1, robot.n + 1)
    wanted = [f"{name}{j}" for j in joints for name in (*INERTIAL, "fv", "fc", "off")]
    wanted += [f"ia{j}" for j, joint in zip(joints, robot.joints, strict=True) if joint.rotor_inertia]
    wanted += [f"{name}{coupling.name}" for coupling in robot.couplings for name in ("ia", "fv", "fc")]
    if lacking := [name for name in wanted if name not in values]:
        raise ConfigError(f"{path}: physical.parameters: no {lacking[0]}; identify again with this configuration")
    if massless := [robot.joints[j - 1].name for j in joints if not values[f"m{j}"] > 0.0]:
        raise ConfigError(f"{path}: physical.parameters: no mass moves behind {massless[0]}")
    standard = {f"ia{j}": 0.0 for j in joints} | {name: values[name] for name in wanted}
    sources = [f"parameters: the physically consistent ones of {path}"]
    if physical.get("compatible") is False:
        sources.append(f"they are not those of the estimate: {physical.get('verdict')}")
    if left := sorted(values.keys() - set(wanted)):
        sources.append(f"not played: {', '.join(left)} (effects of the configuration; a scenario can hide effects)")
    return Identified(standard, tuple(sources), _smoothing(document, robot, path))


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or 'input error'}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: is no JSON document; expected an identification.json") from error
    schema = document.get("schema") if isinstance(document, dict) else None
    if not str(schema).startswith("armident/identification/"):
        raise ConfigError(f"{path}: expected an identification.json (schema armident/identification/1)")
    return dict(document)


def _smoothing(document: dict[str, Any], robot: RobotConfig, path: Path) -> tuple[float, ...] | None:
    given = document.get("sign_smoothing")
    if not isinstance(given, dict):
        return None
    try:
        values = tuple(float(given[joint.name]) for joint in robot.joints)
    except (TypeError, KeyError, ValueError) as error:
        raise ConfigError(f"{path}: sign_smoothing: expected a number for each joint") from error
    if not all(math.isfinite(value) and value > 0.0 for value in values):
        raise ConfigError(f"{path}: sign_smoothing: expected positive numbers")
    return values


def _values(physical: dict[str, Any], path: Path) -> dict[str, float]:
    entries = physical.get("parameters")
    try:
        values = {str(entry["name"]): float(entry["value"]) for entry in entries or ()}
    except (TypeError, KeyError, ValueError) as error:
        raise ConfigError(f"{path}: physical.parameters: expected names and values") from error
    if not all(math.isfinite(value) for value in values.values()):
        raise ConfigError(f"{path}: physical.parameters: expected finite values")
    return values
