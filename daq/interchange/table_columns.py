"""Columns of a table by quantity and joint: ``q1``, ``q0``, names of joints, and units in names."""

import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.daq.interchange.column_units import SCALES, plain_unit
from armident.daq.interchange.demand_names import of_another_quantity, without_demand
from armident.daq.interchange.joint_names import match_joints
from armident.daq.interchange.text_files import listed, shortened

NAMES: Mapping[str, tuple[str, ...]] = {
    "time": ("t", "time", "times", "timestamp", "timestamps", "__time", "stamp", "elapsed", "duration"),
    "position": ("q", "qm", "position", "positions", "actual_q", "state.q"),
    "torque": ("tau", "torque", "torques", "effort", "efforts", "actual_current_as_torque", "tau_J", "state.tau_J"),
    "current": ("current", "currents", "actual_current"),
    "voltage": ("voltage", "vir"),
    "demand": ("qr", "qg", "state.q_d"),
}
"""Accepted names of each quantity; ``q`` also stands for columns ``q1..qn`` and ``q0..q(n-1)``. A demand is also a
position with a word for a demand in its name (`armident.daq.interchange.demand_names`)."""

_WORDS: Mapping[str, frozenset[str]] = {
    "position": frozenset({"position", "positions", "pos", "q"}),
    "torque": frozenset({"effort", "efforts", "eff", "torque", "torques", "trq", "tau"}),
    "current": frozenset({"current", "currents"}),
    "voltage": frozenset({"voltage", "voltages"}),
}
"""Words of a column name, beside the name of a joint, that tell its quantity."""
_MEASURED = frozenset({"actual", "measured", "feedback"})
"""Words of a column name that tell a measurement, as others do without them."""
_WORD = re.compile(r"[^\W_]+")
_UNIT = re.compile(r"^(.*?)\s*[\[(]([^\])]*[^\])\d\s][^\])]*)[\])]$")
"""A unit in brackets; digits alone are the number of a joint."""
_TIME_UNIT = re.compile(r"^(.*?)(?:_|\s*/\s*)(s|sec|ms|us|ns)$", re.IGNORECASE)
_UNIT_AT_END = re.compile(
    r"^(.*?[^\W_])(?:[_ ]|\s*/\s*)(rad|mrad|deg(?:rees?)?|°|mm|n ?m|n mm|n cm|mn ?m|ma)$", re.IGNORECASE
)

Table = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class TableColumns:
    """Values (N, n) of one quantity, labels of the columns, and joint of each column (empty: they are numbered)."""

    values: NDArray[np.float64]
    labels: tuple[str, ...]
    notes: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()


def without_units(
    table: Table, units: Sequence[str] = ()
) -> tuple[dict[str, NDArray[np.float64]], dict[str, str], list[str]]:
    """Return the table in SI without units in its names (``q1 [deg]``, ``time_ms``), the units by name, and notes.

    Units that are not known are kept, for `check_unit`. ``units``: from a line of units, one per column, or empty.
    """
    made: dict[str, NDArray[np.float64]] = {}
    stated: dict[str, str] = {}
    converted = []
    for k, (name, values) in enumerate(table.items()):
        bare, unit = name, units[k].strip("[]() ") if k < len(units) else ""
        if found := _UNIT.match(name) or _UNIT_AT_END.match(name):
            bare, unit = found[1].strip(), found[2].strip()
        if (found := _TIME_UNIT.match(name)) and found[1].lower() in NAMES["time"]:
            bare, unit = found[1], found[2]
        factor = SCALES.get(plain_unit(unit), 1.0)
        if bare.lower() not in NAMES["time"] and factor != 1.0:
            values = values * factor
            converted.append(f"{name} from {unit}")
        if bare in made:
            raise DataError(f"two columns are named {shortened(bare)}; found {listed(list(table))}")
        made[bare] = values
        if unit:
            stated[bare] = unit
    return made, stated, [f"converted to SI units: {listed(converted)}"] if converted else []


def find_time(table: Table, name: str | None = None) -> tuple[str, NDArray[np.float64]] | None:
    """Return name and values (N,) of the column of times, or ``None``; ``name``: stated by the user."""
    if name is not None and name not in table:
        raise DataError(f"no column named {name!r}; found {listed(list(table))}")
    lower = {each.lower(): each for each in reversed(list(table))}
    for base in (name,) if name is not None else NAMES["time"]:
        found = base if base in table else lower.get(base.lower())
        if found is not None:
            values = table[found]
            if values.ndim != 1:
                raise DataError(f"{found} has {values.shape[-1]} axes, expected one column of times")
            return found, values
    return None


def find_columns(
    table: Table,
    quantity: str,
    robot: RobotConfig,
    name: str | None = None,
    *,
    by_position: bool = False,
    joints: Sequence[str] | None = None,
) -> TableColumns | None:
    """Return the columns of a quantity in the robot's order, or ``None``; ``name``: stated by the user.

    That is an array, the beginning of numbered columns, or the word beside the names of joints.
    """
    for base in (name,) if name is not None else NAMES[quantity]:
        found = _numbered(table, base, robot.n)
        if found is not None:
            return found
    if name is not None:
        found = _by_joint(table, frozenset({name.lower()}), robot, by_position, joints)
        if found is None:
            raise DataError(f"no column named {name!r}; found {listed(list(table))}")
        return found
    if quantity == "demand":
        return _demand(table, robot, by_position, joints)
    return _by_joint(table, _WORDS.get(quantity, frozenset()), robot, by_position, joints)


