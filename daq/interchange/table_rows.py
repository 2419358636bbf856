"""Rows of a table: quantities of the joints, complete rows, and the numbers of their samples."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.daq.interchange.clocks import descending, without_wraps
from armident.daq.interchange.column_units import check_unit, time_unit
from armident.daq.interchange.si_checks import OMITTED
from armident.daq.interchange.table_columns import NAMES, TableColumns, find_columns, find_time, unused_demand
from armident.daq.interchange.table_files import Source
from armident.daq.interchange.text_files import listed
from armident.daq.recording.faults.zeros import never_measured
from armident.daq.recording.model import Quantity

EFFORTS: tuple[Quantity, ...] = ("torque", "current", "voltage")
_MOST_BAD_SHARE = 0.05
"""Share of incomplete rows above which a table is refused; a single row is always left out."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TableRows:
    """Complete rows of a table: position, effort and, if there is one, demand, (N, n) each.

    ``labels``: column names by quantity. ``row`` (N,): number in the file, from 0. ``times`` (N,) in the unit of the
    file (``time_unit``, empty if it states none), ``None`` without a column ``time_name``.
    """

    values: dict[Quantity, Floats]
    labels: dict[Quantity, tuple[str, ...]]
    row: NDArray[np.int64]
    times: Floats | None
    time_name: str = "t"
    time_unit: str = ""
    notes: tuple[str, ...] = ()

    def taken(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> "TableRows":
        """Return some of the rows. ``chosen``: indices, or one truth value for each row."""
        times = None if self.times is None else self.times[chosen]
        values = {name: array[chosen] for name, array in self.values.items()}
        return replace(self, values=values, row=self.row[chosen], times=times)


def complete_rows(
    source: Source,
    robot: RobotConfig,
    names: dict[str, str],
    *,
    by_position: bool = False,
    joints: Sequence[str] | None = None,
) -> TableRows:
    """Return the rows of a table that have time, all positions and all efforts; DataError if too many are incomplete.

    Rows without any of them are passed over. Rows of one time are joined where one has what the other lacks. Others are
    left out and named. ``names``: names of the file by quantity; ``-`` leaves one out.
    """
    try:
        found: dict[Quantity, TableColumns] = {}
        quantities: tuple[Quantity, ...] = ("position", *EFFORTS, "demand")
        for quantity in quantities:
            if names.get(quantity) == OMITTED or (quantity in EFFORTS and any(e in found for e in EFFORTS)):
                continue
            columns = _found(source, quantity, robot, names.get(quantity), by_position, joints)
            if columns is not None:
                _check_units(source, quantity, columns.labels)
                found[quantity] = columns
        _check_same_joints(found)
        if not by_position:
            _check_order(source, robot, found)
        time = None if names.get("time") == OMITTED else find_time(source.table, names.get("time"))
    except DataError as error:
        raise DataError(f"{source.path}: {error}") from error
    if "position" not in found or not any(e in found for e in EFFORTS):
        raise DataError(
            f"{source.path}: expected columns q1..q{robot.n} and tau1..tau{robot.n} (or current, voltage); "
            f"found {listed(list(source.table))}; --map QUANTITY=NAME names others"
        )
    lengths = {len(columns.values) for columns in found.values()} | ({len(time[1])} if time is not None else set())
    if len(lengths) > 1:
        raise DataError(f"{source.path}: its arrays have {' and '.join(map(str, sorted(lengths)))} rows")
    notes = [note for columns in found.values() for note in columns.notes]
    if "demand" not in found and names.get("demand") != OMITTED and (unused := unused_demand(source.table)):
        notes.append(unused)
    others = [name for name in source.table if name.lower() in NAMES["time"] and time is not None and name != time[0]]
    if time is not None and others and "time" not in names:
        notes.append(f"times taken from {time[0]}, not from {listed(others)}; --map time=NAME chooses")
    rows = TableRows(
        {quantity: np.array(columns.values, np.float64) for quantity, columns in found.items()},
        {quantity: columns.labels for quantity, columns in found.items()},
        np.arange(lengths.pop(), dtype=np.int64),
        None if time is None else time[1],
        "t" if time is None else time[0],
        "" if time is None else time_unit(source.units.get(time[0], "")),
        tuple(dict.fromkeys(notes)),
    )
    rows = _without_odd_times(source, _in_order(_complete(source, _joined(rows))))
    backward = np.flatnonzero(np.diff(rows.times) < 0) if rows.times is not None else np.zeros(0, np.intp)
    if rows.times is not None and backward.size:
        k = int(backward[0])
        raise DataError(
            f"{source.place(int(rows.row[k + 1]), rows.time_name)}: time does not increase: it goes back by "
            f"{rows.times[k] - rows.times[k + 1]:.6g}; another run begins here, or the clock was set: write one file "
            "for each part"
        )
    return _single(rows)


def _in_order(rows: TableRows) -> TableRows:
    """Return the rows from the oldest to the newest, and their times without wraps."""
    if rows.times is None or rows.times.size < 2:
        return rows
    notes: tuple[str, ...] = ()
    steps, order = np.diff(rows.times), np.argsort(rows.times)
    # The times of two runs are not even where they overlap.
    sorted_steps = np.diff(rows.times[order])
    even = 2.0 * np.abs(sorted_steps - np.median(sorted_steps)) < np.median(sorted_steps)
    if descending(rows.times) and not (even.all() and np.any(steps > 0)):
        rows = rows.taken(np.arange(order.size)[::-1])
        notes = ("the newest row comes first: read from the last row to the first",)
    elif even.all() and np.any(steps < 0):
        rows = rows.taken(order)
        notes = ("the rows are out of order, and their times are even: sorted by time",)
    assert rows.times is not None
    times, wrapped = without_wraps(rows.times)
    return replace(rows, times=times, notes=(*rows.notes, *notes, *wrapped))


def _found(
    source: Source,
    quantity: Quantity,
    robot: RobotConfig,
    name: str | None,
    by_position: bool,
    joints: Sequence[str] | None,
) -> TableColumns | None:
    """Return the columns of a quantity; a demand that cannot be found can be omitted."""
    try:
        return find_columns(source.table, quantity, robot, name, by_position=by_position, joints=joints)
    except DataError as error:
        if quantity != "demand":
            raise
        raise DataError(f"demand: {error}; --map demand={OMITTED} omits it") from error


def _check_same_joints(found: Mapping[Quantity, TableColumns]) -> None:
    """Refuse efforts of other joints than those of the positions."""
    position = found.get("position")
    for quantity in EFFORTS:
        effort = found.get(quantity)
        if position and effort and position.joints and effort.joints and position.joints != effort.joints:
            raise DataError(
                f"positions are those of {listed(position.joints)}, but {quantity}s those of {listed(effort.joints)}: "
                "columns of several arms; name them alike, or give the names behind the last slash: --joints NAME,..."
            )


def _check_order(source: Source, robot: RobotConfig, found: Mapping[Quantity, TableColumns]) -> None:
    """Refuse numbered columns of a file whose text names the joints in another order, as bags in CSV do."""
    text = " ".join(source.words.values())
    for names in [[joint.source_name or joint.name for joint in robot.joints], [joint.name for joint in robot.joints]]:
        at = [place.start() for name in names if (place := re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text))]
        if len(at) == robot.n and at != sorted(at) and any(not columns.joints for columns in found.values()):
            order = [name for _, name in sorted(zip(at, names, strict=True))]
            raise DataError(
                f"columns are numbered, and {listed(list(source.words))} names the joints in another order than the "
                f"robot: {listed(order)}; name the columns {order[0]}/position, {order[0]}/effort and so on"
            )


