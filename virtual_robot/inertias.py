"""Stored masses and friction of the virtual TX40 and EMPS, and the base parameters of the TX40 (thesis table B.3)."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import yaml

from armident.configs import ConfigError, RobotConfig
from armident.configs.urdf_inertials import INERTIAL
from armident.configs.yaml_loader import is_file

HERE = Path(__file__).parent
JOINTS = 6
D3, R3, R4 = 0.225, 0.035, 0.225
"""Lengths of table B.1, m."""


def base_parameters(standard: Mapping[str, float]) -> dict[str, float]:
    """Base inertial parameters of the TX40 from standard ones (thesis tables B.2 and B.3), SI; known groups only."""
    groups = {name: terms for name, terms in regrouping().items() if terms.keys() <= standard.keys()}
    return {name: sum(c * standard[k] for k, c in terms.items()) for name, terms in groups.items()}


@cache
def regrouping() -> dict[str, dict[str, float]]:
    """Base inertial parameters as sums of standard ones, ``{base: {standard: factor}}`` (thesis table B.3)."""

    def outer(first: int, factor: float) -> dict[str, float]:
        return {f"m{k}": factor for k in range(first, JOINTS + 1)}

    arm, fore = D3**2, R4**2
    rows: dict[str, dict[str, float]] = {
        "zz1r": {"zz1": 1, "ia1": 1, "yy2": 1, "yy3": 1, "mz3": 2 * R3, **outer(3, R3**2 + arm)},
        "xx2r": {"xx2": 1, "yy2": -1, **outer(3, -arm)},
        "xz2r": {"xz2": 1, "mz3": -D3, **outer(3, -R3 * D3)},
        "zz2r": {"zz2": 1, "ia2": 1, **outer(3, arm)},
        "mx2r": {"mx2": 1, **outer(3, D3)},
        "xx3r": {"xx3": 1, "yy3": -1, "yy4": 1, "mz4": 2 * R4, **outer(4, fore)},
        "zz3r": {"zz3": 1, "yy4": 1, "mz4": 2 * R4, **outer(4, fore)},
        "my3r": {"my3": 1, "mz4": -1, **outer(4, -R4)},
        "xx4r": {"xx4": 1, "yy4": -1, "yy5": 1},
        "zz4r": {"zz4": 1, "yy5": 1},
        "my4r": {"my4": 1, "mz5": 1},
        "xx5r": {"xx5": 1, "yy5": -1, "yy6": 1},
        "zz5r": {"zz5": 1, "yy6": 1},
        "my5r": {"my5": 1, "mz6": -1},
        "xx6r": {"xx6": 1, "yy6": -1},
    }
    alone = ["xy2", "yz2", "my2", "zz6", "my6"]
    alone += [f"{k}{j}" for j in (3, 4, 5, 6) for k in ("xy", "xz", "yz", "mx", "ia")]
    return rows | {name: {name: 1.0} for name in alone}


@cache
def _stored(path: Path) -> dict[str, float]:
    return {k: float(v) for k, v in yaml.safe_load(path.read_text(encoding="utf-8"))["parameters"].items()}


def has_stored_parameters(robot: RobotConfig) -> bool:
    """Return True if the robot is the virtual TX40 or EMPS by name, joints and couplings."""
    path = HERE / f"{robot.name}_inertias.yaml"
    expected = {f"{k}{j + 1}" for j in range(robot.n) for k in (*INERTIAL, "ia", "fv", "fc", "off")}
    expected |= {f"{k}{c.name}" for c in robot.couplings for k in ("ia", "fv", "fc")}
    return is_file(path) and expected == _stored(path).keys()


def plant_parameters(robot: RobotConfig) -> dict[str, float]:
    """All standard parameters of the virtual TX40 or EMPS, SI; raises ConfigError for other robots."""
    if not has_stored_parameters(robot):
        known = ", ".join(sorted(p.name.removesuffix("_inertias.yaml") for p in HERE.glob("*_inertias.yaml")))
        raise ConfigError(f"robot {robot.name!r}: no stored parameters for these joints (there is: {known})")
    return dict(_stored(HERE / f"{robot.name}_inertias.yaml"))


def rest_posture(robot: RobotConfig) -> tuple[float, ...]:
    """Posture of the virtual arm at power-on, joint side, rad or m, length n. ``robot``: the TX40 or the EMPS."""
    data = yaml.safe_load((HERE / f"{robot.name}_inertias.yaml").read_text(encoding="utf-8"))
    return tuple(float(x) for x in data["rest"])
