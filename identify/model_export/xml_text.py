"""Numbers, rotations and files of the XML formats."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from armident.identify.documents.files import write_atomically
from armident.identify.robot.chain import Floats

VERTICAL = 1e-12
"""Cosine of the pitch angle below which roll and yaw turn about the same axis: the yaw is then zero."""


def numbers(values: float | Iterable[float] | Floats) -> str:
    """Return numbers as text that reads back exactly. ``values``: one number or a sequence."""
    return " ".join(repr(float(value) + 0.0) for value in np.atleast_1d(np.asarray(values, dtype=np.float64)))


def roll_pitch_yaw(rotation: Floats) -> Floats:
    """Return the fixed-axis angles (3,) of a rotation, ``Rot(z, yaw) Rot(y, pitch) Rot(x, roll)``, rad."""
    r = rotation
    level = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = np.arctan2(-r[2, 0], level)
    if level < VERTICAL:
        return np.array([np.arctan2(-r[1, 2], r[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])


def write_xml(root: ET.Element, path: Path) -> None:
    """Write an indented XML file."""
    ET.indent(root)
    write_atomically(path, '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n")
