"""Joint names of a file: matched as names, with a remark where they are not equal, and never by their order."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armident.configs import DataError, load_robot
from armident.configs.schema.robot import Joint
from armident.daq.interchange.joint_names import match_joints

TX40 = load_robot("tx40.yaml").joints
NAMES = [joint.name for joint in TX40]
EXCHANGED = [0, 1, 3, 4, 2, 5]


def named(*names: str) -> list[Joint]:
    """Joints of an arm with these names in its URDF."""
    plain = [f"axis_{chr(ord('a') + k)}" for k in range(len(names))]
    return [
        TX40[0].model_copy(update={"name": own, "source_name": name}) for own, name in zip(plain, names, strict=True)
    ]


@given(st.permutations([*NAMES, "finger_left", "finger_right"]))
def test_equal_names_are_found_in_any_order(names: list[str]) -> None:
    match = match_joints(names, TX40)
    assert [names[k] for k in match.index] == NAMES
    assert match.names == tuple(NAMES)
    assert match.remarks == ()


@pytest.mark.parametrize(
    ("spell", "remark"),
    [
        (str.upper, "without regard to case"),
        (lambda name: name.title().replace("_", "-"), "without regard to case"),
        (lambda name: name.replace("_", ""), "without regard to case"),
        (lambda name: f"left/{name}", "with the prefix 'left': left/joint_1 as joint_1"),
        (lambda name: f"Cell2_{name.title()}", "with the prefix 'Cell2'"),
        (lambda name: name.removeprefix("joint_"), "without the prefix 'joint'"),
    ],
)
def test_case_and_a_common_prefix_are_matched_and_said(spell: Callable[[str], str], remark: str) -> None:
    names = [spell(NAMES[k]) for k in EXCHANGED]
    match = match_joints(names, TX40)
    assert [names[k] for k in match.index] == [spell(name) for name in NAMES]
    assert remark in match.remarks[0]


def test_names_of_the_urdf_precede_those_of_the_configuration() -> None:
    arm = named("Upper", "LOWER", "手首")
    assert match_joints(["手首", "Upper", "LOWER", "axis_a", "axis_b", "axis_c"], arm).index == (1, 2, 0)
    assert match_joints(["手首", "upper", "lower"], arm).index == (1, 2, 0)
    own = match_joints(["axis_c", "axis_b", "axis_a"], arm)
    assert own.index == (2, 1, 0)
    assert "not by those of its URDF" in own.remarks[0]


def test_the_joints_of_another_arm_are_no_match() -> None:
    others = [f"right_{name}" for name in NAMES]
    assert match_joints([*others, *NAMES], TX40).index == (6, 7, 8, 9, 10, 11)
    lefts = [f"left_{name}" for name in NAMES]
    with pytest.raises(DataError, match=r"several arms: prefixes 'left', 'right'; the file has left_joint_1.*--joints"):
        match_joints([*lefts, *others], TX40)


@pytest.mark.parametrize(
    "names",
    [
        [f"a{k}" for k in range(6)],
        [f"joint_{k}" for k in range(6)],
        [*NAMES[:5], "tool"],
        [f"left_{NAMES[0]}", *(f"right_{name}" for name in NAMES[1:])],
        [f"pre{name}" for name in NAMES],
    ],
)
def test_other_names_are_refused_with_both_lists_and_the_options(names: list[str]) -> None:
    with pytest.raises(DataError) as refused:
        match_joints(names, TX40)
    text = str(refused.value)
    for part in (", ".join(names), ", ".join(NAMES), "--joints", "--by-position"):
        assert part in text


def test_position_counts_where_it_is_asked_for() -> None:
    names = [f"a{k}" for k in range(6)]
    match = match_joints(names, TX40, by_position=True)
    assert match.index == (0, 1, 2, 3, 4, 5)
    assert "a0 as joint_1" in match.remarks[0]
    with pytest.raises(DataError, match=r"contradicts the names: the file has joint_1, joint_2, joint_4"):
        match_joints([NAMES[k] for k in EXCHANGED], TX40, by_position=True)
    with pytest.raises(DataError, match="contradicts the names"):
        match_joints([NAMES[k].upper() for k in EXCHANGED], TX40, by_position=True)
    with pytest.raises(DataError, match=r"--by-position needs 6 joints, the file has 7: .*a6; the robot has joint_1"):
        match_joints([*names, "a6"], TX40, by_position=True)
    assert match_joints(NAMES, TX40, by_position=True).remarks == ()


def test_chosen_names_replace_all_comparison() -> None:
    names = ["a", "b", "c", "d", "e", "f", "g"]
    assert match_joints(names, TX40, joints=list("gfedcb")).index == (6, 5, 4, 3, 2, 1)
    with pytest.raises(DataError, match=r"--joints: no joint z; the file has a, b"):
        match_joints(names, TX40, joints=list("abcdez"))
    with pytest.raises(DataError, match=r"--joints: expected 6 different names, one for each of joint_1"):
        match_joints(names, TX40, joints=list("abcda"))


def test_names_that_fit_one_joint_twice_are_refused() -> None:
    with pytest.raises(DataError, match=r"Joint_1 and JOINT-1 fit the same joint"):
        match_joints(["Joint_1", "JOINT-1", *NAMES[1:]], TX40)
    with pytest.raises(DataError, match=r"duplicate joint name joint_2"):
        match_joints([*NAMES, "joint_2"], TX40)


def test_the_name_in_the_urdf_is_kept(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="a"/><link name="b"/><link name="c"/>'
        '<joint name="Base Yaw" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
        '<limit lower="-2" upper="2" effort="50" velocity="3"/></joint>'
        '<joint name="tilt" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>'
        '<limit lower="-2" upper="2" effort="50" velocity="3"/></joint></robot>',
        encoding="utf-8",
    )
    (tmp_path / "arm.yaml").write_text(
        "schema: armident/robot/1\nname: arm\nurdf: {file: arm.urdf}\njoints:\n"
        "  - {name: Base Yaw, limits: {acceleration: 20.0}}\n  - {name: tilt, limits: {acceleration: 20.0}}\n"
        "transmission: [[1.0, 0.0], [0.0, 1.0]]\n",
        encoding="utf-8",
    )
    joints = load_robot(tmp_path / "arm.yaml").joints
    assert [joint.name for joint in joints] == ["Base_Yaw", "tilt"]
    assert [joint.source_name for joint in joints] == ["Base Yaw", None]
    assert match_joints(["tilt", "Base Yaw"], joints).index == (1, 0)
