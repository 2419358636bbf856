"""Robots from URDF: conversion to modified Denavit-Hartenberg parameters, and refused files."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from armident import RobotModel, design_trajectory, identify
from armident.configs import ConfigError, Limits, RobotConfig, Trajectory, load_robot
from armident.configs.loading import parse
from armident.configs.mdh import modified_dh
from armident.configs.urdf import mdh_of
from armident.configs.urdf_origin import fixed_axis_angles, rotation, rotation_of_quaternion
from armident.configs.urdf_tree import read_chain
from armident.daq.guard.motion_limits import motion_limits_of
from armident.daq.recording import Recording, Stream, read_recording, write_recording
from armident.daq.recording.model import Field
from armident.identify.effects.drive import NOMINAL_TORQUE, motor_limit

LIMIT = '<limit lower="-2" upper="2" velocity="3" effort="50"/>'

# The axes of the Panda as its maker's URDF places them: joint, rpy, xyz.
PANDA = (
    ("0 0 0", "0 0 0.333"),
    ("-1.57079632679 0 0", "0 0 0"),
    ("1.57079632679 0 0", "0 -0.316 0"),
    ("1.57079632679 0 0", "0.0825 0 0"),
    ("-1.57079632679 0 0", "-0.0825 0.384 0"),
    ("1.57079632679 0 0", "0 0 0"),
    ("1.57079632679 0 0", "0.088 0 0"),
)


def joint(
    name: str,
    ends: str,
    kind: str = "revolute",
    axis: str = "0 0 1",
    xyz: str = "0 0 0",
    rpy: str = "0 0 0",
    more: str = LIMIT,
) -> str:
    """A joint element; ``ends`` are parent and child."""
    parent, child = ends.split()
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def urdf(folder: Path, *joints: str, links: str = "a b c d e") -> Path:
    """URDF with links and joints."""
    text = "".join(f'<link name="{link}"/>' for link in links.split()) + "".join(joints)
    file = folder / "arm.urdf"
    file.write_text(f'<robot name="arm">{text}</robot>')
    return file


def configuration(folder: Path, n: int, joints: str = "", urdf_keys: str = "", **more: str) -> Path:
    identity = np.eye(n).tolist()
    accelerations = "\n".join(f"- {{name: j{k}, limits: {{acceleration: 9.0}}}}" for k in range(1, n + 1))
    keys = "".join(f"{key}: {value}\n" for key, value in more.items())
    file = folder / "arm.yaml"
    file.write_text(
        f"schema: armident/robot/1\nname: arm\nurdf: {{file: arm.urdf{urdf_keys}}}\n{keys}"
        f"joints:\n{joints or accelerations}\ntransmission: {identity}\n"
    )
    return file


def two_joints(folder: Path, **second: str) -> Path:
    return urdf(folder, joint("j1", "a b"), joint("j2", "b c", **second), links="a b c")


def test_the_urdf_of_the_panda_gives_the_parameters_its_maker_documents(tmp_path: Path) -> None:
    joints = [joint(f"j{k}", f"l{k - 1} l{k}", rpy=rpy, xyz=xyz) for k, (rpy, xyz) in enumerate(PANDA, start=1)]
    urdf(tmp_path, *joints, links=" ".join(f"l{k}" for k in range(8)))
    found = load_robot(configuration(tmp_path, 7))
    documented = load_robot("panda")
    assert [j.mdh for j in found.joints] == [j.mdh for j in documented.joints]
    assert found.gravity == documented.gravity


def test_the_urdf_of_the_kuka_gives_the_shipped_geometry(shared_data: Path) -> None:
    file = shared_data / "kuka_lwr4" / "kuka_lwr4.urdf"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    joints = read_chain(file, base="lwr_base_link")
    shipped = load_robot("kuka_lwr4")
    assert [j.name for j in joints] == [j.name for j in shipped.joints]
    assert list(mdh_of(joints, file).parameters) == [j.mdh for j in shipped.joints]
    for found, ours in zip(joints, shipped.joints, strict=True):
        assert found.limits == ours.limits.model_dump(exclude={"acceleration"})


def transform(robot: RobotConfig, q: np.ndarray) -> np.ndarray:
    """Frame n in frame 0: ``Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r)`` of every joint."""
    frame = np.eye(4)
    for value, j in zip(q, robot.joints, strict=True):
        theta = j.mdh.theta + (value if j.type == "revolute" else 0.0)
        r = j.mdh.r + (value if j.type == "prismatic" else 0.0)
        ca, sa, c, s = np.cos(j.mdh.alpha), np.sin(j.mdh.alpha), np.cos(theta), np.sin(theta)
        about_x = np.array([[1, 0, 0, j.mdh.d], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
        about_z = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, r], [0, 0, 0, 1]])
        frame = frame @ about_x @ about_z
    return frame


@pytest.mark.parametrize("kinds", list(itertools.product(["revolute", "prismatic"], repeat=3)), ids="-".join)
def test_the_last_link_moves_as_the_urdf_says(tmp_path: Path, kinds: tuple[str, str, str]) -> None:
    # Axes, in this order: skew, parallel and opposite, intersecting; a fixed joint in between.
    urdf(
        tmp_path,
        joint("j1", "a b", kinds[0], axis="1 2 -1", xyz="0.1 0.2 0.3", rpy="0.4 -0.5 0.6"),
        joint("mount", "b c", "fixed", xyz="0.3 -0.1 0.2", rpy="0.3 0.1 -1.2"),
        joint("j2", "c d", kinds[1], axis="0 1 1", xyz="0.1 0 0.4"),
        joint("j3", "d e", kinds[2], axis="0 -2 -2", xyz="0.2 0.5 0.3"),
    )
    robot = load_robot(configuration(tmp_path, 3))
    joints = read_chain(tmp_path / "arm.urdf")
    chain = mdh_of(joints, tmp_path / "arm.urdf")
    q = np.array([0.7, -1.1, 0.4])
    ours = chain.base @ transform(robot, q)
    # The same motion as screws about the axes where the URDF has them with all variables zero.
    moved = np.eye(4)
    for value, j in zip(q, joints, strict=True):
        axis, point, step = j.placement[:3, :3] @ j.axis, j.placement[:3, 3], np.eye(4)
        if j.type == "prismatic":
            step[:3, 3] = value * axis
        else:
            cross = np.cross(axis, np.eye(3)).T
            step[:3, :3] = np.eye(3) + np.sin(value) * cross + (1 - np.cos(value)) * cross @ cross
            step[:3, 3] = point - step[:3, :3] @ point
        moved = moved @ step
    np.testing.assert_allclose(ours, moved @ chain.frames[-1], atol=1e-12)


def test_gravity_is_that_of_the_base_link_however_the_first_axis_lies(tmp_path: Path) -> None:
    urdf(tmp_path, joint("j1", "a b", axis="0 1 0"), links="a b")
    robot = load_robot(configuration(tmp_path, 1, gravity="[1.0, 2.0, 3.0]"))
    base = mdh_of(read_chain(tmp_path / "arm.urdf"), tmp_path).base[:3, :3]
    np.testing.assert_allclose(base @ np.array(robot.gravity), [1.0, 2.0, 3.0], atol=1e-14)
    np.testing.assert_array_equal(base[:, 2], [0.0, 1.0, 0.0])


def test_joints_take_limits_from_the_urdf_and_the_rest_from_the_configuration(tmp_path: Path) -> None:
    urdf(
        tmp_path,
        joint("J-1", "a b", "prismatic"),
        joint("j2", "b c", "continuous", more='<limit velocity="4" effort="0"/>'),
        links="a b c",
    )
    first = "- {name: J-1, limits: {acceleration: 9.0, velocity: 1.0}, drive: {signal: torque}, rotor_inertia: false}"
    second = "- {name: j2, limits: {acceleration: 8.0, torque: 7.0}}"
    robot = load_robot(configuration(tmp_path, 2, joints=f"{second}\n{first}"))
    one, two = robot.joints
    assert (one.name, one.type, one.drive.signal, one.rotor_inertia) == ("J_1", "prismatic", "torque", False)
    assert (one.source_name, two.source_name) == ("J-1", None)
    assert (one.limits.position, one.limits.velocity, one.limits.torque) == ((-2.0, 2.0), 1.0, 50.0)
    assert (two.name, two.type, two.rotor_inertia) == ("j2", "revolute", True)
    assert two.limits.position == pytest.approx((-2 * np.pi, 2 * np.pi))
    assert (two.limits.velocity, two.limits.acceleration, two.limits.torque) == (4.0, 8.0, 7.0)


def test_a_recording_needs_no_urdf(tmp_path: Path) -> None:
    two_joints(tmp_path, rpy="1.5708 0 0")
    robot = load_robot(configuration(tmp_path, 2))
    count = np.arange(3, dtype=np.int64)
    fields = {"position": Field("position", "position", "rad", "joint", (1.0, 1.0))}
    stream = Stream("samples", 1, count, count * 10**6, fields, {"position": np.zeros((3, 2))})
    write_recording(Recording(None, robot, None, 1000.0, {"samples": stream}), tmp_path / "r.mcap")
    (tmp_path / "arm.urdf").unlink()
    assert read_recording(tmp_path / "r.mcap").robot == robot


@pytest.mark.parametrize(
    ("written", "exact"),
    [("1.5708", np.pi / 2), ("-3.14159", -np.pi), ("0.5235", np.pi / 6), ("1.57", np.pi / 2), ("-1.571", -np.pi / 2)],
)
def test_an_angle_written_with_few_digits_is_the_multiple_of_15_degrees_that_is_meant(
    tmp_path: Path, written: str, exact: float
) -> None:
    two_joints(tmp_path, rpy=f"{written} 0 0")
    assert abs(load_robot(configuration(tmp_path, 2)).joints[1].mdh.alpha) == pytest.approx(abs(exact), abs=1e-15)


@pytest.mark.parametrize("angle", ["0.5236500", "1.5709", "1.573", "0.524", "1.6"])
def test_any_other_angle_stays_as_it_is(tmp_path: Path, angle: str) -> None:
    two_joints(tmp_path, rpy=f"{angle} 0 0")
    assert abs(load_robot(configuration(tmp_path, 2)).joints[1].mdh.alpha) == pytest.approx(float(angle), abs=1e-14)


def test_axes_that_are_parallel_but_for_rounding_have_no_far_away_normal() -> None:
    tilt = 1e-9
    axes = [[0.0, 0.0, 1.0], [0.0, np.sin(tilt), np.cos(tilt)], [1.0, 0.0, 0.0]]
    chain = modified_dh(axes, [[0.0, 0.0, 0.0], [0.3, 0.0, 0.5], [0.3, 0.1, 0.6]], ["j1", "j2", "j3"])
    assert [p.alpha for p in chain.parameters[:2]] == [0.0, 0.0]
    assert chain.parameters[1].d == pytest.approx(0.3, abs=1e-9)
    assert max(abs(p.r) for p in chain.parameters) < 1.0


def test_a_part_of_a_tree_is_chosen_by_base_and_tip(tmp_path: Path) -> None:
    file = urdf(
        tmp_path,
        joint("torso", "a b"),
        joint("left", "b c", xyz="0.5 0 0"),
        joint("right", "b d"),
        joint("finger", "c e", "prismatic"),
    )
    assert [j.name for j in read_chain(file, base="c")] == ["finger"]
    # Branches at the base are ignored, and links after the tip are its load.
    assert [j.name for j in read_chain(file, base="b", tip="c")] == ["left"]
    with pytest.raises(ConfigError, match=r"link 'b' branches into joints 'left' and 'right'"):
        read_chain(file, base="a", tip="e")


def test_what_is_fixed_to_the_side_is_no_branch(tmp_path: Path) -> None:
    file = urdf(tmp_path, joint("camera", "b d", "fixed"), joint("j1", "a b"), joint("j2", "b c"), links="a b c d")
    assert [j.name for j in read_chain(file)] == ["j1", "j2"]


MIMIC = LIMIT + '<mimic joint="j1"/>'


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        ([joint("x", "b d")], r"link 'b' branches into joints 'j2' and 'x'; only serial chains"),
        ([joint("m", "b d", "fixed"), joint("x", "d e")], r"link 'b' branches into joints 'j2' and 'm'"),
        ([joint("x", "c d", more=MIMIC)], r"joint 'x': follows another joint \(mimic\)"),
        ([joint("x", "c d", "floating")], r"joint 'x': type 'floating' cannot be identified; expected revolute"),
        ([joint("x", "c d", "planar")], r"joint 'x': type 'planar' cannot be identified"),
        ([joint("x", "c d", axis="0 0 0")], r"joint 'x': axis: expected a direction"),
        ([joint("x", "c d", axis="0 0")], r"joint 'x': axis xyz: expected 3 numbers, found '0 0'"),
        ([joint("x", "c d", xyz="0 0 nan")], r"joint 'x': origin xyz: expected 3 numbers, found '0 0 nan'"),
        (
            [joint("x", "c d", rpy="${pi/2} 0 0")],
            r"joint 'x': origin rpy: .*; this is xacro, expand it first: xacro arm\.urdf > arm_expanded\.urdf",
        ),
        ([joint("x", "c d", xyz="0 0 1_0")], r"joint 'x': origin xyz: expected 3 numbers, found '0 0 1_0'"),
        ([joint("x", "c d", more='<limit upper="3_1"/>')], r"joint 'x': limit upper: expected a number, found '3_1'"),
        ([joint("x", "c d", more='<limit effort="strong"/>')], r"joint 'x': limit effort: expected a number"),
        ([joint("x", "c c2")], r"joint 'x': child: no link 'c2'"),
        ([joint("x", "a c")], r"link 'c' is moved by two joints, 'j2' and 'x'"),
        ([joint("j2", "c d")], r"joint 'j2': there are two of this name"),
        ([joint("x", "c a")], r"expected one link that no joint moves, found none: the joints form a loop"),
        ([joint("x", "d e"), joint("y", "e d")], r"links d, e form a loop"),
        ([joint("x", "c d"), joint("y", "a e", more=LIMIT)], r"link 'a' branches into joints 'j1' and 'y'"),
        (['<joint name="x" type="fixed"><child link="d"/></joint>'], r"joint 'x': parent: no link ''"),
        (['<joint type="fixed"/>'], r"joint number 3: has no name"),
        ([joint("x", "c d", more='<origin xyz="1 0 0"/>')], r"joint 'x': there are 2 elements origin, expected one"),
        ([joint("x", "c d", more='<parent link="a"/>')], r"joint 'x': there are 2 elements parent"),
        ([joint("x", "c d", more='<axis xyz="1 2 3"/>')], r"joint 'x': there are 2 elements axis"),
        ([joint("x", "c d", more=LIMIT + '<limit upper="1"/>')], r"joint 'x': there are 2 elements limit"),
        ([joint("x", "c d"), '<link name="d"/>'], r"link 'd': there are two of this name"),
        ([joint("x", "c d").replace("origin", "Origin")], r"joint 'x': Origin is no name of URDF, which has origin"),
        ([joint("x", "c d").replace("xyz=", "XYZ=")], r"joint 'x': origin: XYZ is no name of URDF, which has xyz"),
        ([joint("x", "c d").replace("joint", "Joint")], r"robot: Joint is no name of URDF, which has joint"),
        ([joint("${side}_x", "c d")], r"joint '\$\{side\}_x': this is xacro, expand it first"),
    ],
)
def test_what_is_no_serial_chain_is_refused_with_file_and_element(
    tmp_path: Path, joints: list[str], words: str
) -> None:
    links = sorted(set("abc") | {end for j in joints for end in "de" if f'link="{end}"' in j})
    file = urdf(tmp_path, joint("j1", "a b"), joint("j2", "b c"), *joints, links=" ".join(links))
    with pytest.raises(ConfigError, match=words) as caught:
        read_chain(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


def test_the_file_may_have_a_namespace_a_first_line_and_letters_of_other_tools(tmp_path: Path) -> None:
    text = urdf(tmp_path, joint("j1", "a b"), joint("j2", "b c", xyz="0 0 0.3"), links="a b c").read_text()
    plain = read_chain(tmp_path / "arm.urdf")
    for other in (
        text.replace("<robot", '<robot xmlns="http://drake.mit.edu"').encode(),
        f'\n\n<?xml version="1.0"?>\n{text}'.encode(),
        text.replace("</robot>", "<!-- für 5 µm --></robot>").encode("cp1252"),
    ):
        (tmp_path / "other.urdf").write_bytes(other)
        for found, expected in zip(read_chain(tmp_path / "other.urdf"), plain, strict=True):
            np.testing.assert_array_equal(found.placement, expected.placement)


def test_an_element_that_is_repeated_without_a_change_is_one(tmp_path: Path) -> None:
    text = urdf(tmp_path, joint("j1", "a b"), joint("j2", "b c", xyz="0 0 0.3"), links="a b c").read_text()
    element = re.search(r"<origin[^>]*/>", text)
    assert element is not None
    (tmp_path / "arm.urdf").write_text(text.replace(element[0], 2 * element[0]))
    assert [joint.name for joint in read_chain(tmp_path / "arm.urdf")] == ["j1", "j2"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<robot", "not valid XML: .*line 1"),
        ("<sdf/>", "expected a URDF with the root element robot, found sdf"),
        ('<robot><link name="a"/></robot>', "no joint moves between link 'a' and its end"),
    ],
)
def test_a_file_that_is_no_urdf_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_chain(file)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"urdf_keys": ", tip: z"}, r"arm\.urdf: no link 'z' \(urdf\.tip\); links are a, b, c"),
        ({"urdf_keys": ", base: b, tip: a"}, r"arm\.urdf: link 'a' \(urdf\.tip\) is not moved by link 'b'"),
        ({"urdf_keys": ", tipp: a"}, r"arm\.yaml: urdf\.tipp: unknown key; did you mean 'tip'\?"),
        ({"joints": "- {name: j9}"}, r"arm\.yaml: joints\[0\]\.name: the chain has no joint 'j9'; it has j1, j2"),
        ({"joints": "- {name: j1}\n- {name: J1}"}, r"arm\.yaml: joints\[1\]\.name: duplicate joint 'J1'"),
        ({"joints": "- {name: j1, mdh: {r: 1}}"}, r"arm\.yaml: joints\[0\]\.mdh: unknown key"),
        ({"joints": "- {name: j1, limits: {velocity: -1}}"}, r"joints\[0\]\.limits\.velocity: input should be greater"),
        ({"controller": "{kp: [1.0], kv: [1.0]}"}, r"arm\.yaml: controller: expected 2 numbers in kp and in kv"),
    ],
)
def test_a_mistake_in_the_configuration_is_named_with_its_key(tmp_path: Path, keys: dict[str, str], words: str) -> None:
    two_joints(tmp_path)
    with pytest.raises(ConfigError, match=words) as caught:
        load_robot(configuration(tmp_path, 2, **keys))
    assert "\n" not in str(caught.value)


def test_a_misspelt_urdf_key_is_recognised(tmp_path: Path) -> None:
    file = configuration(tmp_path, 2)
    file.write_text(file.read_text().replace("urdf:", "urdff:"))
    with pytest.raises(ConfigError, match=r"urdff: unknown key; did you mean 'urdf'\?"):
        load_robot(file)


def test_a_missing_urdf_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"arm\.yaml: urdf\.file: no such file arm\.urdf"):
        load_robot(configuration(tmp_path, 2))


def test_joints_whose_names_become_the_same_are_refused(tmp_path: Path) -> None:
    urdf(tmp_path, joint("j 1", "a b"), joint("J_1", "b c"), links="a b c")
    with pytest.raises(ConfigError, match=r"joint names differ only in case or punctuation: j 1, J_1"):
        load_robot(configuration(tmp_path, 2))


def test_axes_nearly_but_not_quite_parallel_are_refused_with_their_joints(tmp_path: Path) -> None:
    two_joints(tmp_path, rpy="3.14 0 0", xyz="0.3 0.1 0")
    with pytest.raises(ConfigError, match=r"arm\.urdf: the axes of j1 and j2 are nearly parallel \(0\.0016 rad\)"):
        load_robot(configuration(tmp_path, 2))


def test_an_acceleration_and_a_transmission_are_needed_only_where_the_arm_moves(tmp_path: Path) -> None:
    urdf(tmp_path, joint("j1", "a b"), joint("j2", "b c", more="<limit/>"), links="a b c")
    file = tmp_path / "arm.yaml"
    file.write_text("schema: armident/robot/1\nname: arm\nurdf: {file: arm.urdf}\n")
    robot = load_robot(file)
    assert robot.transmission is None
    np.testing.assert_array_equal(robot.transmission_matrix, np.eye(2))
    assert robot.joints[0].limits.missing() == ("acceleration",)
    trajectory = Trajectory.model_validate(
        {"schema": "armident/trajectory/1", "start": [0.0, 0.0], "moves": [{"to": [0.1, 0.1], "duration": 1.0}]}
    )
    with pytest.raises(ConfigError) as refused:
        trajectory.check(robot, "move.yaml")
    assert str(refused.value) == (
        "move.yaml: to move the arm, the robot configuration needs also limits.acceleration of j1, j2; "
        "limits.position of j2; limits.velocity of j2; limits.torque of j2; transmission (2 rows of 2 numbers)"
    )
    for needs in (motion_limits_of, design_trajectory):
        with pytest.raises(ConfigError, match=r"robot arm: to move the arm, .* transmission"):
            needs(robot)


def test_a_robot_without_limits_is_stored_in_its_recording(tmp_path: Path) -> None:
    urdf(tmp_path, joint("J-1", "a b", more=""), joint("j2", "b c", "prismatic", more=OPEN_ABOVE), links="a b c")
    robot = load_robot(configuration(tmp_path, 2, joints="- {name: j2}"))
    assert robot.joints[0].limits == Limits()
    assert robot.joints[1].limits.position == (-0.5, np.inf)
    assert RobotConfig.model_validate_json(robot.model_dump_json(by_alias=True)) == robot
    assert parse(yaml.safe_dump(robot.model_dump(mode="json", by_alias=True)), RobotConfig, "arm") == robot


OPEN_ABOVE = '<limit lower="-0.5" upper="1e16" velocity="-1" effort="inf"/>'


@pytest.mark.parametrize("none", ["1e16", "1e+16", "inf", "1.7976931348623157e308", "1e400", "INFINITY"])
def test_a_huge_limit_is_none(tmp_path: Path, none: str) -> None:
    limit = f'<limit lower="-{none}" upper="{none}" velocity="{none}" effort="{none}"/>'
    half = f'<limit lower="-2" upper="{none}" velocity="3" effort="50"/>'
    urdf(tmp_path, joint("j1", "a b", more=limit), joint("j2", "b c", more=half), links="a b c")
    said = load_robot(configuration(tmp_path, 2, joints="- {name: j1, limits: {position: [-3, 3], torque: 9}}")).joints
    plain = load_robot(configuration(tmp_path, 2, joints="- {name: j2}")).joints
    assert plain[0].limits.position == pytest.approx((-2 * np.pi, 2 * np.pi))
    assert plain[0].limits.missing() == ("velocity", "acceleration", "torque")
    assert plain[1].limits.position == pytest.approx((-2.0, 2 * np.pi))
    assert (said[0].limits.position, said[0].limits.torque) == ((-3.0, 3.0), 9.0)


def test_a_limit_that_is_no_number_is_refused(tmp_path: Path) -> None:
    file = urdf(tmp_path, joint("j1", "a b", more='<limit lower="nan" upper="1"/>'), links="a b")
    with pytest.raises(ConfigError, match="joint 'j1': limit lower: expected a number, found 'nan'"):
        read_chain(file)


def test_a_quaternion_is_the_orientation_of_an_origin(tmp_path: Path) -> None:
    two_joints(tmp_path, xyz="0.3 0 0.2", rpy="1.5707963267948966 0 0")
    angles = load_robot(configuration(tmp_path, 2)).joints
    file = tmp_path / "arm.urdf"
    text = file.read_text()
    for quaternion in ("0.7071067811865476 0 0 0.7071067811865476", "0.7071 0 0 0.7071", "-0.707 0 0 -0.707"):
        file.write_text(text.replace('rpy="1.5707963267948966 0 0"', f'quat_xyzw="{quaternion}"'))
        assert load_robot(configuration(tmp_path, 2)).joints == angles


@given(st.tuples(*[st.floats(-3.1, 3.1)] * 3))
def test_quaternions_and_angles_give_the_same_rotation(angles: tuple[float, float, float]) -> None:
    matrix = rotation(*angles)
    quaternion: list[float] = Rotation.from_matrix(matrix).as_quat().tolist()
    assert np.abs(rotation_of_quaternion(quaternion) - matrix).max() < 1e-9


@pytest.mark.parametrize(
    ("origin", "words"),
    [
        ('rpy="0 0 0" quat_xyzw="0 0 0 1"', "both rpy and quat_xyzw"),
        ('quat_xyzw="0 0 0"', "expected 4 numbers"),
        ('quat_xyzw="0 0 0 0"', "the length of the quaternion is 0, expected 1"),
        ('quat_xyzw="0 0 90 1"', "the length of the quaternion is 90.01, expected 1"),
        ('quat_wxyz="1 0 0 0"', "unknown attribute quat_wxyz; expected xyz, and rpy or quat_xyzw"),
        ('rpy="90 0 0"', "'90 0 0' looks like degrees; expected rad"),
    ],
)
def test_an_orientation_that_is_none_is_refused(tmp_path: Path, origin: str, words: str) -> None:
    file = two_joints(tmp_path)
    file.write_text(file.read_text().replace('rpy="0 0 0"', origin))
    with pytest.raises(ConfigError, match=r"joint 'j1': origin") as refused:
        read_chain(file)
    assert words in str(refused.value)


def test_distances_in_millimetres_are_refused_but_for_the_place_of_the_base(tmp_path: Path) -> None:
    file = urdf(tmp_path, joint("j1", "a b", xyz="500 0 0"), joint("j2", "b c", xyz="0 325 0"), links="a b c")
    with pytest.raises(ConfigError, match=r"joint 'j2': origin xyz: 325 looks like millimetres; expected m"):
        read_chain(file)


XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


@pytest.mark.parametrize(
    "text",
    [
        f'<robot name="arm" {XACRO}><xacro:include filename="arm_macro.xacro"/></robot>',
        f'<robot {XACRO}><xacro:property name="l" value="1"/><link name="a"/></robot>',
        '<robot name="arm"><xacro:arm prefix="left"/></robot>',
    ],
)
def test_a_xacro_file_is_named_with_the_command_that_expands_it(tmp_path: Path, text: str) -> None:
    file = tmp_path / "arm.urdf.xacro"
    file.write_text(text)
    with pytest.raises(ConfigError) as refused:
        read_chain(file)
    assert str(refused.value) == f"{file}: this is xacro, expand it first: xacro arm.urdf.xacro > arm_expanded.urdf"


def test_an_expanded_file_may_keep_the_namespace_of_xacro(tmp_path: Path) -> None:
    file = two_joints(tmp_path)
    file.write_text(file.read_text().replace("<robot ", f"<robot {XACRO} "))
    assert [j.name for j in read_chain(file)] == ["j1", "j2"]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("Shoulder_Pan", "elbow"), ("Shoulder_Pan", "elbow")),
        (("肩", "肘"), ("joint_1", "joint_2")),
        (("關節2", "關節1"), ("joint_2", "joint_1")),
        (("左軸_1", "右軸_1"), ("joint_1", "joint_2")),
        (("Gelenk_hängend", "Колено"), ("Gelenk_hangend", "joint_2")),
        (("left/arm joint", "1"), ("left_arm_joint", "joint_1")),
    ],
)
def test_joint_names_keep_their_letters_or_get_a_place(
    tmp_path: Path, names: tuple[str, str], expected: tuple[str, str]
) -> None:
    urdf(tmp_path, joint(names[0], "a b"), joint(names[1], "b c"), links="a b c")
    entries = f"- {{name: '{names[1]}', limits: {{velocity: 1}}}}\n- {{name: {expected[0]}, rotor_inertia: false}}"
    joints = load_robot(configuration(tmp_path, 2, joints=entries)).joints
    assert tuple(j.name for j in joints) == expected
    assert tuple(j.source_name or j.name for j in joints) == names
    assert (joints[1].limits.velocity, joints[0].rotor_inertia) == (1.0, False)


@pytest.mark.slow
def test_an_arm_without_limits_is_identified_from_a_recording(tmp_path: Path) -> None:
    urdf(
        tmp_path,
        joint("Sh", "a b", axis="0 1 0", more=""),
        joint("El", "b c", axis="0 1 0", xyz="0.4 0 0", more=""),
        links="a b c",
    )
    (tmp_path / "arm.yaml").write_text("schema: armident/robot/1\nname: arm\nurdf: {file: arm.urdf}\n")
    robot = load_robot(tmp_path / "arm.yaml")
    model, rng = RobotModel(robot), np.random.default_rng(1)
    t = np.arange(0.0, 10.0, 0.004)
    rates, weights = 2.0 * np.pi * 0.1 * np.arange(1, 8), rng.normal(size=(7, 2)) / np.arange(1, 8)[:, None]
    q, qd = np.sin(t[:, None] * rates) @ weights, np.cos(t[:, None] * rates) @ (weights * rates[:, None])
    qdd = -np.sin(t[:, None] * rates) @ (weights * rates[:, None] ** 2)
    theta = rng.uniform(0.5, 2.0, model.regressor(q[:1], qd[:1], qdd[:1]).shape[-1])
    tau = np.asarray(model.regressor(q, qd, qdd)) @ theta + rng.normal(0.0, 0.05, q.shape)
    count = np.arange(t.size, dtype=np.int64)
    fields = {
        "position": Field("position", "position", "rad", "joint", (1.0, 1.0)),
        "torque": Field("torque", "torque", "N m", "joint", (1.0, 1.0)),
    }
    stream = Stream("samples", 1, count, count * 4_000_000, fields, {"position": q, "torque": tau})
    write_recording(Recording(None, robot, None, 250.0, {"samples": stream}), tmp_path / "r.mcap")
    result = identify(tmp_path / "r.mcap", method="idim-ls")
    np.testing.assert_allclose(result.theta, theta, rtol=0.05, atol=0.05)
    assert motor_limit(robot, 0) == NOMINAL_TORQUE


@pytest.mark.parametrize("angles", [(0.3, -0.4, 2.9), (-3.0, 1.2, -0.1), (0.7, np.pi / 2, 0.0), (0.2, -np.pi / 2, 0.0)])
def test_fixed_axis_angles_of_a_rotation_are_those_that_made_it(angles: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(fixed_axis_angles(rotation(*angles)), angles, atol=1e-12)
