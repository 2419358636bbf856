"""Tables of Denavit-Hartenberg parameters in text files: classical, or modified as Craig or Khalil write them."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, Mdh
from armident.configs.expression import evaluate
from armident.configs.mdh import modified_dh
from armident.configs.suspected_units import FULL_TURN, LONGEST_LINK
from armident.configs.yaml_loader import is_file
from armident.daq.init.geometry import Geometry, name_from, of_rows
from armident.daq.interchange.text_files import encoding_of

Convention = Literal["classical", "modified"]

NAMES = ("theta", "d", "a", "alpha")
"""Columns of a table; ``alpha, d, theta, r`` are modified parameters: ``d`` stands for ``a``, and ``r`` for ``d``."""

_GREEK = {"\u03b8": "theta", "\u03b1": "alpha", "\u03c0": "pi", "\u00b0": "", "\u2212": "-"}
"""Words for Greek letters, nothing for the sign of degrees, and a hyphen for the minus of typesetting."""
_UNIT = re.compile(r"^(.*?)\s*[\[(]\s*(\w*)\s*[\])]$")
_SCALES = {"": 1.0, "rad": 1.0, "m": 1.0, "deg": math.pi / 180, "mm": 1e-3}
_TYPES = {"revolute": "revolute", "r": "revolute", "prismatic": "prismatic", "p": "prismatic"}


@dataclass(frozen=True)
class DhRow:
    """One row of a table; angles in rad, lengths in m. The joint variable is added to ``theta`` or ``d``."""

    name: str
    type: str
    theta: float
    d: float
    a: float
    alpha: float


def from_dh_table(file: Path, convention: Convention | None) -> Geometry:
    """Geometry of a table of Denavit-Hartenberg parameters; a ConfigError has line and column.

    The header is ``theta, d, a, alpha`` or ``alpha, d, theta, r``, perhaps with ``name``, ``type`` and units (``a
    [mm]``). ``classical`` (x to the next axis) or ``modified``; ``None``: modified if there is a column ``r``.
    """
    rows, khalil, notes = _read(file)
    if khalil and convention == "classical":
        raise ConfigError(f"{file}: column r belongs to modified parameters (alpha, d, theta, r)")
    chosen = convention or ("modified" if khalil else "classical")
    made = modified(rows) if chosen == "modified" else of_classical(rows)
    geometry = of_rows(str(file), name_from(file.stem), [(r.name, r.type, m) for r, m in zip(rows, made, strict=True)])
    return Geometry(file.name, geometry.content, geometry.robot, (f"{chosen} parameters", *notes))


def modified(rows: Sequence[DhRow]) -> list[Mdh]:
    """Rows of a modified table in the names of the configuration. ``rows``: base to tip."""
    return [Mdh(alpha=row.alpha, d=row.a, theta=row.theta, r=row.d) for row in rows]


def of_classical(rows: Sequence[DhRow]) -> list[Mdh]:
    """Modified parameters of a classical table, base to tip: ``Rot(z, theta) Trans(z, d) Trans(x, a) Rot(x, alpha)``.

    Axis j is the z of frame j-1. Raises ConfigError if two axes are nearly parallel.
    """
    frame, axes, points = np.eye(4), [], []
    for row in rows:
        axes.append(frame[:3, 2].copy())
        points.append(frame[:3, 3].copy())
        frame = frame @ _turn(2, row.theta) @ _shift(2, row.d) @ _shift(0, row.a) @ _turn(0, row.alpha)
    return list(modified_dh(np.array(axes), np.array(points), [row.name for row in rows]).parameters)


def _turn(axis: int, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    if min(abs(c), abs(s)) < 1e-15:
        c, s = float(round(c)), float(round(s))
    frame = np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    frame[i, i], frame[i, j], frame[j, i], frame[j, j] = c, -s, s, c
    return frame


def _shift(axis: int, length: float) -> Array:
    frame = np.eye(4)
    frame[axis, 3] = length
    return frame


def _read(file: Path) -> tuple[list[DhRow], bool, list[str]]:
    """Rows in rad and m, True if the columns are Khalil's, and notes on units."""
    if not is_file(file):
        raise ConfigError(f"{file}: no such file")
    text = _plain(file.read_text(encoding=encoding_of(file), errors="replace"))
    lines = [(k, line) for k, line in enumerate(text.splitlines(), start=1) if line.strip() and line.strip()[0] != "#"]
    if len(lines) < 2:
        raise ConfigError(f"{file}: expected a header line with {', '.join(NAMES)} and a row for every joint")
    delimiter = next((d for d in ("\t", ";", ",", "|") if d in lines[0][1]), " ")
    cells = [(k, next(csv.reader([line.strip(), ""], delimiter=delimiter, skipinitialspace=True))) for k, line in lines]
    header, scales = _header(cells[0][1])
    khalil = "r" in header
    wanted = ("alpha", "d", "theta", "r") if khalil else NAMES
    absent = [name for name in wanted if name not in header]
    if absent:
        raise ConfigError(f"{file}: no column {', '.join(absent)}; found {', '.join(header):.160}")
    rows: list[DhRow] = []
    for k, row in cells[1:]:
        if len(row) != len(header):
            raise ConfigError(f"{file}: line {k}: {len(row)} values, the header has {len(header)}")
        named = {name: value.strip() for name, value in zip(header, row, strict=True)}
        values = {name: evaluate(named[name], {}, f"{file}: line {k}, column {name}") * scales[name] for name in wanted}
        kind = _TYPES.get((named.get("type") or "revolute").lower())
        if kind is None:
            raise ConfigError(f"{file}: line {k}: type {named['type']!r:.60}; expected revolute or prismatic")
        if khalil:
            values = {"alpha": values["alpha"], "theta": values["theta"], "a": values["d"], "d": values["r"]}
        rows.append(DhRow(named.get("name") or f"joint_{len(rows) + 1}", kind, **values))
    made, notes = _in_si(file, rows)
    return made, khalil, notes


