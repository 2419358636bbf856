"""The arm in 3D: link frames along a motion, shapes of the links as triangles, colours of the joints."""

from dataclasses import dataclass

import coal
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.configs.schema.collision import BASE
from armident.configs.urdf import joint_names, link_placements, mdh_of
from armident.configs.urdf_shapes import UrdfShape, read_shapes
from armident.configs.urdf_tree import read_chain
from armident.identify.excitation.link_geometry import points_of
from armident.identify.model_export.link_frames import LinkFrames, mdh_link_frames
from armident.identify.model_export.source_urdf import SourceUrdf, source_frames

FULL = 10.0
"""Unexplained torque at the bright end of the colours, standard deviations; noise alone has 1."""
MOST_TRIANGLES = 20_000
"""Triangles of a mesh, above which its convex hull is shown."""
SMALLEST_ARM = 0.3
"""Length of an arm, m, for the size of its markers; a single axis has none."""


@dataclass(frozen=True, eq=False)
class Arm:
    """Frames of the n links, and triangles (K, 3, 3) of the n + 1 ``links`` in them; ``length``: joint to joint, m."""

    frames: LinkFrames
    revolute: tuple[bool, ...]
    links: tuple[Array, ...]
    length: float

    @property
    def axes(self) -> tuple[Array, float, float]:
        """Cylinders about the joint axes: quaternions (n, 4) that turn z to them; radius and height, m."""
        return np.stack([_onto(axis).as_quat() for axis in self.frames.axes]), self.length / 20, self.length / 8

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Return each link in the one before it at q (N, n): translations (N, n, 3), quaternions xyzw (N, n, 4)."""
        translations = np.tile(self.frames.placements[:, :3, 3], (len(q), 1, 1))
        quaternions = np.empty((len(q), len(self.revolute), 4))
        for j, (placement, axis) in enumerate(zip(self.frames.placements, self.frames.axes, strict=True)):
            turned = Rotation.from_matrix(np.tile(placement[:3, :3], (len(q), 1, 1)))
            moved = q[:, j, None] * axis
            if self.revolute[j]:
                turned = turned * Rotation.from_rotvec(moved)
            else:
                translations[:, j] += moved @ placement[:3, :3].T
            quaternions[:, j] = turned.as_quat()
        return translations, quaternions


def arm_of(robot: RobotConfig, source: SourceUrdf | None) -> tuple[Arm, list[str]]:
    """Return the arm of a URDF, else with lines between its joints, and remarks on meshes that cannot be shown."""
    frames = mdh_link_frames(robot) if source is None else source_frames(source, robot)
    bodies: list[list[Array]] = [[] for _ in range(robot.n + 1)]
    remarks = ["no URDF: the arm is shown as lines between its joints; --urdf FILE shows its links"]
    if source is not None:
        bodies, remarks = _bodies(source)
    length = max(float(np.linalg.norm(frames.placements[:, :3, 3], axis=1).sum()), SMALLEST_ARM)
    ends = [*frames.placements[:, :3, 3], np.zeros(3)]
    for body, end in zip(bodies, ends, strict=True):
        if not body and np.any(end):
            body.append(_stick(end, length / 60))
    links = tuple(np.concatenate([np.empty((0, 3, 3)), *body]) for body in bodies)
    return Arm(frames, tuple(joint.type == "revolute" for joint in robot.joints), links, length), remarks


def colours(deviations: Array) -> NDArray[np.uint8]:
    """Return colours (..., 4) of unexplained torques (...) in standard deviations; cividis is perceptually even."""
    return np.asarray(colormaps["cividis"](np.clip(np.abs(deviations) / FULL, 0.0, 1.0), bytes=True))


def _bodies(source: SourceUrdf) -> tuple[list[list[Array]], list[str]]:
    """Return triangles of the base link and of each moved link in its frame, and remarks."""
    joints = read_chain(source.file, source.base, source.tip)
    names = joint_names([joint.name for joint in joints], source.file)
    placements = link_placements(joints, names, mdh_of(joints, source.file))
    found = read_shapes(source.file, source.base, source.tip)
    bodies: dict[str, list[Array]] = {name: [] for name in (BASE, *names)}
    unseen = list(found.missing)
    for shape in found.shapes:
        triangles = _triangles(shape)
        if triangles is None:
            unseen.append(f"{shape.kind if shape.mesh is None else shape.mesh.name} of the link of {shape.link}")
            continue
        place = np.linalg.solve(placements[shape.link], shape.placement)
        bodies[shape.link].append(triangles @ place[:3, :3].T + place[:3, 3])
    remarks = [f"{source.file}: not shown: {', '.join(unseen)}"] if unseen else []
    return list(bodies.values()), remarks


def _triangles(shape: UrdfShape) -> Array | None:
    """Return the triangles (K, 3, 3) of a shape in its frame; ``None`` if it cannot be read or is flat."""
    if shape.mesh is not None:
        try:
            mesh = coal.MeshLoader().load(str(shape.mesh), np.array(shape.size))
        except (RuntimeError, ValueError):
            return None
        points = np.asarray(mesh.vertices(), dtype=np.float64).reshape(-1, 3)
        if 0 < mesh.num_tris <= MOST_TRIANGLES and np.isfinite(points).all():
            corners = [tuple(mesh.tri_indices(k)[i] for i in range(3)) for k in range(mesh.num_tris)]
            return np.asarray(points[np.array(corners)])
    elif shape.kind == "sphere":
        height = np.linspace(-1.0, 1.0, 13)[1:-1]
        rings = [np.sqrt(1 - z**2) * _circle(24) + [0.0, 0.0, z] for z in height]
        points = shape.size[0] * np.concatenate([*rings, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    else:
        points = np.asarray(points_of(shape))
    try:
        return _hull(points)
    except (QhullError, ValueError):
        return None


def _hull(points: Array) -> Array:
    """Return the triangles (K, 3, 3) of the convex hull of points, seen from outside counter-clockwise."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.sum(normal * hull.equations[:, :3], axis=1) < 0.0
    corners[inward] = corners[inward][:, ::-1]
    return np.asarray(corners)


def _stick(end: Array, radius: float) -> Array:
    """Return the triangles of a thin cylinder from the origin to a point (3,)."""
    rims = [radius * _circle(8) + [0.0, 0.0, height] for height in (0.0, float(np.linalg.norm(end)))]
    return _hull(_onto(end).apply(np.concatenate(rims)))


def _onto(axis: Array) -> Rotation:
    """Return a rotation of z to the direction of a vector (3,)."""
    return Rotation.align_vectors(axis[None] / np.linalg.norm(axis), [[0.0, 0.0, 1.0]])[0]


def _circle(points: int) -> Array:
    """Return points (K, 3) on the unit circle about z."""
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(points)])
