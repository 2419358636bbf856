"""Designed trajectories keep links apart, avoid boxes and spare motors whose loads the URDF knows."""

import json
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

import armident
from armident.configs import ConfigError, RobotConfig, load_robot, load_trajectory
from armident.configs.schema.collision import Box, Collision, LinkCapsule
from armident.identify.cli import trajectory as trajectory_command
from armident.identify.excitation.collision import CollisionModel
from armident.identify.excitation.design import design_trajectory
from armident.identify.excitation.link_geometry import bounding_capsule
from armident.identify.robot.chain import chain_of, link_frames

LENGTH, RADIUS = 0.5, 0.05

URDF = """<robot name="two_links">
  <link name="stand"><collision><geometry><cylinder radius="0.05" length="0.2"/></geometry></collision></link>
  <joint name="shoulder" type="revolute">
    <parent link="stand"/><child link="upper"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" velocity="3" effort="{effort}"/>
  </joint>
  <link name="upper">
    <inertial><mass value="4"/><origin xyz="0 0 0.25"/>
      <inertia ixx="0.08" iyy="0.08" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.25"/><geometry><box size="0.08 0.08 0.5"/></geometry></collision>
  </link>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="fore"/><origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" velocity="3" effort="{effort}"/>
  </joint>
  <link name="fore">
    <inertial><mass value="2"/><origin xyz="0 0 0.2"/>
      <inertia ixx="0.03" iyy="0.03" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.04" length="0.4"/></geometry></collision>
    <collision><origin xyz="0 0 0.42"/><geometry><mesh filename="package://arm/meshes/tool.stl"/></geometry></collision>
  </link>
</robot>"""


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command writes its picture into the working directory."""
    monkeypatch.chdir(tmp_path)


def planar_arm(collision: Collision | None) -> RobotConfig:
    """Two links of 0.5 m that turn about parallel axes; the second one can fold onto the first."""
    limits = {"position": [-3.0, 3.0], "velocity": 3.0, "acceleration": 20.0, "torque": 100.0}
    flat = {"alpha": 0.0, "theta": 0.0, "r": 0.0}
    robot = RobotConfig.model_validate(
        {
            "schema": "armident/robot/1",
            "name": "planar",
            "gravity": [0.0, -9.81, 0.0],
            "joints": [
                {"name": "j1", "limits": limits, "mdh": flat | {"d": 0.0}},
                {"name": "j2", "limits": limits, "mdh": flat | {"d": LENGTH}},
            ],
            "transmission": [[1.0, 0.0], [0.0, 1.0]],
        }
    )
    return robot.model_copy(update={"collision": collision})


def bodies(*boxes: Box) -> Collision:
    links = {"j1": LENGTH, "j2": LENGTH}
    capsules = [LinkCapsule(link=k, start=(0, 0, 0), end=(v, 0, 0), radius=RADIUS) for k, v in links.items()]
    return Collision(capsules=tuple(capsules), boxes=boxes)


def folded(angle: float) -> np.ndarray:
    return np.array([[0.0, angle]])


def write_urdf(folder: Path, effort: float, collision: str = "") -> Path:
    (folder / "arm.urdf").write_text(URDF.format(effort=effort))
    robot = folder / "arm.yaml"
    robot.write_text(
        "schema: armident/robot/1\nname: two_links\nurdf: {file: arm.urdf}\ntransmission: [[1, 0], [0, 1]]\n"
        "joints:\n- {name: shoulder, limits: {acceleration: 20}}\n- {name: elbow, limits: {acceleration: 20}}\n"
        + collision
    )
    return robot


def test_an_arm_that_folds_onto_itself_collides_and_a_stretched_one_does_not() -> None:
    model = CollisionModel(planar_arm(bodies()))
    straight, closed = model.closest(folded(0.0)), model.closest(folded(2.9))
    assert straight is not None
    assert closed is not None
    assert straight.distance > 0.1
    assert closed.distance < 0.0
    assert {closed.first, closed.second} == {"link of j1", "link of j2"}


def test_distance_to_a_box_is_that_of_geometry() -> None:
    box = Box(name="wall", center=(1.45, 0.0, 0.0), size=(0.5, 4.0, 4.0))
    closest = CollisionModel(planar_arm(bodies(box))).closest(folded(0.0))
    assert closest is not None
    # The wall begins at 1.2 m, the straight arm ends at 2 * LENGTH + RADIUS.
    assert closest.distance == pytest.approx(1.2 - 2 * LENGTH - RADIUS, abs=1e-6)
    assert closest.second == "box 'wall'"


def test_a_turned_box_is_compared_where_it_stands() -> None:
    box = Box(center=(1.45, 0.0, 0.0), size=(4.0, 0.5, 4.0), rpy=(0.0, 0.0, np.pi / 2))
    closest = CollisionModel(planar_arm(bodies(box))).closest(folded(0.0))
    assert closest is not None
    assert closest.distance == pytest.approx(1.2 - 2 * LENGTH - RADIUS, abs=1e-6)


def test_the_smallest_distance_of_a_motion_is_found_although_most_samples_are_skipped() -> None:
    model = CollisionModel(planar_arm(bodies(Box(center=(0.0, 1.5, 0.0), size=(0.2, 0.2, 0.2)))))
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 1.0, 1500)[:, None]
    q = np.sin(2 * np.pi * rng.uniform(1, 3, 2) * time + rng.uniform(0, 6, 2)) * [2.0, 2.5]
    every = [found.distance for row in q if (found := model.closest(row[None])) is not None]
    closest = model.closest(q)
    assert closest is not None
    assert closest.distance == pytest.approx(min(every), abs=1e-12)
    assert closest.sample == int(np.argmin(every))


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["moves", "fourier"])
def test_a_design_avoids_a_box_and_itself_where_one_without_bodies_does_not(
    shape: Literal["moves", "fourier"],
) -> None:
    box = Box(name="post", center=(0.8, 0.3, 0.0), size=(0.2, 0.2, 1.0))
    robot = planar_arm(bodies(box))
    model = CollisionModel(robot)
    careless = design_trajectory(robot, 6.0, 1, evaluations=60, shape=shape)
    careful = design_trajectory(robot, 6.0, 1, evaluations=60, shape=shape, collision=model)
    assert model.shortfall(careless.trajectory.sample(1e-3)) > 0.0
    assert careful.closest is not None
    assert careful.closest.distance >= model.clearance
    assert np.isfinite(careful.condition)


def test_a_zero_posture_inside_a_box_is_not_the_start() -> None:
    robot = planar_arm(bodies(Box(center=(0.9, 0.0, 0.0), size=(0.3, 0.3, 0.3))))
    model = CollisionModel(robot)
    design = design_trajectory(robot, 6.0, 1, evaluations=20, collision=model)
    assert model.shortfall(np.array([design.trajectory.start])) == 0.0


def test_a_box_around_the_arm_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"box 'room' reaches the link of j2 in nearly every posture"):
        CollisionModel(planar_arm(bodies(Box(name="room", center=(0, 0, 0), size=(5, 5, 5)))))


@pytest.mark.slow
def test_a_cell_without_a_way_is_refused_with_what_is_in_the_way() -> None:
    walls = [Box(center=(x, y, 0.0), size=(0.45, 0.45, 1.0)) for x in (-0.85, 0.0, 0.85) for y in (-0.85, 0.85)]
    walls += [Box(center=(x, 0.0, 0.0), size=(0.45, 1.2, 1.0)) for x in (-0.85, 0.85)]
    robot = planar_arm(bodies(*walls))
    model = CollisionModel(robot)
    with pytest.raises(ConfigError, match=r"(no trajectory found that keeps all limits.*box \d|none of \d+ postures)"):
        design_trajectory(robot, 4.0, 0, evaluations=10, collision=model)


def test_frames_of_links_are_those_of_the_chain() -> None:
    robot = load_robot("tx40")
    frames = link_frames(chain_of(robot), np.zeros((1, 6)))[0]
    expected = np.eye(4)
    for joint, found in zip(robot.joints, frames[1:], strict=True):
        ca, sa = np.cos(joint.mdh.alpha), np.sin(joint.mdh.alpha)
        c, s = np.cos(joint.mdh.theta), np.sin(joint.mdh.theta)
        about_x = np.array([[1, 0, 0, joint.mdh.d], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
        about_z = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, joint.mdh.r], [0, 0, 0, 1]])
        expected = expected @ about_x @ about_z
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_capsule_contains_its_points_and_is_slim() -> None:
    rng = np.random.default_rng(2)
    for sizes in ([1.0, 0.1, 0.1], [0.3, 0.3, 0.3], [0.5, 0.4, 0.0]):
        points = rng.uniform(-0.5, 0.5, (200, 3)) * sizes + 1.0
        (start, end), radius = bounding_capsule(points)
        along = end - start
        share = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        assert np.linalg.norm(points - start - share[:, None] * along, axis=1).max() <= radius + 1e-9
        assert radius <= 0.5 * np.linalg.norm(sizes) + 1e-9


@pytest.mark.slow
def test_geometry_of_a_urdf_counts_and_a_mesh_that_is_not_there_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_urdf(
        tmp_path, 100.0, "collision:\n  boxes: [{name: shelf, center: [0.6, 0, 1.2], size: [0.2, 1, 0.4]}]\n"
    )
    out = tmp_path / "motion.yaml"
    trajectory_command(config, out, 6.0, 0, None, 20)
    printed = " ".join(capsys.readouterr().out.split())
    assert "pairs of bodies, clearance 0.02 m: closest" in printed
    assert "not checked: shapes of meshes that cannot be read: tool.stl of link fore" in printed
    assert "torque by the masses of the URDF: at most" in printed
    assert "not checked: torques of rotor inertias" in printed
    load_trajectory(out).check(load_robot(config))


def test_boxes_of_a_urdf_stand_in_its_base_link(tmp_path: Path) -> None:
    config = write_urdf(
        tmp_path, 100.0, "collision:\n  boxes: [{center: [0, 0, 2.6], size: [1, 1, 1]}]\n"
        "  capsules:\n  - {link: upper_does_not_exist, start: [0, 0, 0], end: [0, 0, 1], radius: 0.1}\n"
    )  # fmt: skip
    with pytest.raises(
        ConfigError, match=r"collision: no link 'upper_does_not_exist'; links are base, shoulder, elbow"
    ):
        load_robot(config)
    capsule = "{link: elbow, start: [0, 0, 0], end: [0, 0, 0.4], radius: 0.1}"
    config = write_urdf(
        tmp_path,
        100.0,
        f"collision:\n  boxes: [{{center: [0, 0, 2.6], size: [1, 1, 1]}}]\n  capsules: [{capsule}]\n",
    )
    closest = CollisionModel(load_robot(config)).closest(np.zeros((1, 2)))
    assert closest is not None
    # Upright, the arm ends at 1 + 0.5 + 0.4 + 0.1 m below a box that begins at 2.1 m.
    assert closest.distance == pytest.approx(0.1, abs=1e-6)


@pytest.mark.slow
def test_masses_of_a_urdf_limit_the_torque(tmp_path: Path) -> None:
    # Gravity alone needs 9.81 * (4 * 0.25 + 2 * 0.7) = 23.5 N m at the shoulder of the stretched arm.
    config = write_urdf(tmp_path, 18.0)
    design = armident.design_trajectory(config, 6.0, evaluations=40)
    assert any("torque by the masses of the URDF" in line for line in design.checks.checked)
    still = tmp_path / "stretched.yaml"
    still.write_text(
        "schema: armident/trajectory/1\nstart: [0, 0]\nmoves:\n"
        "- {to: [1.57, 0.3], duration: 3}\n- {to: [1.3, -0.3], duration: 3}\n"
    )
    with pytest.raises(ConfigError, match=r"needs a torque of 2\d\.\d N m at shoulder \(allowed 18\.0\)"):
        trajectory_command(config, None, look_at=still)


def masses_file(path: Path, **values: object) -> Path:
    path.write_text(json.dumps(values))
    return path


def test_torques_keep_their_limits_by_the_masses_of_a_file(tmp_path: Path) -> None:
    robot = load_robot("emps.yaml")
    limit, acceleration = robot.joints[0].limits.torque, robot.joints[0].limits.acceleration
    # Half of the mass that the motor could accelerate at the limit.
    file = masses_file(tmp_path / "m.json", m1=0.5 * limit / acceleration, kp1=3.0)
    design = armident.design_trajectory(robot, 4.0, evaluations=10, masses=file)
    (torque,) = [line for line in design.checks.checked if line.startswith("torque")]
    assert f"the parameters of {file}" in torque
    assert any("parameters that" in line and "fv1" in line for line in design.checks.unchecked)
    heavy = masses_file(tmp_path / "h.json", m1=1e6 * limit / acceleration)
    with pytest.raises(ConfigError, match="torque"):
        armident.design_trajectory(robot, 4.0, evaluations=10, masses=heavy)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"kp1": 1.0}, "no masses of links"),
        ({"m1": -2.0}, "m1: -2 is negative"),
        ({"m1": 1.0, "fv1": -1.0}, "fv1: -1 is negative"),
        ({"m1": "heavy"}, "m1: expected a finite number"),
        ({"m1": float("inf")}, "expected a finite number"),
    ],
)
def test_masses_that_no_arm_has_are_refused_in_one_line(
    values: dict[str, object], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=expected):
        armident.design_trajectory("emps", 4.0, evaluations=10, masses=masses_file(tmp_path / "m.json", **values))
