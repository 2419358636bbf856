"""Poses, shapes and colours of the arm that viewers show."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from matplotlib import colormaps

from armident.configs import load_robot
from armident.identify.model_export.source_urdf import SourceUrdf, source_of
from armident.identify.view import arm as module
from armident.identify.view.arm import FULL, arm_of, colours
from tests.urdf_chains import configuration, random_urdf

TETRAHEDRON = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


@pytest.mark.parametrize("seed", range(4))
def test_links_of_any_urdf_move_as_in_pinocchio(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    file = tmp_path / "random.urdf"
    file.write_text(random_urdf(rng, 5, right_angles=seed % 2 == 0))
    (tmp_path / "random.yaml").write_text(configuration(file, 5, np.array([0.0, 0.0, -9.81])))
    arm, _ = arm_of(load_robot(tmp_path / "random.yaml"), source_of(tmp_path / "random.yaml"))
    model = pin.buildModelFromUrdf(str(file))
    state, q = model.createData(), rng.uniform(-1.0, 1.0, (3, 5))
    translations, quaternions = arm.poses(q)
    for row, positions in enumerate(q):
        pin.forwardKinematics(model, state, pin.integrate(model, pin.neutral(model), positions))
        frame = pin.SE3.Identity()
        for j in range(5):
            turn = pin.Quaternion(quaternions[row, j]).toRotationMatrix()
            frame = frame * pin.SE3(turn, translations[row, j])
            np.testing.assert_allclose(frame.homogeneous, state.oMi[j + 1].homogeneous, atol=1e-9)


def meshed(folder: Path, *names: str) -> SourceUrdf:
    """A URDF of one joint whose moved link has meshes of these names, twice as large as their files."""
    mesh = '<mesh filename="{}" scale="2 2 2"/>'
    shapes = "".join(f"<visual><geometry>{mesh.format(name)}</geometry></visual>" for name in names)
    (folder / "arm.urdf").write_text(
        f'<robot name="arm"><link name="base"/><link name="tip">{shapes}</link>'
        '<joint name="joint_1" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/>'
        '<origin xyz="0 0 0.5"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    (folder / "arm.yaml").write_text(
        "schema: armident/robot/1\nname: arm\nurdf: {file: arm.urdf}\ntransmission: [[1.0]]\n"
    )
    corners = ["outer loop", *("vertex {} {} {}",) * 3, "endloop"]
    facets = ("\n".join(corners).format(*np.ravel([TETRAHEDRON[k] for k in face])) for face in FACES)
    text = "".join(f"facet normal 0 0 0\n{facet}\nendfacet\n" for facet in facets)
    (folder / "tetrahedron.stl").write_text(f"solid t\n{text}endsolid t\n")
    return SourceUrdf(folder / "arm.urdf")


def test_meshes_are_shown_in_the_frame_of_their_link_and_others_are_named(tmp_path: Path) -> None:
    source = meshed(tmp_path, "tetrahedron.stl", "package://nowhere/missing.dae")
    arm, remarks = arm_of(load_robot(tmp_path / "arm.yaml"), source)
    assert remarks == [f"{tmp_path / 'arm.urdf'}: not shown: missing.dae of link tip"]
    found = {tuple(np.round(corner, 6).tolist()) for corner in arm.links[1].reshape(-1, 3)}
    assert found == {tuple(2 * value for value in corner) for corner in TETRAHEDRON}
    assert arm.links[1].shape == (4, 3, 3)
    # coal has single precision. The base has no shape: a line to the joint.
    assert arm.links[0].reshape(-1, 3)[:, 2].max() == pytest.approx(0.5)


def test_a_mesh_of_many_triangles_is_shown_as_its_hull_which_looks_outwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_TRIANGLES", 3)
    source = meshed(tmp_path, "tetrahedron.stl")
    arm, _ = arm_of(load_robot(tmp_path / "arm.yaml"), source)
    middle = 2 * np.mean(TETRAHEDRON, axis=0)
    for corners in arm.links[1]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert normal @ (corners.mean(axis=0) - middle) > 0.0


def test_a_mesh_that_is_no_mesh_is_named(tmp_path: Path) -> None:
    source = meshed(tmp_path, "tetrahedron.stl")
    (tmp_path / "tetrahedron.stl").write_text("nothing")
    arm, remarks = arm_of(load_robot(tmp_path / "arm.yaml"), source)
    assert remarks == [f"{tmp_path / 'arm.urdf'}: not shown: tetrahedron.stl of the link of joint_1"]
    assert arm.links[1].size == 0


def test_colours_grow_brighter_with_the_unexplained_torque_up_to_their_end() -> None:
    levels = np.linspace(0.0, FULL, 11)
    shown = colours(levels)
    brightness = shown[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert all(low < high for low, high in pairwise(brightness))
    np.testing.assert_array_equal(colours(-levels), shown)
    np.testing.assert_array_equal(colours(np.array([1e9])), shown[-1:])
    np.testing.assert_allclose(shown[0] / 255, colormaps["cividis"](0.0), atol=1 / 255)