def _check_units(source: Source, quantity: Quantity, labels: Sequence[str]) -> None:
    """Refuse columns in units that are not those of their quantity; an array has one unit for all of its columns."""
    for label in labels:
        array = label.rstrip("0123456789")
        check_unit(label, quantity, source.units.get(label, source.units.get(array, "")))


def _without_odd_times(source: Source, rows: TableRows) -> TableRows:
    """Return the rows without those whose time is out of order while their neighbours are in order."""
    if rows.times is None or rows.times.size < 4:
        return rows
    t = rows.times
    odd = np.zeros(t.size, np.bool_)
    odd[1:-1] = (t[:-2] < t[2:]) & ((t[1:-1] < t[:-2]) | (t[1:-1] > t[2:]))
    count = int(odd.sum())
    if not count or count > max(1, _MOST_BAD_SHARE * t.size) or np.any(np.diff(t[~odd]) < 0):
        return rows
    where = source.place(int(rows.row[np.flatnonzero(odd)[0]]), rows.time_name)
    note = f"rows whose time is out of order left out: {count}, the first: {where}"
    return replace(rows.taken(~odd), notes=(*rows.notes, note))


def _single(rows: TableRows) -> TableRows:
    """Return the rows without those that repeat time and values of the row before."""
    if rows.times is None or rows.times.size < 2:
        return rows
    everything = np.concatenate(list(rows.values.values()), axis=1)
    equal = (everything[1:] == everything[:-1]) | (np.isnan(everything[1:]) & np.isnan(everything[:-1]))
    same = np.diff(rows.times) == 0
    twice = np.append(False, same & equal.all(axis=1))
    # Of times with few digits, most rows of one time differ, and equal ones are a standstill.
    if not twice.any() or 2 * twice.sum() < same.sum():
        return rows
    note = f"{int(twice.sum())} duplicate rows with the same time: one of each is kept"
    return replace(rows.taken(~twice), notes=(*rows.notes, note))


