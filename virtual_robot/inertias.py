"""Link parameters of the virtual arms; those of the TX40 are physically consistent and agree with table B.4.

Table B.4 has fourteen essential base values; the links need sixty. A semidefinite programme keeps pseudo-inertias
positive definite (Wensing, Kim, Slotine 2018), meets the values, and keeps others small. Regenerate: ``python -m
armident.virtual_robot.inertias``.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import clarabel as untyped_clarabel
import numpy as np
import yaml
from scipy import sparse

from armident.arrays import Array
from armident.configs import ArmidentError, ConfigError, RobotConfig
from armident.configs.yaml_loader import is_file

HERE = Path(__file__).parent
clarabel: Any = untyped_clarabel
JOINTS = 6
INERTIAL = ("xx", "xy", "xz", "yy", "yz", "zz", "mx", "my", "mz", "m")
D3, R3, R4 = 0.225, 0.035, 0.225
"""Lengths of table B.1, m."""

ESSENTIAL: dict[str, float] = {
    "zz1r": 1.24, "xx2r": -0.48, "xz2r": -0.16, "zz2r": 1.09, "mx2r": 2.21, "my3r": -0.60, "ia3": 0.09,
    "mx4": -0.02, "ia4": 0.03, "my5r": -0.03, "ia5": 0.04, "ia6": 0.01,
}  # fmt: skip
"""Table B.4, met exactly: kg m^2, kg m."""

WITHIN_STD: dict[str, tuple[float, float]] = {"xx3r": (0.13, 0.13 * 0.106), "zz3r": (0.11, 0.11 * 0.0957)}
"""Table B.4, value and standard deviation; met within one standard deviation, as a rigid link 3 needs xx3r < zz3r."""

FRICTION: dict[str, float] = {
    "fv1": 8.00, "fc1": 7.34, "fv2": 5.50, "fc2": 8.24, "fv3": 1.93, "fc3": 6.48,
    "fv4": 1.09, "fc4": 2.57, "fv5": 1.79, "fc5": 3.07, "fv6": 0.65, "fc6": 0.30,
    "fvm6": 0.61, "fcm6": 1.90,
}  # fmt: skip
"""Table B.4: N m s/rad, N m."""

IAM6 = 0.002
"""Coupling inertia, kg m^2; absent from table B.4, so not significantly different from zero in its experiment."""

REST = (0.0, 0.0, 1.5708, 0.0, 0.0, 0.0)
"""Posture at power-on, rad: forearm at a right angle."""

NOMINAL_MASS = (6.0, 6.0, 5.0, 1.6, 0.6, 0.2)
"""Preferred masses of the links, kg: 27 kg of the arm less its base."""
GYRATION_RADIUS = 0.08
"""Preferred radius of gyration, m."""
MASS_TOTAL = (17.0, 22.0)
"""Range of the total mass of the links, kg."""
SECOND_MOMENT_MARGIN = (1e-3, 1e-3, 5e-4, 5e-5, 2e-5, 1e-5)
"""Smallest second moment above the singular pseudo-inertia by link, kg m^2."""
MASS_MARGIN = 0.02
"""Smallest mass above the singular pseudo-inertia, kg."""


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


def pseudo_inertia(standard: Mapping[str, float], link: int) -> Array:
    """Pseudo-inertia (4, 4) of link 1, ...: positive definite for a real body (Wensing, Kim, Slotine 2018)."""
    xx, xy, xz, yy, yz, zz, mx, my, mz, m = (standard[f"{k}{link}"] for k in INERTIAL)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    out = np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = mx, my, mz
    out[3, 3] = m
    return out


def solve_inertias() -> dict[str, float]:
    """Standard parameters that meet table B.4 (kg, kg m, kg m^2); raises ArmidentError without a solution."""
    names = [f"{k}{j}" for j in range(1, JOINTS + 1) for k in INERTIAL] + [f"ia{j}" for j in range(1, JOINTS + 1)]
    at = {name: k for k, name in enumerate(names)}

    def row(terms: Mapping[str, float]) -> Array:
        out = np.zeros(len(names))
        for name, factor in terms.items():
            out[at[name]] = factor
        return out

    groups = regrouping()
    equal = np.array([row(groups[name]) for name in ESSENTIAL])
    within = np.array([row(groups[name]) for name in WITHIN_STD])
    value, std = np.array(list(WITHIN_STD.values())).T
    total = row({f"m{j}": 1.0 for j in range(1, JOINTS + 1)})
    rotors = np.array([row({f"ia{j}": 1.0}) for j in range(1, JOINTS + 1)])
    below = np.vstack([within, -within, total[None], -total[None], -rotors])
    bound = np.concatenate(
        [value + std, std - value, [MASS_TOTAL[1], -MASS_TOTAL[0]], np.full(JOINTS, -0.5 * ESSENTIAL["ia6"])]
    )

    matrices, offsets, cones = [equal, below], [np.array(list(ESSENTIAL.values())), bound], []
    cones = [clarabel.ZeroConeT(len(equal)), clarabel.NonnegativeConeT(len(below))]
    for link in range(1, JOINTS + 1):
        lmi = np.zeros((10, len(names)))
        for k in INERTIAL:
            unit = {f"{i}{link}": float(i == k) for i in INERTIAL}
            lmi[:, at[f"{k}{link}"]] = _triangle(pseudo_inertia(unit, link))
        margin = SECOND_MOMENT_MARGIN[link - 1]
        matrices.append(-lmi)
        offsets.append(-_triangle(np.diag([margin, margin, margin, MASS_MARGIN])))
        cones.append(clarabel.PSDTriangleConeT(4))

    quadratic = np.zeros((len(names), len(names)))
    linear = np.zeros(len(names))

    def prefer(direction: Array, target: float, scale: float) -> None:
        nonlocal quadratic, linear
        quadratic += np.outer(direction, direction) / scale**2
        linear -= direction * target / scale**2

    for name, terms in groups.items():
        if name not in ESSENTIAL and name not in WITHIN_STD:
            prefer(row(terms), 0.0, 1e-3)
    for direction, centre, spread in zip(within, value, std, strict=True):
        prefer(direction, centre, spread)
    for link, mass in enumerate(NOMINAL_MASS, 1):
        prefer(row({f"m{link}": 1.0}), mass, mass)
        for k in ("xy", "xz", "yz", "mx", "my", "mz"):
            prefer(row({f"{k}{link}": 1.0}), 0.0, 1.0)
        for k in ("xx", "yy", "zz"):
            prefer(row({f"{k}{link}": 1.0}), mass * GYRATION_RADIUS**2, 1.0)

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(quadratic)), linear,
        sparse.csc_matrix(np.vstack(matrices)), np.concatenate(offsets), cones, settings,
    ).solve()  # fmt: skip
    if str(solution.status) != "Solved":
        raise ArmidentError(f"no link parameters meet table B.4: solver status {solution.status}")
    return {name: float(x) for name, x in zip(names, solution.x, strict=True)}


def _triangle(matrix: Array) -> Array:
    """Upper triangle column by column, off-diagonals times sqrt(2): an isometry, as the solver expects."""
    return np.array([matrix[i, j] * (1.0 if i == j else np.sqrt(2.0)) for j in range(4) for i in range(j + 1)])


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


def main() -> None:
    """Solve and write the data file of the virtual TX40."""
    parameters = solve_inertias() | {f"off{j}": 0.0 for j in range(1, JOINTS + 1)} | FRICTION | {"iam6": IAM6}
    lines = [
        "# Standard parameters of the virtual TX40, joint side, SI. From python -m armident.virtual_robot.inertias",
        "# Inertias about the frame origins (MDH frames of table B.1); friction of table B.4.",
        f"rest: [{', '.join(f'{x:.6g}' for x in REST)}]  # posture at power-on, rad",
        "parameters:",
    ]
    lines += [f"  {name}: {value:.12g}" for name, value in parameters.items()]
    (HERE / "tx40_inertias.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
