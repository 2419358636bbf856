"""Named arrays of the files of other tools."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.configs.yaml_loader import is_file
from armident.daq.interchange.csv_files import read_csv
from armident.daq.interchange.import_options import ImportOptions
from armident.daq.interchange.lerobot import data_files, is_lerobot, joined, lerobot_table
from armident.daq.interchange.sandbox import read_in_subprocess
from armident.daq.interchange.table_columns import without_units
from armident.daq.interchange.text_files import printable, shortened
from armident.extras import install_line

Table = dict[str, NDArray[np.float64]]
_LATER_MAT = b"MATLAB 7.3"


@dataclass(frozen=True)
class Source:
    """Named arrays of a file, (N,) or (N, n), with the units that it states for them.

    ``lines`` (N,): line of each row in a text file, else ``None``. ``t_ns`` (N,): stamps of the messages of a bag, ns.
    ``clock``: sentence on the times of a bag if they are not the stamps. ``lerobot``: it is a data set of LeRobot.
    ``words``: first text of each column of text.
    """

    path: Path
    table: Table
    lines: NDArray[np.int64] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    t_ns: NDArray[np.int64] | None = None
    clock: str = ""
    lerobot: bool = False
    words: Mapping[str, str] = field(default_factory=dict)

    def place(self, row: int, name: str) -> str:
        """Return the position of a value in the file, for messages; rows count from 0."""
        where = f"row {row}" if self.lines is None else f"line {self.lines[row]}"
        return f"{self.path}: {where}, column {name}"


def read_columns(path: Path, config: RobotConfig, options: ImportOptions) -> Source:
    """Return the columns of a text file with a header, or of a pair of files."""
    effort = options.get("effort")
    return _header_csv(path) if effort is None else _pair(path, effort, config)


def _pair(path: Path, effort: Path, robot: RobotConfig) -> Source:
    """Return positions and efforts of two tables with free or no headers: a column per joint, or a single column."""
    columns: Table = {}
    notes: list[str] = []
    lines = None
    for file, base in ((path, "q"), (effort, "tau")):
        if not is_file(file):
            raise ConfigError(f"{file}: no such file")
        table = read_csv(file)
        values = table.values
        if values.shape[1] == 1:
            if not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values[:, 0]))[0])
                raise DataError(f"{file}: line {table.lines[row]} has no number")
            if values.shape[0] % robot.n == 0:
                values = values.reshape(-1, robot.n)
        if values.shape[1] != robot.n:
            raise DataError(f"{file}: {values.shape[1]} columns, but {robot.name} has {robot.n} joints")
        columns |= {f"{base}{j + 1}": values[:, j] for j in range(robot.n)}
        notes += [f"{file.name}: {note}" for note in table.notes]
        lines = table.lines if len(table.lines) == len(values) else None
    rows = {len(v) for v in columns.values()}
    if len(rows) != 1:
        raise DataError(f"{path} and {effort}: {' and '.join(str(r) for r in sorted(rows))} rows")
    return Source(path, columns, lines, notes=tuple(notes))


def _header_csv(path: Path) -> Source:
    table = read_csv(path)
    if table.header is None:
        raise DataError(f"{path}: no header line; expected t,q1..,tau1.. (or a pair of files with --effort)")
    header = [printable(name) for name in table.header]
    count = Counter(header)
    # a name that several columns have is that of none
    kept = {name if n == 1 else f"{name} in {n} columns": header.index(name) for name, n in count.items() if name}
    columns = {name: table.values[:, k] for name, k in kept.items()}
    units = [table.units[k] for k in kept.values() if k < len(table.units)]
    return _converted(Source(path, columns, table.lines, notes=table.notes, words=table.words), units)


def lerobot_folder(path: Path, *_: Any) -> Source:
    """Return the arrays of a data set without the files that cannot be read, which are named."""
    files = data_files(path)
    parts, damaged = {}, []
    for file in files:
        try:
            parts[file] = parquet_arrays(file)
        except DataError:
            damaged.append(shortened(file.name))
    if not parts:
        raise DataError(f"{path}: none of its {len(files)} Parquet files is readable: damaged, or cut off")
    source = from_arrays(path, joined(parts))
    notes = (f"files that are damaged or cut off left out: {', '.join(damaged)}",) if damaged else ()
    return replace(source, notes=(*source.notes, *notes))


def from_arrays(path: Path, arrays: Mapping[str, Any]) -> Source:
    """Return named arrays as a table; those of a LeRobot data set by its names."""
    arrays = {printable(name): values for name, values in arrays.items()}
    if is_lerobot(arrays):
        table, notes = lerobot_table(path, arrays)
        return Source(path, table, notes=tuple(notes), lerobot=True)
    texts = {k: v for k, v in arrays.items() if isinstance(v, np.ndarray) and v.size and v.dtype.kind in "OU"}
    return _converted(Source(path, _numeric(arrays), words={k: str(v.flat[0]) for k, v in texts.items()}), [])


def _converted(source: Source, units: list[str]) -> Source:
    try:
        table, stated, notes = without_units(source.table, units)
    except DataError as error:
        raise DataError(f"{source.path}: {error}") from error
    return replace(source, table=table, units=stated, notes=(*source.notes, *notes))


def _numeric(arrays: Mapping[str, Any]) -> Table:
    """Return the real arrays; vectors as (N,), dates as seconds since 1970, and durations since the first."""
    table: Table = {}
    for name, value in arrays.items():
        if not isinstance(value, np.ndarray) or not value.size:
            continue
        if value.dtype.kind in "mM":
            origin = np.datetime64(0, "ns") if value.dtype.kind == "M" else value.min()
            table[name] = (value - origin) / np.timedelta64(1, "ns") * 1e-9
        elif value.dtype.kind in "iuf":
            array = value.astype(np.float64)
            table[name] = array.ravel() if array.ndim == 2 and 1 in array.shape else array
    return table


def npz_arrays(path: Path, *_: Any) -> dict[str, Any]:
    """Return the arrays of an archive of numpy."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # zipfile, zlib and numpy raise various errors for damaged files
        raise DataError(f"{path}: not a readable NPZ file: damaged, or not an archive of numeric arrays") from error


def parquet_arrays(path: Path, *_: Any) -> dict[str, Any]:
    """Return the columns of a Parquet file."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(install_line(f"{path}: Parquet", ["parquet"])) from error
    try:
        table = pyarrow.parquet.read_table(path)
        return {_with_unit(field): column.to_numpy() for field, column in zip(table.schema, table.columns, strict=True)}
    except Exception as error:  # pyarrow raises various errors for damaged files
        raise DataError(f"{path}: not a readable Parquet file: damaged, or cut off") from error


def _with_unit(field: Any) -> str:
    """Return the name of a field of a Parquet file, with the unit that its metadata have."""
    unit = (field.metadata or {}).get(b"unit", b"").decode(errors="replace")
    return f"{field.name} [{unit}]" if unit and not field.name.endswith("]") else str(field.name)


def mat_arrays(path: Path, *_: Any) -> dict[str, Any]:
    """Return the arrays of a MAT file up to version 7."""
    from scipy.io import loadmat

    with path.open("rb") as file:
        if file.read(len(_LATER_MAT)) == _LATER_MAT:
            raise DataError(f"{path}: MAT version 7.3 is not supported; save it with -v7")

    def read() -> dict[str, Any]:
        arrays: dict[str, Any] = loadmat(path)
        return arrays

    try:
        # Some damaged files crash scipy's reader.
        return dict(read_in_subprocess(read))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a readable MAT file: damaged, or none of version 7 or before") from error
