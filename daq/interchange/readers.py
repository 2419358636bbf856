"""Formats of other tools: one class for each. Help texts, messages, docs and fuzz targets derive from `READERS`.

It is imported for the help of the command line: what is slow to import is imported where a file is read.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from armident.daq.interchange.import_options import FLAGS, ImportOptions, given

if TYPE_CHECKING:
    from armident.daq.interchange.table_files import Source
    from armident.daq.recording import Recording

_OF_TABLES = frozenset(FLAGS) - {"topic", "effort"}


class Reader:
    """Reader (path, config, options) of a format, and writer (recording, path), if any, as ``module:function``."""

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]]
    reads: ClassVar[str]
    """Name of the quantities or files that are read, for help and docs."""
    reader: ClassVar[str] = ""
    writer: ClassVar[str] = ""
    extra: ClassVar[str] = ""
    """Extra of the distribution that it needs."""
    options: ClassVar[frozenset[str]] = _OF_TABLES
    """Options of an import that it takes."""
    folders: ClassVar[bool] = False
    """Folders may have this format."""
    session: ClassVar[bool] = False
    """It needs the configuration of the session, not that of the robot."""
    own: ClassVar[bool] = False
    """The configuration is in the file."""
    by_robot: ClassVar[bool] = False
    """A file is read for a robot: its joints are found while reading."""

    def matches(self, path: Path) -> bool:
        """Return True if a file or folder has this format, by its name if that tells it."""
        return path.name.lower().endswith(self.suffixes) and not path.is_dir()

    def read(self, path: Path, config: Any, options: ImportOptions) -> Source | Recording:
        """Return the named arrays of a file, or a recording if the file needs no other step."""
        found: Source | Recording | dict[str, Any] = _function(self.reader)(path, config, options)
        return _function("table_files:from_arrays")(path, found) if isinstance(found, dict) else found


def _function(place: str) -> Callable[..., Any]:
    """Return a function of this package, whose module is imported only when a file is read or written."""
    module, _, name = place.partition(":")
    function: Callable[..., Any] = getattr(import_module(f"armident.daq.interchange.{module}"), name)
    return function


class Csv(Reader):
    """Text with columns, in one file or in a pair of files."""

    name = "CSV"
    suffixes = (".csv", ".txt", ".tsv")
    reads = "columns `t`, `q1..qn`, `tau1..taun` or `current1..`, optionally the demand `qr1..`; or named after joints"
    reader, writer = "table_files:read_columns", "exporting:export_csv"
    options = _OF_TABLES | {"effort"}

    def matches(self, path: Path) -> bool:
        """Return True for a text file that is not a bus log."""
        return super().matches(path) and not _is_text_log(path)


def _is_text_log(path: Path) -> bool:
    return bool(_function("log_file:is_text_log")(path))


class Npz(Reader):
    """Archives of numpy."""

    name = "NPZ"
    suffixes = (".npz",)
    reads = "arrays with the names of columns of CSV, or `positions`, `torques`, `times`"
    reader, writer = "table_files:npz_arrays", "exporting:export_npz"


class Mat(Reader):
    """Files of MATLAB."""

    name = "MAT"
    suffixes = (".mat",)
    reads = "the same, up to version 7 (`-v7`)"
    reader, writer = "table_files:mat_arrays", "exporting:export_mat"
    extra = "identify"


class Parquet(Reader):
    """Tables of Apache Parquet, those of LeRobot included."""

    name = "Parquet"
    suffixes = (".parquet",)
    reads = "the same, or a file of a LeRobot data set"
    reader, writer = "table_files:parquet_arrays", "exporting:export_parquet"
    extra = "parquet"


class LeRobot(Reader):
    """Folders of LeRobot data sets, or parts of them."""

    name = "LeRobot data set"
    suffixes = ()
    reads = "`observation.state`, and an effort or current"
    reader = "table_files:lerobot_folder"
    extra = "parquet"
    folders = True

    def matches(self, path: Path) -> bool:
        """Return True for a folder with Parquet files."""
        return bool(_function("lerobot:data_files")(path))


class OwnRecording(Reader):
    """Recordings of armident."""

    name = "recording of armident"
    suffixes = (".mcap",)
    reads = "everything, resampled to `--rate`"
    reader = "importing:resampled_recording"
    options = frozenset({"rate_hz", "resample_hz"})
    own = True

    def matches(self, path: Path) -> bool:
        """Return True for a recording: a bag has the same suffix."""
        from armident.daq.recording import is_recording

        return path.suffix.lower() in self.suffixes and is_recording(path)


class RosBag(Reader):
    """Bags of ROS 2; those of ROS 1 are refused with the command that converts them."""

    name = "ROS 2 bag"
    suffixes = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd", ".bag")
    reads = "joint states (`sensor_msgs/msg/JointState`), joints by their names"
    reader, writer = "rosbag:joint_state_table", "exporting:export_rosbag"
    options = frozenset(FLAGS) - {"effort", "time_unit"}
    folders = True
    by_robot = True

    def matches(self, path: Path) -> bool:
        """Return True for a file with the name of a bag, or a folder."""
        return path.is_dir() or path.name.lower().endswith(self.suffixes)


class BusLog(Reader):
    """Logs of CAN tools."""

    name = "bus log"
    suffixes = (".log", ".asc", ".blf", ".trc")
    reads = (
        "SYNC and TPDOs as the session configuration maps them: candump, Vector ASC and BLF, PEAK TRC, BUSMASTER; "
        "CSV of SavvyCAN, python-can and others (`.csv`, `.txt`)"
    )
    writer = "bus_log:write_log"
    options = frozenset({"rate_hz"})
    session = True

    def matches(self, path: Path) -> bool:
        """Return True for a bus log, by its suffix or, of other text files, by its first lines."""
        return super().matches(path) or (path.name.lower().endswith(Csv.suffixes) and _is_text_log(path))

    def read(self, path: Path, config: Any, options: ImportOptions) -> Recording:
        """Return the recording of a log, whose robot is that of the session."""
        from armident.configs import load_robot
        from armident.configs.blanks import LOG
        from armident.daq.interchange.bus_log import recording_from_log

        return recording_from_log(path, config, load_robot(config.robot, LOG), options.get("rate_hz"))


READERS = tuple(reader() for reader in Reader.__subclasses__())
"""All formats in the order of their classes; the first one that matches a file reads it."""


_PACKED = {
    b"PK\x03\x04": "an Excel workbook or a ZIP archive; save the sheet as CSV, or unpack the file, first",
    b"\x1f\x8b": "compressed by gzip; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed by zstd; unpack it first",
}
"""Formats by the first bytes of a file that is read as text, with the next step."""


def reader_of(path: Path) -> Reader:
    """Return the reader of a file or folder."""
    from armident.configs import ConfigError
    from armident.configs.yaml_loader import is_file

    if not is_file(path) and not path.is_dir():
        raise ConfigError(f"{path}: no such file")
    found = next((reader for reader in READERS if reader.matches(path)), None)
    if not path.is_dir() and (found is None or isinstance(found, Csv | BusLog)):
        with path.open("rb") as file:
            begin = file.read(4)
        if how := next((text for mark, text in _PACKED.items() if begin.startswith(mark)), ""):
            raise ConfigError(f"{path}: {how}")
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
        f"{f'`{each.extra}`' if each.extra else ''} | {'yes' if each.writer else ''} |"
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
        if suffix in written(reader):
            return _function(reader.writer)
    raise ConfigError(f"{path}: cannot export {path.suffix or 'without suffix'}; expected {written_suffixes()}")


def written(reader: Reader) -> tuple[str, ...]:
    """Return the suffixes under which a format is written: all of a bus log, the first of others."""
    return () if not reader.writer else reader.suffixes if reader.session else reader.suffixes[:1]
