"""Torques of the wrong scale: they give the arm a weight that it cannot have."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armident.configs import RobotConfig, load_robot
from armident.configs.urdf_inertials import read_inertials
from armident.identify.identification.verdict import judge
from armident.identify.model_export.link_frames import mdh_transform
from armident.identify.robot.arm import ArmModel
from armident.identify.setup.bench import make_bench
from armident.identify.setup.check import check_setup
from armident.identify.setup.fit import Hypothesis
from armident.identify.setup.result import SetupFinding
from armident.identify.setup.weight import weight_findings
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups


@pytest.fixture(scope="module")
def with_masses(arm: RobotConfig) -> RobotConfig:
    """Return the arm with the masses that it has in its recordings, as a URDF gives them."""
    names = ArmModel.from_config(arm).names
    standard = dict(zip(names, setups.physical_parameters(arm, 0), strict=True))
    return arm.with_urdf_facts(("",) * arm.n, {name: v for name, v in standard.items() if name.startswith("m")})


def _weight(experiments: list[Experiment], robot: RobotConfig, factor: float) -> list[SetupFinding]:
    n = robot.n
    bench = make_bench([replace(e, tau=factor * e.tau) for e in experiments], robot, np.ones(n, np.bool_))
    return weight_findings(bench, Hypothesis(np.eye(n), np.eye(n), np.array(robot.gravity), np.zeros(n)), robot)


@pytest.mark.parametrize("factor", [0.1, 8.0])
def test_torques_that_contradict_the_masses_of_the_urdf_are_named_with_their_ratio(
    with_masses: RobotConfig, healthy: list[Experiment], factor: float
) -> None:
    (finding,) = _weight(healthy, with_masses, factor)
    assert f"{factor:.2g} times those that the masses" in finding.message
    assert not finding.decisive


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_masses_that_differ_as_with_a_tool_are_no_finding(
    with_masses: RobotConfig, healthy: list[Experiment], factor: float
) -> None:
    assert _weight(healthy, with_masses, factor) == []


def test_without_masses_an_arm_lighter_than_any_of_its_reach_is_named(
    arm: RobotConfig, healthy: list[Experiment]
) -> None:
    assert _weight(healthy, arm, 1.0) == []
    (finding,) = _weight(healthy, arm, 0.005)
    assert "first moment" in finding.message
    assert "kg m and more" in finding.message


def test_a_short_motion_of_the_shoulder_tells_no_weight(arm: RobotConfig, healthy: list[Experiment]) -> None:
    still = [replace(e, q=np.concatenate([e.q[:, :1], 0.1 * e.q[:, 1:]], axis=1)) for e in healthy]
    assert _weight(still, arm, 0.005) == []


def with_file(
    arm: RobotConfig, seed: int, *, of_base: bool, error: float = 0.15, other: dict[str, float] | None = None
) -> RobotConfig:
    """Return an arm with the masses of a file that err by a share, with centres in its links' frames or in its base's.

    ``other``: factors of the moments of some links in the file, by name.
    """
    rng = np.random.default_rng([seed, 5])
    truth = dict(zip(ArmModel.from_config(arm).names, setups.physical_parameters(arm, 0), strict=True))
    placement = np.eye(4)
    read: dict[str, float] = {}
    meant: dict[str, float] = {}
    for k, joint in enumerate(arm.joints, start=1):
        placement = placement @ mdh_transform(joint.mdh)
        moments = np.array([truth[f"{name}{k}"] for name in ("mx", "my", "mz", "m")])
        moments *= 1.0 + error * rng.uniform(-1.0, 1.0, 4)
        moments[:3] *= (other or {}).get(joint.name, 1.0)
        # The file holds the centres in one frame, and is read in the other one.
        turned = placement @ moments if of_base else np.linalg.solve(placement, moments)
        first, second = (turned, moments) if of_base else (moments, turned)
        for into, values in ((read, first), (meant, second)):
            into |= {f"{name}{k}": float(value) for name, value in zip(("mx", "my", "mz", "m"), values, strict=True)}
    return arm.with_urdf_facts(("",) * arm.n, read, meant)


@pytest.mark.parametrize("seed", range(4))
def test_centres_of_mass_in_the_frame_of_the_base_are_named(
    arm: RobotConfig, healthy: list[Experiment], seed: int
) -> None:
    (finding,) = _weight(healthy, with_file(arm, seed, of_base=True), 1.0)
    assert finding.kind == "urdf_centres"
    assert finding.probability > 0.99
    assert finding.message.startswith("the centres of mass of the URDF are in the frame of its base")
    assert not finding.decisive


@pytest.mark.parametrize("seed", range(4))
def test_centres_of_mass_in_the_frames_of_the_links_are_no_finding(
    arm: RobotConfig, healthy: list[Experiment], seed: int
) -> None:
    assert _weight(healthy, with_file(arm, seed, of_base=False), 1.0) == []


def test_a_link_whose_centre_is_wrong_is_named_with_standard_deviations(
    arm: RobotConfig, healthy: list[Experiment]
) -> None:
    (finding,) = _weight(healthy, with_file(arm, 0, of_base=False, other={"axis_3": 3.0}), 1.0)
    assert finding.kind == "urdf_masses"
    assert "axis_3" in finding.joints
    assert re.search(r"axis_3 by \d+ % \(\d+ standard deviations\)", finding.message)
    assert "identified parameters do not depend on them" in finding.remedy


def test_wrong_masses_of_a_urdf_leave_an_identification_as_it_is(arm: RobotConfig, healthy: list[Experiment]) -> None:
    robot = with_file(arm, 0, of_base=False, other={"axis_3": 3.0})
    found = check_setup(healthy, robot)
    assert [finding.kind for finding in found.findings] == ["urdf_masses"]
    assert judge([], found).level == "trustworthy"


def test_the_other_reading_of_a_file_is_that_of_the_frame_of_its_base(tmp_path: Path) -> None:
    """The same arm, with its centres in the frames of the links, and in that of the base."""
    lower = '<inertial><origin xyz="{xyz}"/><mass value="2"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    files = []
    for name, xyz in (("link", "0.1 0.2 0.3"), ("base", "0.6 0.2 0.3")):
        files.append(tmp_path / f"{name}.urdf")
        files[-1].write_text(URDF.format(inertial=lower.format(xyz=xyz)))
    right, of_base = (read_inertials(file) for file in files)
    for name in ("mx", "my", "mz", "m"):
        assert of_base.of_base[f"{name}2"] == pytest.approx(right.standard[f"{name}2"])
    assert of_base.standard["mx2"] == pytest.approx(1.2)


URDF = """<robot name="two">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="3"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower">{inertial}</link>
  <joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="50" velocity="3"/></joint>
  <joint name="b" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="20" velocity="3"/></joint>
</robot>"""
LOWER = '<inertial><mass value="{mass}"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'


@pytest.mark.parametrize(("lower", "moment"), [(LOWER.format(mass=2), 0.6), ("", None), (LOWER.format(mass=-1), None)])
def test_first_moments_are_read_where_every_link_has_a_mass(tmp_path: Path, lower: str, moment: float | None) -> None:
    (tmp_path / "two.urdf").write_text(URDF.format(inertial=lower))
    config = tmp_path / "two.yaml"
    config.write_text(
        "schema: armident/robot/1\nname: two\nurdf: {file: two.urdf}\ngravity: [0.0, -9.81, 0.0]\njoints:\n"
        "  - {name: a, limits: {acceleration: 9}}\n  - {name: b, limits: {acceleration: 9}}\n"
    )
    found = load_robot(config).first_moments
    assert found.get("mx1") == (None if moment is None else pytest.approx(moment))