def _plain(text: str) -> str:
    for letter, word in _GREEK.items():
        text = text.replace(letter, word)
    return text


def _header(cells: Sequence[str]) -> tuple[list[str], Mapping[str, float]]:
    """Names of the columns without units, and the factor of each column."""
    names, scales = [], {}
    for cell in cells:
        found = _UNIT.match(cell.strip())
        name = (found[1] if found else cell).strip().lower()
        name = {"joint": "name", "kind": "type"}.get(name, name)
        unit = found[2].lower() if found else ""
        if unit not in _SCALES:
            raise ConfigError(f"column {cell!r:.60}: unknown unit; expected rad, deg, m or mm")
        names.append(name)
        scales[name] = _SCALES[unit]
    return names, scales


def _in_si(file: Path, rows: Sequence[DhRow]) -> tuple[list[DhRow], list[str]]:
    """Rows in rad and m where magnitudes tell that a table without units is in degrees or millimetres, and notes."""
    notes, factors = [], {}
    for what, keys, most, factor, unit in (
        ("angles", ("theta", "alpha"), FULL_TURN, math.pi / 180, "degrees"),
        ("lengths", ("a", "d"), LONGEST_LINK, 1e-3, "millimetres"),
    ):
        largest = max(abs(getattr(row, key)) for row in rows for key in keys)
        if not largest * factor <= most:
            raise ConfigError(f"{file}: {what}: {largest:g} is beyond every arm, in {unit} too")
        factors[what] = factor if largest > most else 1.0
        notes += [f"{what} are in {unit} by their magnitude"] if largest > most else []
    angle, length = factors["angles"], factors["lengths"]
    return [DhRow(r.name, r.type, angle * r.theta, length * r.d, length * r.a, angle * r.alpha) for r in rows], notes
