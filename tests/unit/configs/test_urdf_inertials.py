"""Masses of a URDF in the frames of the model, against Pinocchio's own URDF reader."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest

from armident.configs import ConfigError, load_robot
from armident.configs.loading import load_inertials
from armident.configs.urdf_inertials import read_inertials
from armident.virtual_robot.model import build_model
from tests.urdf_chains import configuration, random_urdf

pin: Any = pinocchio

LINK = (
    '<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="{mass}"/>'
    '<inertia ixx="{ixx}" iyy="0.02" izz="0.02"/></inertial></link>'
)
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1"/>{more}</joint>'
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
