"""Forward kinematics of every robot of the library beside the table of its maker, in the maker's own form."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import config_path, load_robot
from armident.configs.loading import HERE
from tests.unit.configs.test_urdf import transform

Floats = NDArray[np.float64]
Pose = Callable[[Floats], Floats]
PI, DEG = np.pi, np.pi / 180.0


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Floats:
    frame = np.eye(4)
    frame[:3, 3] = x, y, z
    return frame


def turned(axis: str, angle: float) -> Floats:
    """Rotation about an axis of coordinates by Rodrigues' formula."""
    k = np.eye(3)["xyz".index(axis)]
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    frame = np.eye(4)
    frame[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return frame


def of_quaternion(w: float, x: float, y: float, z: float) -> Floats:
    """Rotation by the sandwich product ``q v q*`` of each unit vector."""
    s, v = w, np.array([x, y, z])
    frame = np.eye(4)
    frame[:3, :3] = np.stack(
        [2 * (v @ e) * v + (s * s - v @ v) * e + 2 * s * np.cross(v, e) for e in np.eye(3)], axis=1
    )
    return frame


def classical(*rows: tuple[float, float, float, float]) -> Pose:
    """Poses of classical Denavit-Hartenberg rows ``theta, d, a, alpha``."""

    def pose(q: Floats) -> Floats:
        frame = np.eye(4)
        for value, (theta, d, a, alpha) in zip(q, rows, strict=True):
            frame = frame @ turned("z", theta + value) @ moved(z=d) @ moved(x=a) @ turned("x", alpha)
        return frame

    return pose


def frames(*rows: tuple[tuple[float, float, float], Floats]) -> Pose:
    """Poses of joint frames ``xyz, rotation`` with the axes along z."""

    def pose(q: Floats) -> Floats:
        frame = np.eye(4)
        for value, (xyz, rotation) in zip(q, rows, strict=True):
            frame = frame @ moved(*xyz) @ rotation @ turned("z", value)
        return frame

    return pose


def ur(d1: float, a2: float, a3: float, d4: float, d5: float, d6: float) -> Pose:
    """Table of Universal Robots, "DH parameters for calculations of kinematics and dynamics"."""
    right = PI / 2
    return classical(
        (0, d1, 0, right), (0, 0, a2, 0), (0, 0, a3, 0), (0, d4, 0, right), (0, d5, 0, -right), (0, d6, 0, 0)
    )


def lightweight(d1: float, d3: float, d5: float, d7: float, sign: float) -> Pose:
    """Arm of KUKA with seven axes that meet in shoulder, elbow and wrist; lengths of its data sheet."""
    turns = sign * PI / 2 * np.array([-1, 1, 1, -1, -1, 1, 0])
    return classical(*[(0.0, d, 0.0, turn) for d, turn in zip((d1, 0, d3, 0, d5, 0, d7), turns, strict=True)])


A2, T2 = np.hypot(0.2845, 0.0535), np.arctan2(0.2845, 0.0535)
POSES: dict[str, Pose] = {
    "ur3e": ur(0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": ur(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": ur(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    # UFACTORY, "Kinematic and Dynamic Parameters of xArm 6", standard parameters.
    "xarm6": classical(
        (0, 0.267, 0, -PI / 2), (-T2, 0, A2, 0), (T2, 0, 0.0775, -PI / 2),
        (0, 0.3425, 0, PI / 2), (0, 0, 0.076, -PI / 2), (0, 0.097, 0, 0),
    ),
    # Kinova Gen3 user guide, classical parameters, rounded to 0.1 mm; the first row turns the base.
    "kinova_gen3": lambda q: turned("x", PI) @ classical(
        (0, -(0.1564 + 0.1284), 0, PI / 2), (PI, -(0.0054 + 0.0064), 0, PI / 2), (PI, -(0.2104 + 0.2104), 0, PI / 2),
        (PI, -(0.0064 + 0.0064), 0, PI / 2), (PI, -(0.2084 + 0.1059), 0, PI / 2), (PI, 0, 0, PI / 2),
        (PI, -(0.1059 + 0.0615), 0, PI),
    )(q),
    "iiwa14": lightweight(0.36, 0.42, 0.4, 0.126, 1),
    # The positions of the LWR4+ in its URDF turn shoulder, elbow and wrist the other way.
    "kuka_lwr4": lightweight(0.3105, 0.4, 0.39, 0.078, -1),
    # Joint frames of the maker's URDF (franka_description).
    "panda": frames(
        ((0, 0, 0.333), np.eye(4)), ((0, 0, 0), turned("x", -PI / 2)), ((0, -0.316, 0), turned("x", PI / 2)),
        ((0.0825, 0, 0), turned("x", PI / 2)), ((-0.0825, 0.384, 0), turned("x", -PI / 2)),
        ((0, 0, 0), turned("x", PI / 2)), ((0.088, 0, 0), turned("x", PI / 2)),
    ),
    # Arm lengths of the maker's data sheet: 225 and 225 mm, shoulder offset 35 mm, flange 65 mm; upright at zero.
    "tx40": classical(
        (0, 0, 0, -PI / 2), (-PI / 2, 0, 0.225, 0), (PI / 2, 0.035, 0, PI / 2),
        (0, 0.225, 0, -PI / 2), (0, 0, 0, PI / 2), (PI, 0.065, 0, 0),
    ),
    # Bodies of the maker's MJCF model (so101_new_calib.xml).
    "so101": frames(
        ((0.0388353, 0, 0.0624), of_quaternion(0, 0, -1, 0)),
        ((-0.0303992, -0.0182778, -0.0542), of_quaternion(0.5, -0.5, -0.5, -0.5)),
        ((-0.11257, -0.028, 0), of_quaternion(0.5**0.5, 0, 0, 0.5**0.5)),
        ((-0.1349, 0.0052, 0), of_quaternion(0.5**0.5, 0, 0, -(0.5**0.5))),
        ((0, -0.0611, 0.0181), of_quaternion(0.0172091, -0.0172091, 0.706897, 0.706897)),
    ),
}  # fmt: skip
"""Pose of the flange in the base of the maker's table, of the positions that the maker counts."""

BASES = {
    "kinova_gen3": turned("x", PI),
    "so101": moved(0.0388353, 0, -0.0324817) @ turned("z", PI / 2) @ turned("x", PI),
}
"""Frame 0 in the base of the maker's table, where it is not that base."""

WRITTEN = 2e-6
"""Largest deviation of poses whose tables have six or more digits, m and rad."""

ROUNDED = {"kinova_gen3": 1e-3}
"""Largest deviation of poses whose table is rounded: seven lengths of 0.1 mm and more, m."""


@pytest.mark.parametrize("name", POSES)
def test_the_flange_moves_as_the_table_of_the_maker_says(name: str) -> None:
    robot, pose, base = load_robot(name), POSES[name], BASES.get(name, np.eye(4))
    zero = np.zeros(robot.n)
    # The flange is fixed to the last frame: its place there follows from one pose, and holds at all others.
    flange = np.linalg.inv(base @ transform(robot, zero)) @ pose(zero)
    rng = np.random.default_rng(len(name))
    low, high = np.array([joint.limits.position for joint in robot.joints]).T
    for q in rng.uniform(low, high, (50, robot.n)):
        difference = base @ transform(robot, q) @ flange - pose(q)
        assert np.abs(difference).max() < ROUNDED.get(name, WRITTEN)


@pytest.mark.parametrize("name", POSES)
def test_gravity_points_down_in_the_base_of_the_maker(name: str) -> None:
    down = np.linalg.inv(BASES.get(name, np.eye(4)))[:3, :3] @ [0.0, 0.0, -9.81]
    assert load_robot(name).gravity == pytest.approx(tuple(down), abs=1e-9)


@pytest.mark.parametrize("name", POSES)
def test_a_robot_of_the_library_can_be_moved(name: str) -> None:
    robot = load_robot(name)
    robot.check_movable()
    assert robot.blanks == ()
    assert config_path(name).read_text(encoding="utf-8").startswith("# ")


def test_the_library_has_ten_arms_and_each_is_checked() -> None:
    shipped = {path.stem for path in (HERE / "robots").glob("*.yaml")}
    assert shipped - {"emps"} == set(POSES)
    assert len(POSES) >= 10
