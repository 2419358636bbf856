"""Formats of other tools: one class for each. Help texts, messages, docs and fuzz targets derive from `READERS`.

The module is imported for the help of the command line: what is slow to import is imported where a file is read.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from armident.daq.interchange.import_options import FLAGS, ImportOptions, given

if TYPE_CHECKING:
    from armident.daq.interchange.table_files import Source
    from armident.daq.recording import Recording

_OF_TABLES = frozenset(FLAGS) - {"topic", "effort"}


class Reader(Protocol):
    """Reader of a format, and writer if it has a method ``write``.

    Attributes
    ----------
    name, suffixes, reads
        Name and file name suffixes of the format, and what is read of it, for help and docs.
    folders
        True if folders may have this format.
    extra
        Extra of the distribution that it needs.
    options
        Names of the options of an import that it takes.
    session, own
        True if it needs the configuration of the session, not that of the robot; or none, as it is inside the file.
    by_robot
        True if a file is read for a robot: its joints are found while reading.
    write
        Function (recording, path) that writes the format; ``None``: it is only read.
    """

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]]
    reads: ClassVar[str]
    folders: ClassVar[bool] = False
    extra: ClassVar[str | None] = None
    options: ClassVar[frozenset[str]] = _OF_TABLES
    session: ClassVar[bool] = False
    own: ClassVar[bool] = False
    by_robot: ClassVar[bool] = False
    write: ClassVar[Callable[[Recording, Path], None] | None] = None

    def matches(self, path: Path) -> bool:
        """Return True if a file or folder has this format, by its name if that tells it."""
        return path.name.lower().endswith(self.suffixes) and not path.is_dir()

    def read(self, path: Path, config: Any, options: ImportOptions) -> Source | Recording:
        """Return the named arrays of a file, or a recording if the file needs no other step."""
        ...


def _writer(name: str) -> Callable[[Recording, Path], None]:
    """Return a function of `armident.daq.interchange.exporting`, which is imported when it is called."""

    def write(recording: Recording, path: Path) -> None:
        from armident.daq.interchange import exporting

        getattr(exporting, name)(recording, path)

    return write


class OwnRecording(Reader):
    """Recordings of armident, to be resampled."""

    name = "recording of armident"
    suffixes = (".mcap",)
    reads = "everything, resampled to `--rate`"
    options = frozenset({"rate_hz", "resample_hz"})
    own = True

    def matches(self, path: Path) -> bool:
        """Return True for a recording: a bag has the same suffix."""
        from armident.daq.recording import is_recording

        return path.suffix.lower() in self.suffixes and is_recording(path)

    def read(self, path: Path, config: Any, options: ImportOptions) -> Recording:
        """Return the recording at another sampling rate."""
        from armident.daq.interchange.importing import resampled_recording

        return resampled_recording(path, config, options.get("rate_hz") or options.get("resample_hz"))


class Csv(Reader):
    """Text with columns."""

    name = "CSV"
    suffixes = (".csv", ".txt", ".tsv")
    reads = "columns `t`, `q1..qn`, `tau1..taun` or `current1..`, optionally the demand `qr1..`; or named after joints"
    options = _OF_TABLES | {"effort"}
    write = staticmethod(_writer("export_csv"))

    def read(self, path: Path, config: Any, options: ImportOptions) -> Source:
        """Return the columns of one file, or of a pair of files."""
        from armident.daq.interchange.table_files import read_header_csv, read_pair

        effort = options.get("effort")
        return read_header_csv(path) if effort is None else read_pair(path, effort, config)


class _Arrays(Reader, Protocol):
    """Format of named arrays."""

    def read(self, path: Path, config: Any, options: ImportOptions) -> Source:
        """Return the arrays of a file."""
        from armident.daq.interchange.table_files import from_arrays

        return from_arrays(path, self.arrays(path))

    def arrays(self, path: Path) -> dict[str, Any]:
        """Return the arrays of a file by name."""
        ...


class Npz(_Arrays):
    """Archives of numpy."""

    name = "NPZ"
    suffixes = (".npz",)
    reads = "arrays with the names of columns of CSV, or `positions`, `torques`, `times`"
    write = staticmethod(_writer("export_npz"))

    def arrays(self, path: Path) -> dict[str, Any]:
        """Return the arrays of an archive."""
        from armident.daq.interchange.table_files import npz_arrays

        return npz_arrays(path)


class Mat(_Arrays):
    """Files of MATLAB, up to version 7."""

    name = "MAT"
    suffixes = (".mat",)
    reads = "the same, up to version 7 (`-v7`)"
    extra = "identify"
    write = staticmethod(_writer("export_mat"))

    def arrays(self, path: Path) -> dict[str, Any]:
        """Return the arrays of a file of MATLAB."""
        from armident.daq.interchange.table_files import mat_arrays

        return mat_arrays(path)


class Parquet(_Arrays):
    """Tables of Apache Parquet, those of LeRobot included."""

    name = "Parquet"
    suffixes = (".parquet",)
    reads = "the same, or a file of a LeRobot data set"
    extra = "parquet"
    write = staticmethod(_writer("export_parquet"))

    def arrays(self, path: Path) -> dict[str, Any]:
        """Return the columns of a table."""
        from armident.daq.interchange.table_files import parquet_arrays

        return parquet_arrays(path)


class LeRobot(Reader):
    """Folders of LeRobot data sets."""

    name = "LeRobot data set"
    suffixes = ()
    reads = "`observation.state`, and an effort or current"
    folders = True
    extra = "parquet"

    def matches(self, path: Path) -> bool:
        """Return True for the folder of a data set, or of a part of one."""
        from armident.daq.interchange.lerobot import data_files

        return bool(data_files(path))

    def read(self, path: Path, config: Any, options: ImportOptions) -> Source:
        """Return the columns of all readable files of a data set."""
        from armident.daq.interchange.table_files import lerobot_folder

        return lerobot_folder(path)


class RosBag(Reader):
    """Bags of ROS 2."""

    name = "ROS 2 bag"
    suffixes = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd", ".bag")
    reads = "joint states (`sensor_msgs/msg/JointState`), joints by their names"
    folders = True
    options = frozenset(FLAGS) - {"effort", "time_unit"}
    by_robot = True
    write = staticmethod(_writer("export_rosbag"))

    def matches(self, path: Path) -> bool:
        """Return True for a file with the name of a bag, those of ROS 1 included, or a folder."""
        return path.is_dir() or path.name.lower().endswith(self.suffixes)

    def read(self, path: Path, config: Any, options: ImportOptions) -> Source:
        """Return the joint states of a robot."""
        from armident.daq.interchange.rosbag import joint_state_table

        return joint_state_table(path, config, options)


class BusLog(Reader):
    """Logs of CAN tools."""

    name = "bus log"
    suffixes = (".log", ".asc", ".blf", ".trc")
    reads = "SYNC and TPDOs as the session configuration maps them: candump, Vector ASC and BLF, PEAK TRC"
    options = frozenset()
    session = True
    write = staticmethod(_writer("export_bus_log"))

    def read(self, path: Path, config: Any, options: ImportOptions) -> Recording:
        """Return the recording of a log."""
        from armident.configs import load_robot
        from armident.configs.blanks import LOG
        from armident.daq.interchange.bus_log import recording_from_log

        return recording_from_log(path, config, load_robot(config.robot, LOG))


READERS: tuple[Reader, ...] = (
    Csv(), Npz(), Mat(), Parquet(), LeRobot(), OwnRecording(), RosBag(), BusLog()
)  # fmt: skip
"""All formats; the first one that matches a file reads it."""


def reader_of(path: Path) -> Reader:
    """Return the reader of a file or folder."""
    from armident.configs import ConfigError
    from armident.configs.yaml_loader import is_file

    if not is_file(path) and not path.is_dir():
        raise ConfigError(f"{path}: no such file")
    found = next((reader for reader in READERS if reader.matches(path)), None)
    if found is None:
        readable = "; ".join(f"{each.name} ({', '.join(_forms(each))})" for each in READERS)
        raise ConfigError(f"{path}: cannot read {path.suffix or 'a file without suffix'}; readable: {readable}")
    return found


def check_options(path: Path, reader: Reader, options: ImportOptions) -> None:
    """Refuse options that the reader of a file does not take."""
    from armident.configs import ConfigError

    for option in given(options):
        if option not in reader.options:
            takers = ", ".join(each.name for each in READERS if option in each.options)
            raise ConfigError(f"{path}: {FLAGS[option]} is an option of {takers}; not of a {reader.name}")


def _forms(reader: Reader) -> list[str]:
    """Return the suffixes of a format, and ``folder`` if folders have it."""
    return [*reader.suffixes, *(["folder"] if reader.folders else [])]


def names_of_formats() -> str:
    """Return the names of all formats, for help texts of one line."""
    return ", ".join(reader.name for reader in READERS)


def help_of_formats() -> str:
    """Return a sentence for each format, for the help of the command line."""
    return "\n\n".join(f"{each.name} ({', '.join(_forms(each))}): {each.reads}." for each in READERS).replace("`", "")


def table_of_formats() -> str:
    """Return the table of the documentation."""
    rows = [
        f"| {each.name} | {', '.join(f'`{form}`' for form in _forms(each))} | {each.reads} | "
        f"{f'`{each.extra}`' if each.extra else ''} | {'yes' if each.write else ''} |"
        for each in READERS
    ]
    return "\n".join(["| format | suffixes | read | extra | `armident export` |", "| --- " * 5 + "|", *rows])


def written_suffixes() -> str:
    """Return the suffixes that an export writes, for help and messages."""
    return ", ".join(dict.fromkeys(suffix for each in READERS for suffix in written(each)))


def writer_of(path: Path) -> Callable[[Recording, Path], None]:
    """Return the function that writes the format of a suffix."""
    from armident.configs import ConfigError

    suffix = path.suffix.lower()
    for reader in READERS:
        if reader.write is not None and suffix in written(reader):
            return reader.write
    raise ConfigError(f"{path}: cannot export {path.suffix or 'without suffix'}; expected {written_suffixes()}")


def written(reader: Reader) -> tuple[str, ...]:
    """Return the suffixes under which a format is written: all of a bus log, the first of others."""
    return () if reader.write is None else reader.suffixes if reader.session else reader.suffixes[:1]
