"""Placement of joints in URDF: fixed-axis angles and quaternions, exact where rounded right angles are meant."""

import math
from collections.abc import Sequence
from decimal import Decimal

import numpy as np

from armident.arrays import Array

WRITTEN_DECIMALS = 4
"""Minimum number of decimals of an angle that is rounded to the multiple of 15 degrees with the same decimals."""

RIGHT_ANGLE = 1e-3
"""Largest distance (rad) of an angle with two or three decimals from the right angle that is meant: 1.57, 1.571. Such a
tilt is below the tolerance of joints, and makes nearly dependent parameters of dependent ones."""

LENGTH_TOLERANCE = 0.01
"""Largest deviation of the length of a quaternion from 1; two written decimals make 0.01."""

EXACT = 1e-12
"""Largest distance of an element of a rotation matrix from 0 or 1 that is rounding of double precision."""


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation matrix of URDF's fixed-axis angles, exact for right angles: ``Rot(z, y) Rot(y, p) Rot(x, r)``."""
    (cr, sr), (cp, sp), (cy, sy) = (_cos_sin(angle) for angle in (roll, pitch, yaw))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    matrix: Array = about_z @ about_y @ about_x
    return matrix


def fixed_axis_angles(matrix: Array) -> tuple[float, float, float]:
    """Fixed-axis angles ``roll, pitch, yaw`` of a rotation, rad; yaw is 0 at a pitch of 90 degrees."""
    pitch = math.atan2(-matrix[2, 0], math.hypot(matrix[0, 0], matrix[1, 0]))
    if math.hypot(matrix[0, 0], matrix[1, 0]) < EXACT:
        return math.atan2(-matrix[1, 2], matrix[1, 1]), pitch, 0.0
    return math.atan2(matrix[2, 1], matrix[2, 2]), pitch, math.atan2(matrix[1, 0], matrix[0, 0])


def _cos_sin(angle: float) -> tuple[float, float]:
    c, s = math.cos(angle), math.sin(angle)
    return (float(round(c)), float(round(s))) if min(abs(c), abs(s)) < 1e-15 else (c, s)


def rounded_angle(word: str) -> float:
    """Angle (rad) as written, or the multiple of 15 degrees of which it is a rounded or truncated value.

    With two or three decimals: the right angle that it is close to.
    """
    value, exponent = float(word), Decimal(word).as_tuple().exponent
    if not isinstance(exponent, int) or exponent > -2:
        return value
    coarse = exponent > -WRITTEN_DECIMALS
    step, tolerance = (math.pi / 2, RIGHT_ANGLE) if coarse else (math.pi / 12, 10.0**exponent)
    multiple = round(value / step) * step
    return multiple if abs(value - multiple) < tolerance else value


def rotation_of_quaternion(quaternion: Sequence[float]) -> Array:
    """Rotation matrix of a quaternion ``x, y, z, w`` of length 1 (else ValueError), exact for right angles."""
    values = np.array(quaternion, dtype=np.float64)
    length = float(np.linalg.norm(values))
    if not abs(length - 1.0) <= LENGTH_TOLERANCE:
        raise ValueError(f"the length of the quaternion is {length:.4g}, expected 1")
    x, y, z, w = values / length
    matrix = np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )
    whole = np.round(matrix)
    exact: Array = np.where(np.abs(matrix - whole) < EXACT, whole + 0.0, matrix)
    return exact