def unused_demand(table: Table) -> str:
    """Return a sentence on columns that name a demand, for a table in which no demand was found; empty without any."""
    named = [name for name in table if without_demand(name) is not None]
    if not named:
        return ""
    return (
        f"without a demand: {listed(named)} cannot be assigned to the joints as positions; "
        "--map demand=NAME takes NAME1..NAMEn"
    )


def _demand(table: Table, robot: RobotConfig, by_position: bool, joints: Sequence[str] | None) -> TableColumns | None:
    """Return the positions with a word for a demand in their names, such as ``q1_ref``, ``reference1``, ``elbow_cmd``.

    Names alone decide here, so that columns which do not fit the joints are no error (`unused_demand`).
    """
    origin: dict[str, str] = {}
    twice = []
    for name in table:
        rest = without_demand(name)
        if rest is None or of_another_quantity(rest):
            continue
        if origin.setdefault(rest, name) != name:
            twice.append(name)
    positions = {rest: table[name] for rest, name in origin.items()}
    found = None
    for base in ("", *NAMES["position"]):
        try:
            found = found or _numbered(positions, base, robot.n)
        except DataError:
            continue
    try:
        found = found or _by_joint(positions, _WORDS["position"], robot, by_position, joints)
        columns = [rest for rest, values in positions.items() if values.ndim == 1]
        if found is None and columns:
            match = match_joints(columns, robot.joints, joints=joints)
            found = TableColumns(np.stack([positions[one] for one in match.names], axis=1), match.names, match.remarks)
    except (DataError, ValueError):
        return None
    if found is None:
        return None
    labels = tuple(origin.get(label, label) for label in found.labels)
    notes = [*found.notes] + ([f"demand taken from {listed(labels)}, not from {listed(twice)}"] if twice else [])
    return TableColumns(found.values, labels, tuple(notes))


def _numbered(table: Table, base: str, n: int) -> TableColumns | None:
    """Return an array of a name, or the columns ``base1..basen`` or ``base0..base(n-1)``."""
    found = list(table)
    lower = {each.lower(): each for each in reversed(found)}
    whole = table.get(base, table.get(lower.get(base.lower(), "")))
    if whole is not None:
        values = whole[:, None] if whole.ndim == 1 else whole
        if values.ndim != 2 or values.shape[1] != n:
            raise DataError(f"{base} has {values.shape[-1]} axes, the robot has {n}; found {listed(found)}")
        return TableColumns(values, (base,) * n if whole.ndim == 1 else tuple(f"{base}{j + 1}" for j in range(n)))
    numbers: dict[int, str] = {}
    pattern = re.escape(base) + r"[_.\[( ]?(\d{1,2})[\])]?"
    for flags in (re.NOFLAG, re.IGNORECASE):
        # Names of this case first: Q1 beside q1 is another quantity.
        if not numbers.keys() & {0, 1}:
            numbers = {int(digits[1]): each for each in found[::-1] if (digits := re.fullmatch(pattern, each, flags))}
    if not numbers.keys() & {0, 1}:
        return None
    first = 0 if 0 in numbers else 1
    labels = [numbers.get(first + j, f"{base}{first + j}") for j in range(n)]
    absent = [label for j, label in enumerate(labels) if first + j not in numbers]
    if absent:
        raise DataError(f"no column {absent[0]}, the robot has {n} joints; found {listed(found)}")
    if first + n in numbers:
        raise DataError(f"has a column {numbers[first + n]}, but the robot has {n} joints; found {listed(found)}")
    if any(table[label].ndim != 1 for label in labels):
        raise DataError(f"{labels[0]} has {table[labels[0]].ndim} dimensions, expected a column")
    note = ("columns are counted from 0, which is the first joint",) if first == 0 else ()
    return TableColumns(_side_by_side(table, labels), tuple(labels), note)


def _by_joint(
    table: Table, quantity: Set[str], robot: RobotConfig, by_position: bool, joints: Sequence[str] | None
) -> TableColumns | None:
    """Return the columns that are named after joints and a word of the quantity: ``/joint_states/elbow/position``."""
    of_joint: dict[str, str] = {}
    for name, values in table.items():
        rest = _joint_of(name, quantity)
        if rest and values.ndim == 1:
            of_joint.setdefault(rest, name)
    if not of_joint:
        return None
    chosen = of_joint
    if joints is not None:
        # A joint is named as in its columns, with or without what is common to all of them.
        chosen = {next((j for j in joints if rest == j or re.search(rf"(^|\W){re.escape(j)}$", rest)), rest): name
                  for rest, name in of_joint.items()}  # fmt: skip
    match = match_joints(list(chosen), robot.joints, by_position=by_position, joints=joints)
    labels = tuple(chosen[each] for each in match.names)
    return TableColumns(_side_by_side(table, labels), labels, match.remarks, match.names)


def _joint_of(name: str, quantity: Set[str]) -> str | None:
    """Return the part of a column's name that tells its joint, if it has a word of a quantity and none of a demand."""
    words = [(found[0].lower(), found.start(), found.end()) for found in _WORD.finditer(name)]
    if len(words) < 2 or without_demand(name) is not None:
        return None
    if words[-1][0] in quantity:
        end = words[-2][1] if words[-2][0] in _MEASURED and len(words) > 2 else words[-1][1]
        return name[:end].strip(" ./_-:[]")
    if words[0][0] in quantity:
        return name[words[0][2] :].strip(" ./_-:[]")
    return None


def _side_by_side(table: Table, labels: Sequence[str]) -> NDArray[np.float64]:
    """Return columns as one array (N, n); refuse columns of different lengths."""
    first = labels[0]
    for label in labels:
        if table[label].shape != table[first].shape:
            raise DataError(f"{label} has {table[label].size} values, {first} has {table[first].size}")
    return np.stack([table[label] for label in labels], axis=1)
