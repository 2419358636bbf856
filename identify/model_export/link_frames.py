"""Frames of links and joints in an exported file: those of the source URDF, or modified Denavit-Hartenberg frames."""

from dataclasses import dataclass

import numpy as np

from armident.configs import RobotConfig
from armident.configs.schema.robot import Mdh
from armident.identify.robot.chain import Floats, cos_sin


@dataclass(frozen=True, eq=False)
class LinkFrames:
    """Frames of n links and their joints, all joint variables zero.

    Parameters
    ----------
    links, joints
        Names of the moving links and of their joints, (n,).
    placements
        Frame of each link in that of the link before it, the first in the base link, homogeneous, (n, 4, 4).
    axes
        Unit vector of each joint axis in the frame of its link, (n, 3).
    from_mdh
        Modified Denavit-Hartenberg frame of each link in the frame of the link, homogeneous, (n, 4, 4).
    frame_0
        Rotation of frame 0 of the robot configuration in the base link, (3, 3).
    gravity
        Acceleration of gravity in the base link, m/s^2, (3,).
    endless
        True for joints that turn without end, (n,).
    """

    base: str
    links: tuple[str, ...]
    joints: tuple[str, ...]
    placements: Floats
    axes: Floats
    from_mdh: Floats
    frame_0: Floats
    gravity: Floats
    endless: tuple[bool, ...]

    @property
    def free_base(self) -> str:
        """Name of the base link for formats in which ``world`` is the world itself."""
        free = (
            name for name in (self.base, "base_link", "mount_link", "arm_base") if name not in ("world", *self.links)
        )
        return next(free)


def mdh_link_frames(robot: RobotConfig) -> LinkFrames:
    """Return the modified Denavit-Hartenberg frames of a robot configuration as link frames.

    ``robot``: configuration, n joints. A link is named after its joint.
    """
    n = robot.n
    links = tuple(f"{joint.name}_link" for joint in robot.joints)
    return LinkFrames(
        base="base_link" if "base_link" not in links else "mount_link",
        links=links,
        joints=tuple(joint.source_name or joint.name for joint in robot.joints),
        placements=np.stack([mdh_transform(joint.mdh) for joint in robot.joints]),
        axes=np.tile([0.0, 0.0, 1.0], (n, 1)),
        from_mdh=np.tile(np.eye(4), (n, 1, 1)),
        frame_0=np.eye(3),
        gravity=np.array(robot.gravity),
        endless=tuple(j.type == "revolute" and not np.isfinite(j.limits.position).all() for j in robot.joints),
    )


def mdh_transform(mdh: Mdh) -> Floats:
    """Return frame j in frame j-1 at position zero, ``Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r)``, (4, 4).

    ``mdh``: modified Denavit-Hartenberg parameters (thesis section 2.1.1).
    """
    (ca, sa), (ct, st) = cos_sin(mdh.alpha), cos_sin(mdh.theta)
    return np.array(
        [
            [ct, -st, 0.0, mdh.d],
            [ca * st, ca * ct, -sa, -sa * mdh.r],
            [sa * st, sa * ct, ca, ca * mdh.r],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