def _needed(rows: TableRows) -> Floats:
    return np.concatenate([values for name, values in rows.values.items() if name != "demand"], axis=1)


def _joined(rows: TableRows) -> TableRows:
    """Join rows of one time, one of which has the positions and the other the efforts."""
    if rows.times is None or rows.times.size < 2:
        return rows
    have = np.isfinite(_needed(rows))
    same = (np.diff(rows.times) == 0) & ~have[1:].all(axis=1) & ~have[:-1].all(axis=1)
    pairs = np.flatnonzero(same & ~(have[1:] & have[:-1]).any(axis=1))
    if not pairs.size:
        return rows
    for values in rows.values.values():
        earlier, later = values[pairs], values[pairs + 1]
        values[pairs] = np.where(np.isfinite(earlier), earlier, later)
    kept = np.ones(rows.row.size, np.bool_)
    kept[pairs + 1] = False
    joined = rows.taken(kept)
    return replace(joined, notes=(*rows.notes, f"rows of one time joined: {pairs.size}"))


def _complete(source: Source, rows: TableRows) -> TableRows:
    needed = _needed(rows)
    have = np.isfinite(needed)
    nothing = ~have.any(axis=1)
    timed = np.ones(len(have), np.bool_) if rows.times is None else np.isfinite(rows.times)
    whole = have.all(axis=1) & timed
    partial = ~whole & ~nothing if rows.times is not None else ~whole
    passed = int((nothing & ~partial & timed).sum())
    notes = list(rows.notes)
    count, total = int(partial.sum()), int(whole.sum() + partial.sum())
    if count and count > max(1, _MOST_BAD_SHARE * total):
        raise DataError(_incomplete(source, rows, partial, whole))
    if not whole.any():
        raise DataError(f"{source.path}: no row has both positions and efforts of all joints")
    if count:
        first = int(np.flatnonzero(partial)[0])
        of = f"{count} row{'s' if count > 1 else ''} left out"
        notes.append(f"{of}, the first: {_first_missing(source, rows, first)}")
    zero = [label for name in EFFORTS if name in rows.values for label in _zero(rows, name, whole)]
    if zero:
        notes.append(f"all zero: probably not measured: {listed(zero)}")
    if passed:
        notes.append(f"{passed} rows without positions and efforts ignored")
    return replace(rows.taken(whole), notes=tuple(notes))


def _incomplete(source: Source, rows: TableRows, partial: NDArray[np.bool_], whole: NDArray[np.bool_]) -> str:
    """Return the message for a table with too many incomplete rows."""
    count = int(partial.sum())
    if empty := _empty(rows):
        return f"{source.path}: no number in any row of {listed(empty)}"
    if not whole.any() and rows.times is not None:
        return (
            f"{source.path}: no row has both positions and efforts of all joints ({count} rows have some of them): "
            "sparse rows of several topics; export them on one clock"
        )
    first = int(np.flatnonzero(partial)[0])
    return f"{_first_missing(source, rows, first)} (and {count - 1} more of {partial.size} rows)"


def _zero(rows: TableRows, name: Quantity, whole: NDArray[np.bool_]) -> list[str]:
    """Return the labels of the columns of a quantity that are 0 in all complete rows."""
    zero = never_measured(rows.values[name][whole])
    return [label for label, is_zero in zip(rows.labels[name], zero, strict=True) if is_zero]


def _empty(rows: TableRows) -> list[str]:
    """Return the labels of the columns without any number."""
    return [
        label
        for name, values in rows.values.items()
        if name != "demand"
        for label, column in zip(rows.labels[name], values.T, strict=True)
        if not np.isfinite(column).any()
    ]


def _first_missing(source: Source, rows: TableRows, row: int) -> str:
    where = int(rows.row[row])
    for name, values in rows.values.items():
        missing = np.flatnonzero(~np.isfinite(values[row]))
        if name != "demand" and missing.size:
            return f"{source.place(where, rows.labels[name][missing[0]])}: {values[row, missing[0]]} is not a number"
    return f"{source.place(where, rows.time_name)}: nan is not a number"
