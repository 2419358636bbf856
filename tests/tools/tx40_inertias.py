"""Data file of the virtual TX40: physically consistent links that agree with table B.4 of the thesis.

Table B.4 has fourteen essential base values; the links need sixty. A semidefinite programme keeps pseudo-inertias
positive definite (Wensing, Kim, Slotine 2018), meets the values, and keeps others small.
``python -m tests.tools.tx40_inertias`` writes ``virtual_robot/tx40_inertias.yaml``.
"""

from collections.abc import Mapping
from typing import Any

import clarabel as untyped_clarabel
import numpy as np
from scipy import sparse

from armident.arrays import Array
from armident.configs import ArmidentError
from armident.configs.urdf_inertials import INERTIAL
from armident.virtual_robot.inertias import HERE, JOINTS, regrouping

clarabel: Any = untyped_clarabel

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


def main() -> None:
    """Solve and write the data file of the virtual TX40."""
    parameters = solve_inertias() | {f"off{j}": 0.0 for j in range(1, JOINTS + 1)} | FRICTION | {"iam6": IAM6}
    lines = [
        "# Standard parameters of the virtual TX40, joint side, SI. From python -m tests.tools.tx40_inertias",
        "# Inertias about the frame origins (MDH frames of table B.1); friction of table B.4.",
        f"rest: [{', '.join(f'{x:.6g}' for x in REST)}]  # posture at power-on, rad",
        "parameters:",
    ]
    lines += [f"  {name}: {value:.12g}" for name, value in parameters.items()]
    (HERE / "tx40_inertias.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
