"""Random serial chains as URDF, and where our link frames sit in theirs."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs.mdh import MdhChain
from armident.configs.urdf_origin import rotation
from armident.configs.urdf_tree import UrdfJoint

Floats = NDArray[np.float64]


def random_urdf(rng: np.random.Generator, n: int, right_angles: bool) -> str:
    """A chain of n moving joints with fixed ones between and beside them, every link a box of a few kilograms.

    With ``right_angles`` frames turn by right angles, axes lie along x, y or z, and many distances are zero: parallel,
    intersecting and coincident axes.
    """

    def numbers(values: object) -> str:
        return " ".join(repr(float(v)) for v in np.atleast_1d(np.asarray(values)))

    def origin() -> str:
        xyz, rpy = rng.uniform(-0.5, 0.5, 3), rng.uniform(-np.pi, np.pi, 3)
        if right_angles:
            xyz, rpy = xyz * (rng.random(3) < 0.4), rng.choice([0.0, 0.0, np.pi / 2, -np.pi / 2, np.pi], 3)
        return f'<origin xyz="{numbers(xyz)}" rpy="{numbers(rpy)}"/>'

    def link(name: str) -> str:
        sides = rng.uniform(0.05, 0.3, 3) ** 2 / 12
        mass, inertia = rng.uniform(0.5, 5.0), np.diag(sides.sum() - sides)
        turn = rotation(*rng.uniform(-np.pi, np.pi, 3))
        inertia = mass * turn @ inertia @ turn.T
        cells = " ".join(
            f'i{"xyz"[i]}{"xyz"[j]}="{float(inertia[i, j])!r}"' for i, j in zip(*np.triu_indices(3), strict=True)
        )
        centre = rng.uniform(-0.2, 0.2, 3)
        rpy = rng.uniform(-np.pi, np.pi, 3)
        return (
            f'<link name="{name}"><inertial><mass value="{mass!r}"/>'
            f'<origin xyz="{numbers(centre)}" rpy="{numbers(rpy)}"/><inertia {cells}/></inertial></link>'
        )

    def joint(name: str, kind: str, parent: str, child: str, more: str = "") -> str:
        ends = f'<parent link="{parent}"/><child link="{child}"/>'
        return f'<joint name="{name}" type="{kind}">{origin()}{ends}{more}</joint>'

    parts, parent = [link("base")], "base"
    for k in range(1, n + 1):
        if rng.random() < 0.4:
            parts += [link(f"mount_{k}"), joint(f"fixed_{k}", "fixed", parent, f"mount_{k}")]
            parent = f"mount_{k}"
        axis = rng.normal(size=3)
        if right_angles:
            axis = np.eye(3)[rng.integers(3)] * rng.choice([-1.0, 1.0])
        kind = "prismatic" if rng.random() < 0.3 else rng.choice(["revolute", "continuous"])
        more = f'<axis xyz="{numbers(axis)}"/><limit lower="-3" upper="3" velocity="5" effort="100"/>'
        parts += [link(f"link_{k}"), joint(f"joint_{k}", str(kind), parent, f"link_{k}", more)]
        parent = f"link_{k}"
        if rng.random() < 0.3:
            parts += [link(f"beside_{k}"), joint(f"aside_{k}", "fixed", parent, f"beside_{k}")]
    parts += [link("tool"), joint("flange", "fixed", parent, "tool")]
    return f'<?xml version="1.0"?><robot name="random">{"".join(parts)}</robot>'


def configuration(file: Path, n: int, gravity: Floats) -> str:
    """A robot configuration with the geometry of ``file``, no friction to speak of, positions of the joints."""
    joints = "".join(
        f"- {{name: joint_{k}, limits: {{acceleration: 50.0}}, rotor_inertia: {str(k % 2 == 0).lower()}}}\n"
        for k in range(1, n + 1)
    )
    rows = ", ".join(str([float(i == j) for j in range(n)]) for i in range(n))
    return (
        f"schema: armident/robot/1\nname: random\nurdf: {{file: {file.name}}}\n"
        f"gravity: {gravity.tolist()}\njoints:\n{joints}transmission: [{rows}]\n"
    )


def link_frames(joints: tuple[UrdfJoint, ...], chain: MdhChain) -> Floats:
    """Frames of the URDF's moved links in our link frames, (n, 4, 4)."""
    return np.stack([np.linalg.solve(ours, joint.placement) for joint, ours in zip(joints, chain.frames, strict=True)])
