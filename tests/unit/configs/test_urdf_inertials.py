"""Masses of a URDF in the frames of the model, against Pinocchio's own URDF reader."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest

from armident.configs import ConfigError, load_robot
from armident.configs.loading import load_inertials
from armident.configs.urdf_inertials import held_joints, read_inertials
from armident.configs.urdf_tree import serial_tips
from armident.daq.init.geometry import from_urdf
from armident.virtual_robot.model import build_model
from tests.urdf_chains import configuration, random_urdf

pin: Any = pinocchio

LINK = (
    '<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="{mass}"/>'
    '<inertia ixx="{ixx}" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1" velocity="1" effort="9"/>{more}</joint>'
)


def chain(tmp_path: Path, *, mass: float = 2.0, ixx: float = 0.01, damping: str = "") -> Path:
    """One moving joint with a link, and behind it a gripper finger that moves."""
    file = tmp_path / "arm.urdf"
    more = f'<dynamics damping="{damping}" friction="0.5"/>' if damping else ""
    file.write_text(
        '<robot name="one"><link name="base"/>'
        + LINK.format(name="arm", mass=mass, ixx=ixx)
        + LINK.format(name="finger", mass=0.5, ixx=0.01)
        + JOINT.format(name="turn", kind="revolute", parent="base", child="arm", more=more)
        + JOINT.format(name="grip", kind="prismatic", parent="arm", child="finger", more="")
        + "</robot>"
    )
    return file


@pytest.mark.parametrize("seed", range(6))
def test_the_masses_are_those_that_pinocchio_reads(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    n, file, gravity = 5, tmp_path / "random.urdf", np.array([0.5, -1.0, -9.7])
    file.write_text(random_urdf(rng, n, right_angles=bool(seed % 2)))
    config = tmp_path / "robot.yaml"
    config.write_text(configuration(file, n, gravity))
    robot, read = load_robot(config), load_inertials(config)
    assert read is not None
    assert not any((read.massless, read.impossible, read.held, read.friction))
    ours, theirs = build_model(robot, read.standard), pin.buildModelFromUrdf(str(file))
    theirs.gravity.linear = gravity
    for _ in range(5):
        q, qd, qdd = rng.uniform(-1.0, 1.0, (3, n))
        position = np.concatenate(
            [[np.cos(x), np.sin(x)] if joint.nq == 2 else [x] for joint, x in zip(theirs.joints[1:], q, strict=True)]
        )
        expected = pin.rnea(theirs, theirs.createData(), position, qd, qdd)
        np.testing.assert_allclose(pin.rnea(ours, ours.createData(), q, qd, qdd), expected, rtol=1e-9, atol=1e-9)


OTHERS = "".join(
    [
        *(
            LINK.format(name=name, mass=mass, ixx=0.01)
            for name, mass in (("arm_2", 3.0), ("palm", 0.7), ("camera", 0.4))
        ),
        *(LINK.format(name=name, mass=0.2, ixx=0.01) for name in ("finger_1", "finger_2")),
        '<link name="tcp"/>',
        JOINT.format(name="other_arm", kind="revolute", parent="base", child="arm_2", more=""),
        JOINT.format(name="mount", kind="fixed", parent="tool", child="palm", more='<origin xyz="0 0.1 0.2"/>'),
        JOINT.format(name="pan", kind="revolute", parent="tool", child="camera", more='<origin xyz="0.1 0 0"/>'),
        JOINT.format(name="grip_1", kind="prismatic", parent="palm", child="finger_1", more=""),
        JOINT.format(name="grip_2", kind="prismatic", parent="palm", child="finger_2", more='<mimic joint="grip_1"/>'),
        JOINT.format(name="point", kind="fixed", parent="tool", child="tcp", more=""),
    ]
)
"""A second arm at the base; at the link ``tool`` a gripper with two fingers, a camera that turns, and a frame."""


@pytest.mark.parametrize("tip", ["tcp", "palm", "camera", "tool"])
def test_the_load_of_a_chain_is_that_of_pinocchio_with_the_other_joints_locked(tmp_path: Path, tip: str) -> None:
    rng = np.random.default_rng(3)
    n, file, gravity = 4, tmp_path / "random.urdf", np.array([0.5, -1.0, -9.7])
    file.write_text(random_urdf(rng, n, right_angles=False).replace("</robot>", f"{OTHERS}</robot>"))
    config = tmp_path / "robot.yaml"
    config.write_text(
        configuration(file, n, gravity).replace("{file: random.urdf}", f"{{file: random.urdf, tip: {tip}}}")
    )
    if tip == "camera":
        # The joint of the camera ends the chain: it branches off before the last joint that moves.
        with pytest.raises(ConfigError, match=r"link 'tool' branches into joints 'pan' and 'mount'.*stand still"):
            load_robot(config)
        return
    robot, read = load_robot(config), load_inertials(config)
    assert read is not None
    assert sorted(read.held) == ["grip_1", "grip_2", "pan"]
    assert sorted(held_joints(file, tip=tip)) == ["grip_1", "grip_2", "pan"]
    ours, whole = build_model(robot, read.standard), pin.buildModelFromUrdf(str(file))
    locked = [whole.getJointId(name) for name in ("other_arm", *read.held)]
    theirs = pin.buildReducedModel(whole, locked, pin.neutral(whole))
    theirs.gravity.linear = gravity
    for _ in range(3):
        q, qd, qdd = rng.uniform(-1.0, 1.0, (3, n))
        position = np.concatenate(
            [[np.cos(x), np.sin(x)] if joint.nq == 2 else [x] for joint, x in zip(theirs.joints[1:], q, strict=True)]
        )
        expected = pin.rnea(theirs, theirs.createData(), position, qd, qdd)
        np.testing.assert_allclose(pin.rnea(ours, ours.createData(), q, qd, qdd), expected, rtol=1e-9, atol=1e-9)


def test_frames_of_one_chain_are_one_tip(tmp_path: Path) -> None:
    file = tmp_path / "random.urdf"
    text = random_urdf(np.random.default_rng(3), 4, right_angles=False)
    file.write_text(text.replace("</robot>", f"{OTHERS}</robot>"))
    chain_joints = tuple(f"joint_{k}" for k in range(1, 5))
    assert serial_tips(file) == {"arm_2": ("other_arm",), "tool": chain_joints}
    found = from_urdf(file, tmp_path, tip="tcp")
    assert found.notes == (
        "chain up to link tcp",
        "load of the last joint, all at zero: what pan, grip_1, grip_2 move",
    )


def test_links_behind_the_tip_are_a_rigid_load(tmp_path: Path) -> None:
    read = read_inertials(chain(tmp_path), tip="arm")
    assert read.held == ("grip",)
    assert read.standard["m1"] == pytest.approx(2.5)
    # parallel axes: 2 kg and 0.5 kg at 0.1 m
    assert read.standard["zz1"] == pytest.approx(0.02 + 2.0 * 0.01 + 0.02 + 0.5 * 0.01)


def test_positive_friction_of_the_file_counts(tmp_path: Path) -> None:
    assert read_inertials(chain(tmp_path, damping="1.5"), tip="arm").friction == {"fv1": 1.5, "fc1": 0.5}
    assert read_inertials(chain(tmp_path, damping="-1"), tip="arm").friction == {"fc1": 0.5}


def test_a_link_without_mass_and_moments_that_no_body_has_are_named(tmp_path: Path) -> None:
    file = chain(tmp_path, mass=0.0, ixx=0.5)
    file.write_text(file.read_text().replace('<mass value="0.5"/>', ""))
    read = read_inertials(file, tip="arm")
    assert read.massless == (1,)
    assert read.impossible == ("arm",)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"mass": -2.0}, "link 'arm': inertial: mass and moments of inertia must not be negative"),
        ({"ixx": -0.5}, "link 'arm': inertial: mass and moments of inertia must not be negative"),
        ({"mass": float("nan")}, "link 'arm': mass value: expected a number, found 'nan'"),
        ({"damping": "much"}, "joint 'turn': dynamics damping: expected a number, found 'much'"),
    ],
)
def test_impossible_numbers_are_refused_by_element(numbers: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        read_inertials(chain(tmp_path, **numbers), tip="arm")


def test_two_masses_of_a_link_are_refused_but_not_the_same_one_twice(tmp_path: Path) -> None:
    file = chain(tmp_path, mass=2.0)
    text = file.read_text()
    file.write_text(text.replace('<mass value="2.0"/>', '<mass value="2.0"/><mass value="2.0"/>'))
    read_inertials(file, tip="arm")
    file.write_text(text.replace('<mass value="2.0"/>', '<mass value="2.0"/><mass value="3.0"/>'))
    with pytest.raises(ConfigError, match=r"link 'arm': inertial: there are 2 elements mass, expected one"):
        read_inertials(file, tip="arm")
    file.write_text(text.replace("</inertial>", '</inertial><inertial><mass value="3"/></inertial>'))
    with pytest.raises(ConfigError, match=r"link '\w+': there are 2 elements inertial, expected one"):
        read_inertials(file, tip="arm")
