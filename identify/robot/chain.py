"""Constant arrays of the kernels: geometry of the chain, columns of the regressor, values of the parameters."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armident.compiled import structure
from armident.configs import RobotConfig

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

INERTIAL = ("xx", "xy", "xz", "yy", "yz", "zz", "mx", "my", "mz", "m")
"""Inertial parameters of a link, in the order of the columns (thesis equation 2.6)."""


@structure("f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], b1[::1], f8[::1]")
class Chain(NamedTuple):
    """Geometry of a serial chain in modified Denavit-Hartenberg notation (thesis section 2.1.1); m, rad.

    Arrays (n,), ``theta`` at position zero; ``gravity`` (3,) in the base frame, m/s^2.
    """

    cos_alpha: Floats
    sin_alpha: Floats
    d: Floats
    theta: Floats
    r: Floats
    prismatic: NDArray[np.bool_]
    gravity: Floats


@structure("i8[:, ::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[:, ::1], i8[:, ::1]")
class Columns(NamedTuple):
    """Regressor column of each parameter; -1 for a parameter without one.

    ``inertial`` (n, 10): in the order `INERTIAL`. ``coupling_joints`` (c, 2): indices of the joints of each coupling.
    ``coupling`` (c, 3): its inertia, viscous and Coulomb friction (thesis equation B.1). The others are (n,).
    """

    inertial: Ints
    ia: Ints
    fv: Ints
    fc: Ints
    off: Ints
    coupling_joints: Ints
    coupling: Ints


@structure("f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[::1], i8[:, ::1], f8[:, ::1], f8[::1]")
class Values(NamedTuple):
    """Parameter values in SI units, with the shapes of `Columns`.

    ``smoothing``: ``g`` of each joint's smoothed sign (n,), s/rad or s/m; a coupling has the smaller of its joints.
    """

    inertial: Floats
    ia: Floats
    fv: Floats
    fc: Floats
    off: Floats
    coupling_joints: Ints
    coupling: Floats
    smoothing: Floats


def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle in rad, with exact zeros and ones at multiples of a right angle."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return (round(c), float(round(s))) if min(abs(c), abs(s)) < 1e-12 else (c, s)


def chain_of(robot: RobotConfig) -> Chain:
    """Geometry arrays of the chain of a robot configuration."""
    angles = np.array([cos_sin(j.mdh.alpha) for j in robot.joints], dtype=np.float64)
    return Chain(
        cos_alpha=angles[:, 0].copy(),
        sin_alpha=angles[:, 1].copy(),
        d=np.array([j.mdh.d for j in robot.joints]),
        theta=np.array([j.mdh.theta for j in robot.joints]),
        r=np.array([j.mdh.r for j in robot.joints]),
        prismatic=np.array([j.type == "prismatic" for j in robot.joints]),
        gravity=np.array(robot.gravity),
    )


def standard_names(robot: RobotConfig) -> tuple[str, ...]:
    """Names of the standard parameters: 14 per link (13 without rotor inertia), then 3 per coupling."""
    names: list[str] = []
    for k, joint in enumerate(robot.joints, start=1):
        kinds = [*INERTIAL, *(["ia"] if joint.rotor_inertia else []), "fv", "fc", "off"]
        names += [f"{kind}{k}" for kind in kinds]
    for coupling in robot.couplings:
        names += [f"{kind}{coupling.name}" for kind in ("ia", "fv", "fc")]
    return tuple(names)


def columns_of(robot: RobotConfig, names: tuple[str, ...]) -> Columns:
    """Column numbers of the standard parameters in the list ``names``; -1 for those that it lacks."""
    where = {name: k for k, name in enumerate(names)}
    joints = range(1, robot.n + 1)
    index = {joint.name: k for k, joint in enumerate(robot.joints)}

    def per_joint(kind: str) -> Ints:
        return np.array([where.get(f"{kind}{k}", -1) for k in joints], dtype=np.int64)

    return Columns(
        inertial=np.stack([per_joint(kind) for kind in INERTIAL], axis=1),
        ia=per_joint("ia"),
        fv=per_joint("fv"),
        fc=per_joint("fc"),
        off=per_joint("off"),
        coupling_joints=np.array(
            [[index[joint] for joint in c.joints] for c in robot.couplings], dtype=np.int64
        ).reshape(-1, 2),
        coupling=np.array(
            [[where.get(f"{kind}{c.name}", -1) for kind in ("ia", "fv", "fc")] for c in robot.couplings],
            dtype=np.int64,
        ).reshape(-1, 3),
    )


def values_of(columns: Columns, theta: Floats, smoothing: Floats) -> Values:
    """Parameter values by kind from a vector of SI units; 0 without a column, further elements are not used."""
    padded = np.append(np.asarray(theta, dtype=np.float64), 0.0)
    return Values(
        inertial=padded[columns.inertial],
        ia=padded[columns.ia],
        fv=padded[columns.fv],
        fc=padded[columns.fc],
        off=padded[columns.off],
        coupling_joints=columns.coupling_joints,
        coupling=padded[columns.coupling],
        smoothing=smoothing,
    )


def link_frames(chain: Chain, q: Floats) -> Floats:
    """Frames of the links in frame 0, which is the first one, at postures (N, n): (N, n + 1, 4, 4)."""
    n, frames = chain.d.size, np.tile(np.eye(4), (q.shape[0], chain.d.size + 1, 1, 1))
    for j in range(n):
        theta = chain.theta[j] + (0.0 if chain.prismatic[j] else q[:, j])
        r = chain.r[j] + (q[:, j] if chain.prismatic[j] else 0.0)
        c, s, ca, sa = np.cos(theta), np.sin(theta), chain.cos_alpha[j], chain.sin_alpha[j]
        step = frames[:, j + 1]
        step[:, 0, 0], step[:, 0, 1], step[:, 0, 3] = c, -s, chain.d[j]
        step[:, 1, 0], step[:, 1, 1], step[:, 1, 2], step[:, 1, 3] = ca * s, ca * c, -sa, -sa * r
        step[:, 2, 0], step[:, 2, 1], step[:, 2, 2], step[:, 2, 3] = sa * s, sa * c, ca, ca * r
        frames[:, j + 1] = frames[:, j] @ step
    return frames
